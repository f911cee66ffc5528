"""Control and gateway for a page, with a recognizer and a synthesizer that play a script."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kouxing.services.control.config import ControlConfig
from kouxing.services.control.service import ControlService
from kouxing.services.kinds import KINDS
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.config import variable
from kouxing.shared.face.faps import FAP_NUMBER, MASK_BYTES
from kouxing.shared.keys import Peer, user_key
from kouxing.shared.message_loop import Handler
from kouxing.shared.service import Service
from kouxing.shared.wire.audio import AudioChunk, Sound
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.face import FaceSettings, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import SessionFacts
from kouxing.shared.wire.speech import Phone
from tests.system import ROOT

FRAME = 320  # samples; 20 ms
CLICK_EVERY = 25 * FRAME  # samples; 0.5 s
LOOK_AHEAD_MS = 60


class ScriptedRecognizer(Service):
    """Publishes what the test says, and keeps the audio that it gets."""

    kind = KINDS["recognizer"]

    def __init__(self, control: str) -> None:
        local = "tcp://127.0.0.1:*"
        super().__init__(RecognizerConfig(control=control, audio=local, phones=local))
        self.audio = self.bus.bind_router(local, "recognizer.audio")
        self.phones = self.bus.bind_publisher(local, "recognizer.phones")
        self.endpoints = {"audio": self.audio.endpoint, "phones": self.phones.endpoint}
        self.pcm: dict[str, bytes] = {}
        self.starts: dict[str, StartSession] = {}
        self.finished: set[str] = set()
        self.flushed: list[str] = []
        self.register(self.audio, {AudioChunk: self._on_audio})
        self.register(self.phones, {})

    def start_session(self, start: StartSession) -> bool:
        self.starts[start.session] = start
        return True

    def control_handlers(self) -> dict[type[Message], Handler]:
        return super().control_handlers() | {SetFace: lambda _message, _sender: None}

    def flush_session(self, session: str) -> None:
        self.flushed.append(session)

    def _on_audio(self, chunk: AudioChunk, _sender: Peer) -> None:
        self.pcm[chunk.session] = self.pcm.get(chunk.session, b"") + chunk.pcm
        if chunk.last:
            self.finished.add(chunk.session)


class ScriptedSynthesizer(Service):
    """Publishes the FAP frames that the test says."""

    kind = KINDS["synthesizer"]

    def __init__(self, control: str) -> None:
        local = "tcp://127.0.0.1:*"
        super().__init__(SynthesizerConfig(control=control, phone_input=local, faps=local))
        self.input = self.bus.bind_router(local, "synthesizer.phones")
        self.faps = self.bus.bind_publisher(local, "synthesizer.faps")
        self.endpoints = {"phone_input": self.input.endpoint, "faps": self.faps.endpoint}
        self.facts = SessionFacts(lip_model="dynamic-visemes")
        self.changes: list[tuple[str, FaceSettings]] = []  # by session
        self.register(self.input, {})
        self.register(self.faps, {})

    def control_handlers(self) -> dict[type[Message], Handler]:
        return super().control_handlers() | {SetFace: self._on_set_face}

    def _on_set_face(self, message: SetFace, _sender: Peer) -> None:
        self.changes.append((message.session, message.face))


class System:
    """Control, and the two scripted services, on a thread that plays the script in real time."""

    def __init__(self) -> None:
        local = "tcp://127.0.0.1:*"
        self.control = ControlService(
            ControlConfig(control=local, events=local, lost_after_s=10.0, max_load=1000.0)
        )
        self.address = self.control.endpoints["commands"]
        user_key()  # creates the key file that clients read
        control = self.address.partition(" ")[0]
        self.synthesizer = ScriptedSynthesizer(control)
        self.recognizer: ScriptedRecognizer | None = ScriptedRecognizer(control)
        self.shown: NDArray[np.float32] | None = None  # the face that is published; None: nothing
        self.flash: NDArray[np.float32] | None = None  # shown now and then, while sound clicks
        self.look_ahead_ms = LOOK_AHEAD_MS  # a frame comes so long after its sound
        self.symbol = "a"
        self.session = ""
        self._media_time = 0
        self._sequence = 0
        self._stop = False
        self._ask_recognizer_to_leave = False
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._stop = True
        self._thread.join()

    def lose_recognizer(self) -> None:
        self._ask_recognizer_to_leave = True

    def talk(self, session: str, shown: NDArray[np.float32], symbol: str) -> None:
        self.session, self.symbol, self.shown = session, symbol, shown

    def services(self) -> list[Service]:
        services = [self.control, self.recognizer, self.synthesizer]
        return [service for service in services if service is not None]

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stop:
            for service in self.services():
                service.step(0.001)
            if self._ask_recognizer_to_leave and self.recognizer is not None:
                self.recognizer.shutdown()
                self.recognizer = None
            now_s = time.monotonic()
            if now_s >= due_s:
                due_s = max(due_s + FRAME / 16000, now_s - 0.1)
                self._publish()
        for service in reversed(self.services()):
            service.shutdown()

    def _publish(self) -> None:
        shown = self.shown
        if shown is None or self.recognizer is None:
            return
        start = self.recognizer.starts.get(self.session)
        if start is None:
            return
        self._sequence += 1
        stamp: dict[str, Any] = {
            "session": self.session,
            "epoch": start.epoch,
            "sequence": self._sequence,
        }
        phones, faps = self.recognizer.phones, self.synthesizer.faps
        pcm = self._sound().tobytes()
        phones.send(Sound(**stamp, media_time=self._media_time, pcm=pcm))
        self._media_time += FRAME
        frame_time = self._media_time - self.look_ahead_ms * 16
        if frame_time >= 0:
            if self.flash is not None:
                shown = (self.flash if frame_time % CLICK_EVERY < CLICK_EVERY / 2 else shown).copy()
                shown[FAP_NUMBER["head_yaw"] - 1] = frame_time % 16000  # every picture is another
            values = shown.astype("<f4").tobytes()
            faps.send(
                FapFrame(**stamp, media_time=frame_time, values=values, mask=bytes(MASK_BYTES))
            )
        if self._sequence % 10 == 0:
            phones.send(
                Phone(
                    **stamp,
                    media_time=self._media_time,
                    index=self._sequence // 10,
                    symbol=self.symbol,
                    duration=3200,
                    confidence=0.9,
                    final=True,
                )
            )

    def _sound(self) -> NDArray[np.int16]:
        """Return the next samples, of a tone, or of clicks when a flash has half begun."""
        times = self._media_time + np.arange(FRAME)
        if self.flash is not None:
            sound = np.where((times + FRAME // 2) % CLICK_EVERY == 0, 20000.0, 0.0)
        else:
            sound = 3000 * np.sin(2 * np.pi * 200 / 16000 * times)
        return sound.astype(np.int16)


class Gateway:
    """A gateway process; settings by their keys."""

    def __init__(self, control: str, port: int, **settings: str) -> None:
        scheme = "https" if "certificate" in settings else "http"
        self.page = f"{scheme}://127.0.0.1:{port}/"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "kouxing.services.gateway"],
            cwd=ROOT,
            env={
                **os.environ,
                "KOUXING_CONTROL": control.partition(" ")[0],
                "KOUXING_GATEWAY_PORT": str(port),
                "KOUXING_LOG_LEVEL": "error",
                **{variable("gateway", key): value for key, value in settings.items()},
            },
        )

    def stop(self) -> int:
        self.process.terminate()
        return self.process.wait(60)
