"""The synthesizer as a service: phones and lips in, FAP frames out.

Reacts to: phone, lips, speech, progress, resume-face (recognizer), start-session, stop-session,
flush-session, set-face (control).
Emits: fap-frame, end-of-faps (followers), acknowledge-phones (recognizer).

Frames are clocked by the audio that was processed, so a system under load is late, never wrong, and
audio faster than real time gives the same frames. Only when a live stream stalls does the wall
clock take over, to lead the face to rest.
"""

from __future__ import annotations

import itertools
import math
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face import REST_S, Face, Frame
from kouxing.services.synthesizer.kind import KIND
from kouxing.services.synthesizer.lips.load import LIP_MODELS, load_lip_model
from kouxing.shared.bus import PHONES, Socket
from kouxing.shared.clock import to_samples, to_seconds
from kouxing.shared.endpoints import key_of
from kouxing.shared.face.expressions import ExpressionName
from kouxing.shared.face.faps import MASK_BYTES, NUM_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.keys import Peer
from kouxing.shared.logs import LOG
from kouxing.shared.message_loop import Handler
from kouxing.shared.phones import events
from kouxing.shared.phones.events import EndOfSound, LipFrame, Phone, SoundEvent
from kouxing.shared.phones.final_time import FinalTime
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory
from kouxing.shared.reliable import ReliableReceiver
from kouxing.shared.service import Service
from kouxing.shared.wire.control import EventName, SessionInput, StartSession
from kouxing.shared.wire.events import LINK_MESSAGES, LinkMessage, SpeechMessage, event_of
from kouxing.shared.wire.face import EndOfFaps, FaceSettings, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import ErrorCode, SessionFacts
from kouxing.shared.wire.speech import (
    AcknowledgePhones,
    AudioState,
    NewestFrame,
    Progress,
    ResumeFace,
)

LOST_S = 20.0  # without a word from a recognizer, which would tell that its client is silent
AGAIN_S = 3.0  # for which followers of a session that has moved here may still be on their way
MAX_AT_ONCE_S = 0.06  # of frames of a session: those of a gap must not hold others up
MAX_WAITING = 200  # messages while they are made; the recognizer sends the next ones again
MADE_UP_S = 0.2  # of frames without sound, when they are late
EXPRESSIONS = frozenset(ExpressionName)
LOW_LEVEL_FAPS = range(2, NUM_FAPS)  # FAP 1 and 2 are not used; the others all are
MASK = sum(1 << index for index in LOW_LEVEL_FAPS).to_bytes(MASK_BYTES, "little")


class _Session:
    """One session: its face, and its place among messages."""

    def __init__(self, start: StartSession, face: Face, input_socket: Socket) -> None:
        self.start = start
        self.face = face
        self.receiver = ReliableReceiver(input_socket, start.session, self._acknowledge)
        self.epoch_in = 0  # of the newest message from the recognizer; 0: there is none
        self.relaxes_s = time.monotonic() + LOST_S  # from when on frames come without sound
        self.sequence_out = 0
        self.shown: FapFrame | None = None  # the newest frame
        self.final = FinalTime()
        self.waiting: deque[SoundEvent] = deque()  # while frames are made of the first
        self.frames: Iterator[Frame] | None = None  # of that, not made yet
        self.finished = False
        self._resumed_s = -math.inf  # when it took another synthesizer's place
        self.shapes: list[str] = []  # sets that are published
        self.since_then: list[FapFrame | EndOfFaps] = []  # published of late

    def resume(self, media_time: int, frame: int, faps: NDArray[np.float32] | None) -> None:
        """Go on behind the newest frame of another synthesizer."""
        self._resumed_s = time.monotonic()
        self.sequence_out = frame
        self.face.resume(to_seconds(media_time), frame, faps)

    @property
    def just_resumed(self) -> bool:
        """Whether its followers may still be on their way here."""
        return time.monotonic() < self._resumed_s + AGAIN_S

    @property
    def media_time(self) -> int:
        """Media time of the newest frame, samples at 16 kHz."""
        return self.shown.media_time if self.shown is not None else 0

    def _acknowledge(self) -> AcknowledgePhones:
        if self.shown is None:
            return AcknowledgePhones()
        frame = NewestFrame(
            sequence=self.shown.sequence,
            media_time=self.shown.media_time,
            values=self.shown.values,
        )
        return AcknowledgePhones(newest_frame=frame)


