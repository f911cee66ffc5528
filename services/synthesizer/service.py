"""The synthesizer as a service: phones in, FAP frames out.

Reacts to: phone, speech, progress, spoken (recognizer), start, stop, drop (control).
Emits: fap, end (subscribers), ack (recognizer).

Frames are clocked by the audio that was heard, so a system under load is late, never wrong, and
audio faster than real time gives the same frames. Only when a live stream stalls does the wall
clock take over, to lead the face to rest.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.live import REST_S, LiveSynthesizer
from services.synthesizer.parameters import load_parameters
from shared.clock import to_samples, to_seconds
from shared.config import SynthesizerConfig, reachable
from shared.faps import MASK_BYTES, NUM_FAPS
from shared.logs import LOG
from shared.messages import (
    EndOfFaps,
    EndOfPhones,
    FapFrame,
    Message,
    PhoneHeard,
    Progress,
    Speech,
    StartSession,
)
from shared.phones import UNIT_INDEX, Phone, SpeechChange
from shared.reliable import ReliableReceiver
from shared.service import Service

STALL_S = 0.2  # a live stream silent for so long has stalled
LONGEST_GAP_S = 10.0  # of media time that is filled with frames
LOW_LEVEL_FAPS = range(2, NUM_FAPS)  # FAP 1 and 2 are not used; the others all are
MASK = sum(1 << index for index in LOW_LEVEL_FAPS).to_bytes(MASK_BYTES, "little")


class _Face:
    """One session's face."""

    def __init__(self, start: StartSession, live: LiveSynthesizer) -> None:
        self.start = start
        self.live = live
        self.receiver: ReliableReceiver | None = None
        self.epoch_in = 0  # of the newest message from the recognizer
        self.heard_media_s = 0.0  # media time of that message
        self.sequence_out = 0
        self.media_time = 0  # of the newest frame
        self.heard_s = time.monotonic()
        self.relaxed_s = 0.0  # until when frames were made without audio
        self.finished = False


