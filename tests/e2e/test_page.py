"""The page in a real browser: FAP frames to pixels, sound to the ear, a microphone to PCM.

Control and gateway are the real ones; recognizer and synthesizer only play a script, so that what
the page has to show is known. The browser is driven by the Chrome DevTools Protocol.
"""

from __future__ import annotations

import asyncio
import base64
import io
import json
import os
import shutil
import socket
import subprocess
import sys
import threading
import time
import wave
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from services.control.config import ControlConfig
from services.control.service import ControlService
from services.recognizer.config import RecognizerConfig
from services.synthesizer.config import SynthesizerConfig
from shared.client import Client, Session
from shared.face.faps import MASK_BYTES, NUM_FAPS
from shared.service import Service
from shared.wire.audio import AudioChunk, EndOfAudio, Sound
from shared.wire.control import StartSession
from shared.wire.face import FapFrame
from shared.wire.speech import Phone

pytestmark = pytest.mark.e2e

ROOT = Path(__file__).parents[2]
HEAD = ROOT / "services" / "gateway" / "page" / "head.glb"
SIZE_PX = (640, 480)
FRAME = 320  # samples; 20 ms
LOOK_AHEAD_MS = 60
# Rows 15 (a) and 13 (b) of the Mandarin viseme table: FAP number to value.
FAP_COLUMNS = [*range(3, 15), 16, 17, 44, 45, 46, 47, *range(51, 61)]
A_VALUES = [
    *(450, -280, -600, -40, -40, -220, -220, -520, -520, -70, -70, 0, 0, 70),
    *(-210, -100, -220, 120, -260, -510, -40, -40, -230, -230, -520, -520, -20, -20),
]
B_VALUES = [
    *(0, 0, 0, -50, -50, 0, 0, 0, 0, -20, -20, 0, 50, 50),
    *(-120, -50, -120, 0, 10, 80, -100, -100, 10, 10, 30, 30, -30, -30),
]


def face(values: list[int]) -> NDArray[np.float32]:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(FAP_COLUMNS) - 1] = values
    return faps


A_FACE, B_FACE = face(A_VALUES), face(B_VALUES)


class ScriptedRecognizer(Service):
    """Publishes what the test says, and keeps the audio that it gets."""

    name = "recognizer"
    role = "worker"
    needs = ("phone_input",)

    def __init__(self, control: str) -> None:
        local = "tcp://127.0.0.1:*"
        super().__init__(RecognizerConfig(control=control, audio=local, phones=local))
        self.audio = self.bus.bind_router(local, "recognizer.audio")
        self.phones = self.bus.bind_publisher(local, "recognizer.phones")
        self.endpoints = {"audio": self.audio.endpoint, "phones": self.phones.endpoint}
        self.pcm: dict[str, bytes] = {}
        self.starts: dict[str, StartSession] = {}
        self.finished: set[str] = set()
        self.register(
            self.audio,
            {
                AudioChunk: self._on_audio,
                EndOfAudio: lambda end, _: self.finished.add(end.session),
            },
        )
        self.register(self.phones, {})

    def start_session(self, start: StartSession) -> bool:
        self.starts[start.session] = start
        return True

    def _on_audio(self, chunk: AudioChunk, _sender: bytes) -> None:
        self.pcm[chunk.session] = self.pcm.get(chunk.session, b"") + chunk.pcm


class ScriptedSynthesizer(Service):
    """Publishes the FAP frames that the test says."""

    name = "synthesizer"
    role = "worker"

    def __init__(self, control: str) -> None:
        local = "tcp://127.0.0.1:*"
        super().__init__(SynthesizerConfig(control=control, phone_input=local, faps=local))
        self.input = self.bus.bind_router(local, "synthesizer.phones")
        self.faps = self.bus.bind_publisher(local, "synthesizer.faps")
        self.endpoints = {"phone_input": self.input.endpoint, "faps": self.faps.endpoint}
        self.lips: list[tuple[str, str]] = []  # session, lip model chosen
        self.register(self.input, {})
        self.register(self.faps, {})

    def use_lips(self, session: str, lips: str) -> None:
        self.lips.append((session, lips))