class SynthesizerService(Service):
    """The synthesizer process."""

    kind = KIND

    def __init__(self, config: SynthesizerConfig) -> None:
        super().__init__(config)
        self._config = config
        self.frame_rate_hz = config.frame_rate_hz
        self.facts = SessionFacts(
            frame_rate_hz=config.frame_rate_hz, delay_ms=config.delay_ms, lips=config.lips
        )
        self._sessions: dict[str, _Session] = {}
        self._turn = 0  # of sessions with many frames to make
        self._dropped_s = 0.0  # when frames were dropped that nobody takes
        self._input = self.bus.bind_router(
            config.phone_input, "synthesizer.phone_input", PHONES, role="service"
        )
        self._faps = self.bus.bind_publisher(config.faps, "synthesizer.faps", self._on_joined)
        self.endpoints = {
            "phone_input": config.reachable(self._input.endpoint),
            "faps": config.reachable(self._faps.endpoint),
        }
        load_lip_model(name=config.lips)  # the first session waits for nothing
        self.register(self._input, dict.fromkeys(LINK_MESSAGES, self._on_input))
        self.register(self._faps, {})

    def control_handlers(self) -> dict[type[Message], Handler]:
        """Return the handlers of control's messages."""
        return super().control_handlers() | {SetFace: self._on_set_face}

    def start_session(self, start: StartSession) -> bool:
        """Make a face at rest; a session that moved here again keeps its own."""
        session = self._sessions.get(start.session)
        if session is None or session.start.token != start.token:
            session = _Session(start, self._new_face(start), self._input)
            session.shapes = self._known_settings(start.session, start.face).shapes or []
            self._sessions[start.session] = session
        session.start = start
        self.session_started(start, to_samples(session.final.time_s))
        return False

    def _new_face(self, start: StartSession) -> Face:
        settings = self._known_settings(start.session, start.face)
        face = Face(
            load_lip_model(
                start.facts.language or DEFAULT_LANGUAGE, settings.lips or self._config.lips
            ),
            frame_rate_hz=self.frame_rate_hz,
            delay_s=self._config.delay_ms / 1e3,
            idle_motion_seed=self._config.idle_motion_seed,
            expressiveness=settings.expressiveness or self._config.expressiveness,
        )
        if settings.expressions:
            face.express(settings.expressions, settings.hold_s)
        return face

    def stop_session(self, session: str) -> None:
        """Forget a session."""
        found = self._sessions.pop(session, None)
        if found is not None and not found.finished and not self.should_exit:
            self._end(found)

    def flush_session(self, session: str) -> None:
        """Drop what is queued; the frames to come lead to rest."""
        found = self._sessions.get(session)
        if found is not None:
            found.waiting = deque(
                event for event in found.waiting if not isinstance(event, Phone | LipFrame)
            )
            found.face.flush()

    def _on_set_face(self, message: SetFace, _sender: Peer) -> None:
        """Change how a face moves, from where it is."""
        session = self._sessions.get(message.session)
        if session is None:
            return
        settings = self._known_settings(message.session, message.face)
        if settings.lips is not None:
            language = session.start.facts.language or DEFAULT_LANGUAGE
            session.face.use_lips(load_lip_model(language, settings.lips))
        if settings.expressiveness is not None:
            session.face.choose_expressiveness(settings.expressiveness)
        if settings.expressions is not None:
            session.face.express(settings.expressions, settings.hold_s)
        session.shapes = list(dict.fromkeys([*session.shapes, *(settings.shapes or ())]))

    def _known_settings(self, session: str, settings: FaceSettings) -> FaceSettings:
        """Return settings without the names that are unknown here, and report these."""
        strengths = (settings.expressions or {}).items()
        known = replace(
            settings,
            lips=settings.lips if settings.lips in LIP_MODELS else None,
            expressions=settings.expressions
            and {name: strength for name, strength in strengths if name in EXPRESSIONS},
            shapes=settings.shapes and [name for name in settings.shapes if name in SHAPE_SETS],
        )
        if known != settings:
            text = f"unknown names in {settings}"
            self.warn(ErrorCode.BAD_FACE, text, session)
            self.publish_event(EventName.ERROR, session, f"{ErrorCode.BAD_FACE}: {text}")
        return known

    def on_tick(self, now_s: float) -> None:
        """Acknowledge, lead faces to rest whose live stream has stalled, drop what grows old."""
        if now_s > self._dropped_s + 1.0:
            self._dropped_s = now_s
            live = [name for name, session in self._sessions.items() if session.start.paced]
            self._faps.disconnect_stalled((FapFrame,), live)
        for session in self._sessions.values():
            session.receiver.tick()
            if session.start.paced and not session.finished and not session.waiting:
                self._relax(session, now_s)
        owing = [session for session in self._sessions.values() if session.waiting]
        if owing:  # one after the other gets its turn
            self._turn += 1
            self._make_frames(owing[self._turn % len(owing)])

    def session_inputs(self) -> dict[str, SessionInput]:
        """Return up to where the phones of each session are final."""
        return {
            name: SessionInput(media_time=to_samples(session.final.time_s))
            for name, session in self._sessions.items()
        }

    def on_drain(self) -> bool:
        """Let others take the sessions; lead the faces that nobody takes to rest, and end them."""
        unfinished = [session for session in self._sessions.values() if not session.finished]
        if unfinished and self.is_handing_over:
            return False
        for session in unfinished:
            self._publish(session, session.face.relax(round(REST_S * self.frame_rate_hz)))
            self._end(session)
        return True

    def _relax(self, session: _Session, now_s: float) -> None:
        # a process that stood still does not make up for it
        session.relaxes_s = max(session.relaxes_s, now_s - MADE_UP_S)
        num_frames = int((now_s - session.relaxes_s) * self.frame_rate_hz)
        if num_frames > 0:
            session.relaxes_s += num_frames / self.frame_rate_hz
            # Media time stands still with the audio; the sequence number goes on.
            self._publish(session, session.face.relax(num_frames))
            session.receiver.acknowledge()

    # --- from the recognizer ---------------------------------------------------------------------

    def _on_input(self, message: LinkMessage, sender: Peer) -> None:
        session = self._admit(message, sender)
        if session is None:
            return
        now_s = time.monotonic()
        has_stalled = isinstance(message, Progress) and message.state == AudioState.STALLED
        session.relaxes_s = now_s if has_stalled else now_s + LOST_S
        if message.epoch != session.epoch_in:
            self._enter_epoch(session, message)
        if not has_stalled and not isinstance(message, ResumeFace):
            self._accept(session, message)

    def _enter_epoch(self, session: _Session, message: LinkMessage) -> None:
        """Let a face go on: with another recognizer, or where another synthesizer's face was."""
        if session.epoch_in:
            session.face.restart()
        elif isinstance(message, ResumeFace):
            frame = message.newest_frame
            session.resume(frame.media_time, frame.sequence, np.frombuffer(frame.values, "<f4"))
        elif message.epoch > 1:  # both were lost, and nobody knows how far the other face came
            time_s = to_seconds(message.media_time)
            session.resume(message.media_time, int(time_s * self.frame_rate_hz), None)
        session.epoch_in = message.epoch

    def _admit(self, message: LinkMessage, sender: Peer) -> _Session | None:
        """Return the session of a message if that is its recognizer's next one."""
        session = self._sessions.get(message.session)
        if session is None:
            self.warn("unknown-session", "phones of an unknown session", message.session)
        elif sender.key != key_of(session.start.endpoints.get("phones", "")):
            self.warn(
                "foreign", "phones from another than the session's recognizer", message.session
            )
        elif message.epoch != session.start.epoch:  # sent again until control has told both ends
            self.metrics.count("other_epoch")
        elif len(session.waiting) >= MAX_WAITING:
            self.metrics.count("too_early")
        elif not session.receiver.receive(message, sender):
            self.metrics.count("repeated")
        else:
            return session
        return None

    def _accept(self, session: _Session, message: SpeechMessage) -> None:
        event = event_of(message)
        language = session.start.facts.language or DEFAULT_LANGUAGE
        if isinstance(event, Phone) and event.symbol not in load_inventory(language).index:
            text = f"{event.symbol!r} is no phone of {language}"
            self.warn("unknown-phone", text, message.session)
            return
        session.final.update(event)
        session.waiting.append(event)
        if len(session.waiting) == 1:
            self._make_frames(session)

    def _make_frames(self, session: _Session) -> None:
        """Publish frames of what came for a session, but not too many at a time."""
        num_left = max(1, round(MAX_AT_ONCE_S * self.frame_rate_hz))
        while session.waiting:
            event = session.waiting[0]
            if session.frames is None:
                session.frames = session.face.frames_of(event)
            started_s = time.perf_counter()
            frames = list(itertools.islice(session.frames, num_left))
            self._publish(session, frames)
            if isinstance(event, events.Progress):
                self.metrics.observe("progress_ms", (time.perf_counter() - started_s) * 1e3)
            num_left -= len(frames)
            if num_left == 0:
                return
            session.frames = None
            session.waiting.popleft()
            if isinstance(event, EndOfSound):
                self._end(session)

    # --- out -------------------------------------------------------------------------------------

    def _end(self, session: _Session) -> None:
        session.finished = True
        session.sequence_out += 1
        self._send(
            session,
            EndOfFaps(
                session=session.start.session,
                epoch=session.start.epoch,
                sequence=session.sequence_out,
                media_time=session.media_time,
            ),
        )
        LOG.info("end of frames", extra={"session": session.start.session})

    def _publish(self, session: _Session, frames: Sequence[Frame]) -> None:
        self.metrics.count("out_fap_frame", len(frames))
        for time_s, faps in frames:
            session.sequence_out += 1
            session.shown = FapFrame(
                session=session.start.session,
                epoch=session.start.epoch,
                sequence=session.sequence_out,
                media_time=to_samples(time_s),
                values=faps.astype("<f4").tobytes(),
                mask=MASK,
                shapes={
                    name: SHAPE_SETS[name].weights(faps).astype("<f4").tobytes()
                    for name in session.shapes
                },
            )
            self._send(session, session.shown)

    def _send(self, session: _Session, message: FapFrame | EndOfFaps) -> None:
        self._faps.send(message)
        if session.just_resumed:
            session.since_then.append(message)
        else:
            session.since_then.clear()

    def _on_joined(self, session: str) -> None:
        """Publish again what came before the followers of a moved session were here."""
        found = self._sessions.get(session)
        if found is not None and found.just_resumed:
            for message in found.since_then:
                self._faps.send(message)