class SynthesizerService(Service):
    """The synthesizer process."""

    name = "synthesizer"

    def __init__(self, config: SynthesizerConfig) -> None:
        super().__init__(config)
        self._frame_rate_hz = config.frame_rate_hz
        self._gesture_seed = config.gesture_seed or None
        self._look_ahead_s = config.look_ahead_ms / 1e3
        self._faces: dict[str, _Face] = {}
        self._input = self.bus.bind_router(config.phones, "synthesizer.phones")
        self._faps = self.bus.bind_publisher(config.faps, "synthesizer.faps")
        self.endpoints = {
            "phone_input": reachable(self._input.endpoint, config.advertise, "synthesizer.phones"),
            "faps": reachable(self._faps.endpoint, config.advertise, "synthesizer.faps"),
        }
        self._parameters = load_parameters()
        self.listen(
            self._input,
            {
                PhoneHeard: self._on_input,
                Speech: self._on_input,
                Progress: self._on_input,
                EndOfPhones: self._on_input,
            },
        )
        self.listen(self._faps, {})

    def start_session(self, start: StartSession) -> bool:
        """Make a face at rest; a session that moved here again keeps its own."""
        face = self._faces.get(start.session)
        if face is None or face.start.token != start.token:
            live = LiveSynthesizer(
                self._parameters,
                frame_rate_hz=self._frame_rate_hz,
                look_ahead_s=self._look_ahead_s,
                gesture_seed=self._gesture_seed,
            )
            face = _Face(start, live)
            face.receiver = ReliableReceiver(self._input, start.session)
            self._faces[start.session] = face
        face.start = start
        return True

    def stop_session(self, session: str) -> None:
        """Forget a session."""
        face = self._faces.pop(session, None)
        if face is not None and not face.finished:
            self._end(session, face)

    def flush_session(self, session: str) -> None:
        """Drop what is queued; the frames to come lead to rest."""
        face = self._faces.get(session)
        if face is not None:
            face.live.flush()

    def on_tick(self, now_s: float) -> None:
        """Acknowledge, and lead faces to rest whose live stream has stalled."""
        for session, face in self._faces.items():
            if face.receiver is not None:
                face.receiver.tick()
            if face.start.paced and not face.finished and now_s - face.heard_s > STALL_S:
                self._relax(session, face, now_s)

    def idle_s(self) -> dict[str, float]:
        """Name the sessions served, so that control can say which of them are no more."""
        return dict.fromkeys(self._faces, 0.0)

    def on_drain(self) -> bool:
        """Lead every face to rest and end its stream."""
        for session, face in self._faces.items():
            if not face.finished:
                num_frames = round(REST_S * self._frame_rate_hz)
                self._publish(session, face, face.live.relax(num_frames))
                self._end(session, face)
        return True

    def _relax(self, session: str, face: _Face, now_s: float) -> None:
        begin_s = max(face.relaxed_s, face.heard_s + STALL_S)
        num_frames = int((now_s - begin_s) * self._frame_rate_hz)
        if num_frames > 0:
            face.relaxed_s = begin_s + num_frames / self._frame_rate_hz
            # Media time stands still with the audio; the sequence number goes on.
            self._publish(session, face, face.live.relax(num_frames))

    # --- from the recognizer ---------------------------------------------------------------------

    def _on_input(self, message: Message, sender: bytes) -> None:
        face = self._faces.get(message.session)
        if face is None or face.receiver is None:
            self.warn("unknown-session", "phones of an unknown session", message.session)
            return
        if message.epoch != face.start.epoch:  # sent again until control has told both ends
            self.metrics.count("other_epoch")
            return
        if not face.receiver.accept(message, sender):
            self.metrics.count("repeated")
            return
        if isinstance(message, PhoneHeard) and message.unit not in UNIT_INDEX:
            self.warn("unknown-unit", f"{message.unit!r} is none of the 60 units", message.session)
            return
        started_s = time.perf_counter()
        face.heard_s = time.monotonic()
        time_s = to_seconds(message.media_time)
        # After a crash the recognizer counts its units anew; after a long gap nobody wants the
        # frames in between.
        is_new_epoch = message.epoch not in (face.epoch_in, face.epoch_in or 1)
        if is_new_epoch or time_s - face.heard_media_s > LONGEST_GAP_S:
            face.live.reset(max(0.0, time_s - self._look_ahead_s))
        face.epoch_in, face.heard_media_s = message.epoch, time_s
        if isinstance(message, PhoneHeard):
            face.live.accept_phone(
                Phone(
                    index=message.index,
                    unit=message.unit,
                    onset_s=time_s,
                    duration_s=to_seconds(message.duration),
                    confidence=message.confidence,
                    final=message.final,
                )
            )
        elif isinstance(message, Speech):
            face.live.accept_speech(SpeechChange(active=message.active, time_s=time_s))
        elif isinstance(message, Progress):
            face.live.accept_level(time_s, message.level_db)
            self._publish(message.session, face, face.live.advance(time_s))
            self.metrics.observe("progress_ms", (time.perf_counter() - started_s) * 1e3)
        elif isinstance(message, EndOfPhones):
            self._finish(message.session, face, time_s)

    # --- out -------------------------------------------------------------------------------------

    def _finish(self, session: str, face: _Face, time_s: float) -> None:
        """Make the frames that are owed up to the last sample, and those that lead to rest."""
        face.live.accept_speech(SpeechChange(active=False, time_s=time_s))
        frames = face.live.advance(time_s + self._look_ahead_s + REST_S)
        self._publish(session, face, frames)
        self._end(session, face)

    def _end(self, session: str, face: _Face) -> None:
        face.finished = True
        face.sequence_out += 1
        self._faps.send(
            EndOfFaps(
                session=session,
                epoch=face.start.epoch,
                sequence=face.sequence_out,
                media_time=face.media_time,
            )
        )
        LOG.info("end of frames", extra={"session": session})

    def _publish(
        self, session: str, face: _Face, frames: Sequence[tuple[float, NDArray[np.float32]]]
    ) -> None:
        self.metrics.count("out_fap", len(frames))
        for time_s, faps in frames:
            face.sequence_out += 1
            face.media_time = to_samples(time_s)
            self._faps.send(
                FapFrame(
                    session=session,
                    epoch=face.start.epoch,
                    sequence=face.sequence_out,
                    media_time=face.media_time,
                    values=faps.astype("<f4").tobytes(),
                    mask=MASK,
                )
            )