class System:
    """Control, and the two scripted services, on a thread that plays the script in real time."""

    def __init__(self) -> None:
        local = "tcp://127.0.0.1:*"
        self.control = ControlService(ControlConfig(commands=local, events=local))
        self.address = self.control.endpoints["commands"]
        self.synthesizer = ScriptedSynthesizer(self.address)
        self.recognizer: ScriptedRecognizer | None = ScriptedRecognizer(self.address)
        self.shown: NDArray[np.float32] | None = None  # the face that is published; None: nothing
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
                self.recognizer.drain()
                self.recognizer = None
            now_s = time.monotonic()
            if now_s >= due_s:
                due_s = max(due_s + FRAME / 16000, now_s - 0.1)
                self._publish()
        for service in reversed(self.services()):
            service.drain()

    def _publish(self) -> None:
        shown = self.shown
        if shown is None or self.recognizer is None:
            return
        start = self.recognizer.starts.get(self.session)
        if start is None:
            return
        self._sequence += 1
        tone = 3000 * np.sin(2 * np.pi * 200 / 16000 * (self._media_time + np.arange(FRAME)))
        stamp: dict[str, Any] = {
            "session": self.session,
            "epoch": start.epoch,
            "sequence": self._sequence,
        }
        phones, faps = self.recognizer.phones, self.synthesizer.faps
        pcm = tone.astype("<i2").tobytes()
        phones.send(Sound(**stamp, media_time=self._media_time, pcm=pcm))
        self._media_time += FRAME
        frame_time = self._media_time - LOOK_AHEAD_MS * 16
        if frame_time >= 0:
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


class Gateway:
    """A gateway process."""

    def __init__(self, control: str, port: int) -> None:
        self.page = f"http://127.0.0.1:{port}/"
        self.process = subprocess.Popen(
            [sys.executable, "-m", "services.gateway"],
            cwd=ROOT,
            env={
                **os.environ,
                "KOUXING_CONTROL": control,
                "KOUXING_GATEWAY_PORT": str(port),
                "KOUXING_LOG_LEVEL": "error",
            },
        )

    def stop(self) -> int:
        self.process.terminate()
        return self.process.wait(10)


class Browser:
    """A headless Chromium with one page."""

    def __init__(self, folder: Path, microphone: Path) -> None:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        if program is None:
            pytest.fail("no Chromium is installed")
        self._process = subprocess.Popen(
            [
                program,
                *("--headless", "--no-sandbox", "--disable-gpu", "--use-gl=angle"),
                *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic"),
                *("--no-first-run", "--disable-background-networking", "--disable-sync"),
                *(
                    "--disable-component-update",
                    "--autoplay-policy=document-user-activation-required",
                ),
                *("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"),
                f"--use-file-for-fake-audio-capture={microphone}",
                f"--window-size={SIZE_PX[0]},{SIZE_PX[1]}",
                f"--user-data-dir={folder}",
                "--remote-debugging-port=0",
                "about:blank",
            ],
            stderr=subprocess.DEVNULL,
        )
        self._loop = asyncio.new_event_loop()
        self._num_sent = 0
        self.complaints: list[str] = []
        port_file = folder / "DevToolsActivePort"
        wait_until(lambda: port_file.is_file() and "\n" in port_file.read_text(), 20)
        self._port = int(port_file.read_text().split()[0])
        self._loop.run_until_complete(self._connect())
        self.command("Runtime.enable")
        self.command("Log.enable")
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=SIZE_PX[0],
            height=SIZE_PX[1],
            deviceScaleFactor=1,
            mobile=False,
        )

    async def _connect(self) -> None:
        self._http = aiohttp.ClientSession()
        async with self._http.get(f"http://127.0.0.1:{self._port}/json/list") as answer:
            targets = await answer.json()
        url = next(target for target in targets if target["type"] == "page")["webSocketDebuggerUrl"]
        self._socket = await self._http.ws_connect(url, max_msg_size=0)

    def close(self) -> None:
        async def close() -> None:
            await self._socket.close()
            await self._http.close()

        self._loop.run_until_complete(close())
        self._loop.close()
        self._process.terminate()
        self._process.wait(10)

    def command(self, method: str, **parameters: object) -> dict[str, Any]:
        """Run a command of the protocol."""
        return self._loop.run_until_complete(self._command(method, parameters))

    async def _command(self, method: str, parameters: dict[str, object]) -> dict[str, Any]:
        self._num_sent += 1
        message = {"id": self._num_sent, "method": method, "params": parameters}
        await self._socket.send_json(message)
        while True:
            answer = await self._socket.receive_json(timeout=20)
            if answer.get("method") in ("Runtime.exceptionThrown", "Log.entryAdded"):
                self.complaints.append(json.dumps(answer["params"]))
            if answer.get("id") == self._num_sent:
                if "error" in answer:
                    raise RuntimeError(answer["error"])
                result: dict[str, Any] = answer["result"]
                return result

    def evaluate(self, script: str) -> Any:
        """Return the value of an expression of the page."""
        result = self.command(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in result:
            raise RuntimeError(result["exceptionDetails"])
        return result["result"].get("value")

    def click(self, name: str) -> None:
        """Click on an element as a person does, which lets the page play sound."""
        x, y = self.evaluate(
            f"(() => {{ const box = document.getElementById('{name}').getBoundingClientRect();"
            "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
        )
        for event in ("mousePressed", "mouseReleased"):
            self.command(
                "Input.dispatchMouseEvent", type=event, x=x, y=y, button="left", clickCount=1
            )

    def wait_for(self, condition: str, limit_s: float = 20) -> None:
        """Wait until an expression becomes true."""
        try:
            wait_until(lambda: bool(self.evaluate(condition)), limit_s)
        except TimeoutError:
            state = self.evaluate("JSON.stringify(window.kouxing?.state)")
            raise TimeoutError(f"{condition}; state {state}; {self.complaints}") from None

    def steady_image(self) -> NDArray[np.uint8]:
        """Return the canvas once it no longer changes: every fade and redrawing is over."""
        images = [self.image()]

        def is_steady() -> bool:
            images.append(self.image())
            return np.array_equal(images[-1], images[-2])

        wait_until(is_steady, 15)
        return images[-1]

    def image(self) -> NDArray[np.uint8]:
        """Return the canvas as it is seen: shape (height, width, 3)."""
        data = self.command("Page.captureScreenshot", format="png")["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB"))


def wait_until(condition: Any, limit_s: float) -> None:
    end_s = time.monotonic() + limit_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError
        time.sleep(0.03)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port: int = listener.getsockname()[1]
        return port


def write_tone(path: Path) -> None:
    """Write a 300 Hz tone that comes and goes, so that nothing filters it out."""
    time_s = np.arange(2 * 48000) / 48000
    tone = 0.4 * np.sin(2 * np.pi * 300 * time_s) * (np.sin(2 * np.pi * 2 * time_s) > 0)
    with wave.open(str(path), "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(48000)
        file.writeframes((tone * 32767).astype("<i2").tobytes())


@pytest.fixture(scope="module")
def system() -> Iterator[System]:
    system = System()
    yield system
    system.close()


@pytest.fixture(scope="module")
def gateway(system: System) -> Iterator[Gateway]:
    if not HEAD.is_file():
        kouxing = Path(sys.executable).with_name("kouxing")
        subprocess.run([kouxing, "head", "export", HEAD], cwd=ROOT, check=True)
    gateway = Gateway(system.address, free_port())
    yield gateway
    assert gateway.stop() == 0


@pytest.fixture(scope="module")
def browser(gateway: Gateway, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    folder = tmp_path_factory.mktemp("browser")
    write_tone(folder / "tone.wav")
    browser = Browser(folder, folder / "tone.wav")
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def session(system: System, gateway: Gateway) -> Iterator[Session]:
    with Client(system.address) as client:
        wait_until(lambda: len(client.status().services) == 4, 30)
        yield client.open_session(session="seen")


def colour(image: NDArray[np.uint8]) -> NDArray[np.int_]:
    """Return how coloured each pixel is, 0 to 255."""
    levels = image.astype(np.int_)
    spread: NDArray[np.int_] = levels.max(axis=2) - levels.min(axis=2)
    return spread


def teeth(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return where an image is bright and has no colour, unlike skin and lips."""
    found: NDArray[np.bool_] = (colour(image) < 35) & (image.mean(axis=2) > 100)
    return found


def test_the_mouth_on_the_screen_follows_the_faps(
    system: System, session: Session, browser: Browser, gateway: Gateway
) -> None:
    system.talk(session.name, B_FACE, "b")
    browser.command("Page.navigate", url=gateway.page)
    browser.wait_for("document.getElementById('loading')?.hidden && window.kouxing.state.connected")
    browser.evaluate(
        "for (const name of ['header', 'footer']) document.querySelector(name).style.opacity = 0"
    )
    show = "Math.abs(window.kouxing.state.faps[2] - {}) < 1 && window.kouxing.state.phone === '{}'"

    browser.wait_for(show.format(0, "b"))
    closed = browser.steady_image()
    system.talk(session.name, A_FACE, "a")
    browser.wait_for(show.format(450, "a"))
    opened = browser.steady_image()
    system.talk(session.name, B_FACE, "b")
    browser.wait_for(show.format(0, "b"))
    closed_again = browser.steady_image()

    # The page may draw the second picture at another resolution: then the edges of the hair change
    # too, so only the lower middle of the face counts.
    height, width = opened.shape[:2]
    face = np.zeros((height, width), bool)
    face[height // 2 : height * 3 // 4, width * 42 // 100 : width * 58 // 100] = True
    rows, columns = np.nonzero(teeth(opened) & (colour(closed) > 50) & face)
    (top, bottom), (left, right) = (
        np.percentile(at, (15, 85)).astype(int) for at in (rows, columns)
    )
    mouth = slice(top, bottom + 1), slice(left, right + 1)
    assert (left + right) / 2 == pytest.approx(SIZE_PX[0] / 2, abs=8)
    assert 0 < bottom - top < right - left < SIZE_PX[0] / 5
    assert teeth(opened)[mouth].mean() > 0.5
    assert teeth(closed)[mouth].mean() < 0.02
    assert teeth(closed_again)[mouth].mean() < 0.02
    wrong = ('"level": "error"', "exceptionDetails")
    assert not [text for text in browser.complaints if any(mark in text for mark in wrong)]


def simulate(browser: Browser, script: str) -> Any:
    """Run the page's playout rule on arrivals of the test's own making.

    ``frames(from, to, lateness)`` lets a frame arrive every 20 ms with the lateness given by a
    function of time, and sound as soon as it was said; ``pause`` is silence of the sender.
    """
    return browser.evaluate(
        """(async () => {
          const { Playout, FapTrack } = await import("/playout.js");
          const playout = new Playout();
          let now = 1000, media = 0, numChanges = 0;
          function frames(num, lateness) {
            for (let i = 0; i < num; i++) {
              now += 20; media += 320;
              playout.soundArrived(now, media - 320, 320);
              playout.frameArrived(now, media - 16 * lateness(i));
              numChanges += playout.adjust(now);
            }
            return playout.delayMs;
          }
          """
        + script
        + "})()"
    )


def test_the_delay_follows_the_frames_by_halves_outside_a_dead_zone(browser: Browser) -> None:
    first, changes_first, near, changes_near, far, later = simulate(
        browser,
        """
        const first = frames(200, () => 100), changesFirst = numChanges;
        const near = frames(1000, () => 125), changesNear = numChanges;
        const far = frames(25, () => 240);
        return [first, changesFirst, near, changesNear, far, frames(1000, () => 240)];
        """,
    )

    assert (first, changes_first) == (pytest.approx(120), 0)  # 100 + a display frame is near
    assert (near, changes_near) == (pytest.approx(120), 0)  # an error of 22 ms is left alone
    assert far == pytest.approx(near, abs=70)  # half a second of bad network: at most half of it
    assert later == pytest.approx(240 + 1000 / 60, abs=30)


def test_a_pause_of_the_sender_is_no_delay(browser: Browser) -> None:
    before, after, media_late = simulate(
        browser,
        """
        const before = frames(200, () => 100);
        now += 5000;
        const after = frames(200, () => 100);
        return [before, after, media - playout.mediaAt(now)];
        """,
    )

    assert before == after == pytest.approx(120)
    assert media_late == pytest.approx(120 * 16)


def test_a_burst_after_a_stalled_network_does_not_leave_a_lasting_delay(browser: Browser) -> None:
    delay = simulate(
        browser,
        """
        frames(200, () => 100);
        now += 1000;
        for (let i = 0; i < 50; i++) { now -= 20; frames(1, () => 100); }
        return frames(100, () => 100);
        """,
    )

    assert delay == pytest.approx(120, abs=30)


def test_faces_between_two_frames_are_interpolated_by_media_time(browser: Browser) -> None:
    assert simulate(
        browser,
        """
        const track = new FapTrack(), out = new Float32Array(1);
        const at = (time) => (track.sample(time, out), out[0]);
        const nothing = track.sample(0, out);
        track.push(0, [0]); track.push(320, [100]); track.push(640, [50]);
        const shown = [at(-50), at(0), at(80), at(320), at(480), at(640), at(9999)];
        const isNew = track.push(640, [20]);  // the sound stands still, the face does not
        return [nothing, ...shown, isNew, at(9999)];
        """,
    ) == [False, 0, 0, 25, 100, 75, 50, 50, False, 20]


def test_sound_waits_for_a_click_where_the_browser_wants_one_and_then_meets_its_picture(
    system: System, session: Session, browser: Browser
) -> None:
    system.talk(session.name, A_FACE, "a")
    browser.wait_for("window.kouxing.state.sound === 'blocked'")
    browser.wait_for("window.kouxing.state.faps[2] > 440")  # the face does not wait
    assert "Turn on sound" in browser.evaluate("document.getElementById('sound').textContent")
    browser.click("sound")
    browser.wait_for("window.kouxing.state.sound === 'on'")
    played = browser.evaluate("window.kouxing.state.soundSamplesPlayed")
    browser.wait_for(f"window.kouxing.state.soundSamplesPlayed > {played + 16000}")
    # Both are null while the sound waits for more, as it may on a busy machine.
    settled = "state.playoutDelayMs !== null && state.playoutDelayMs < 400"
    held = f"((state) => {settled} && state.soundMinusPictureMs !== null ? state : null)"
    states: list[dict[str, Any]] = []

    def is_settled() -> bool:
        state = browser.evaluate(f"{held}(window.kouxing.state)")
        if state is not None:
            states.append(state)
        return bool(states)

    wait_until(is_settled, 20)
    (state,) = states
    assert state["playoutDelayMs"] > LOOK_AHEAD_MS - 20
    assert abs(state["soundMinusPictureMs"]) < 45  # detectable according to ITU-R BT.1359


def test_the_face_goes_to_rest_when_the_stream_stalls_and_comes_back(
    system: System, session: Session, browser: Browser
) -> None:
    system.talk(session.name, A_FACE, "a")
    browser.wait_for("window.kouxing.state.faps[2] > 440")
    system.shown = None
    browser.wait_for("window.kouxing.state.faps.every((value) => Math.abs(value) < 1)", 3)
    system.shown = A_FACE
    browser.wait_for("window.kouxing.state.faps[2] > 440", 3)


def test_the_microphone_reaches_the_recognizer(system: System, browser: Browser) -> None:
    system.shown = None
    recognizer = system.recognizer
    assert recognizer is not None
    browser.click("microphone")
    browser.wait_for("window.kouxing.state.microphone")
    (name,) = set(recognizer.starts) - {"seen"}
    wait_until(lambda: len(recognizer.pcm.get(name, b"")) > 2 * 48000, 10)
    browser.wait_for(f"window.kouxing.state.session === '{name}'")
    assert browser.evaluate("window.kouxing.state.sound") == "off"  # one's own voice
    browser.click("microphone")
    wait_until(lambda: name in recognizer.finished, 5)
    browser.wait_for("!window.kouxing.state.microphone && window.kouxing.state.session === 'seen'")

    start = recognizer.starts[name]
    assert (start.sample_rate_hz, start.num_channels, start.encoding) in (
        (44100, 1, "s16le"),
        (48000, 1, "s16le"),
    )
    samples = np.frombuffer(recognizer.pcm[name], "<i2").astype(float)
    assert np.sqrt((samples**2).mean()) > 300


def test_the_lips_are_switched_while_the_microphone_is_on(system: System, browser: Browser) -> None:
    system.synthesizer.lips.clear()
    browser.click("lips")  # counts for the microphone to come
    browser.wait_for("window.kouxing.state.lips === 'learnt'")
    browser.click("microphone")
    wait_until(lambda: len(system.synthesizer.lips) == 1, 10)
    browser.click("lips")
    browser.wait_for("window.kouxing.state.lips === 'dynamic-visemes'")
    wait_until(lambda: len(system.synthesizer.lips) == 2, 10)
    browser.click("microphone")
    browser.wait_for("!window.kouxing.state.microphone && window.kouxing.state.session === 'seen'")
    (first, second) = system.synthesizer.lips
    assert first[0] == second[0] != "seen"
    assert [first[1], second[1]] == ["learnt", "dynamic-visemes"]


def test_the_page_says_what_is_missing(system: System, browser: Browser) -> None:
    browser.wait_for("document.getElementById('notice').hidden")
    system.lose_recognizer()
    browser.wait_for("document.getElementById('notice').textContent.includes('no recognizer')")
    browser.click("microphone")
    browser.wait_for("document.getElementById('notice').textContent.includes('kouxing recognizer')")
    browser.wait_for("!window.kouxing.state.microphone")


def test_the_page_connects_again_by_itself(
    system: System, gateway: Gateway, browser: Browser
) -> None:
    port = int(gateway.page.rstrip("/").rsplit(":", 1)[1])
    assert gateway.stop() == 0
    browser.wait_for("!window.kouxing.state.connected")
    assert "connecting" in browser.evaluate("document.getElementById('status').textContent")
    gateway.process = Gateway(system.address, port).process
    browser.wait_for("window.kouxing.state.connected", 15)
