"""The synthesizer as a service: phones and lips in, FAP frames out.

Reacts to: phone, lips, speech, progress, end-of-phones (recognizer), start-session, stop-session,
flush-now, use-lips, express, choose-expressiveness (control).
Emits: fap-frame, end-of-faps (followers), acknowledge (recognizer).

Frames are clocked by the audio that was processed, so a system under load is late, never wrong, and
audio faster than real time gives the same frames. Only when a live stream stalls does the wall
clock take over, to lead the face to rest.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from services.synthesizer.config import SynthesizerConfig
from services.synthesizer.face import REST_S, Face, Frame
from services.synthesizer.lips.load import load_lip_model
from shared.bus import PHONES
from shared.clock import to_samples, to_seconds
from shared.endpoints import key_of, reachable
from shared.face.faps import MASK_BYTES, NUM_FAPS
from shared.keys import Peer
from shared.logs import LOG
from shared.phones.events import EndOfSound, Phone, Progress
from shared.phones.inventory import load_inventory
from shared.reliable import ReliableReceiver
from shared.service import Service
from shared.wire.control import SessionInput, StartSession
from shared.wire.events import SPEECH_MESSAGES, SpeechMessage, event_of
from shared.wire.face import EndOfFaps, FapFrame
from shared.wire.session import ChooseExpressiveness, Express

STALL_S = 0.2  # a live stream silent for so long has stalled
LOW_LEVEL_FAPS = range(2, NUM_FAPS)  # FAP 1 and 2 are not used; the others all are
MASK = sum(1 << index for index in LOW_LEVEL_FAPS).to_bytes(MASK_BYTES, "little")


class _Session:
    """One session: its face, and its place among messages."""

    def __init__(self, start: StartSession, face: Face, receiver: ReliableReceiver) -> None:
        self.start = start
        self.face = face
        self.receiver = receiver
        self.epoch_in = 1  # of the newest message from the recognizer
        self.last_input_s = time.monotonic()
        self.relaxed_s = 0.0  # until when frames were made without audio
        self.sequence_out = 0
        self.media_time = 0  # of the newest frame
        self.finished = False


class SynthesizerService(Service):
    """The synthesizer process."""

    name = "synthesizer"
    role = "worker"

    def __init__(self, config: SynthesizerConfig) -> None:
        super().__init__(config)
        self._config = config
        self.frame_rate_hz = config.frame_rate_hz
        self.delay_ms = config.delay_ms
        self.lips = config.lips
        self._sessions: dict[str, _Session] = {}
        self._input = self.bus.bind_router(config.phone_input, "synthesizer.phone_input", PHONES)
        self._faps = self.bus.bind_publisher(config.faps, "synthesizer.faps")
        self.endpoints = {
            "phone_input": reachable(
                self._input.endpoint, config.advertise, "synthesizer.phone_input"
            ),
            "faps": reachable(self._faps.endpoint, config.advertise, "synthesizer.faps"),
        }
        load_lip_model(name=config.lips)  # the first session waits for nothing
        self.register(self._input, dict.fromkeys(SPEECH_MESSAGES, self._on_input))
        self.register(self._faps, {})

    def start_session(self, start: StartSession) -> bool:
        """Make a face at rest; a session that moved here again keeps its own."""
        session = self._sessions.get(start.session)
        if session is None or session.start.token != start.token:
            receiver = ReliableReceiver(self._input, start.session)
            session = _Session(start, self._new_face(start), receiver)
            self._sessions[start.session] = session
        session.start = start
        return True

    def _new_face(self, start: StartSession) -> Face:
        return Face(
            load_lip_model(start.language, start.lips or self._config.lips),
            frame_rate_hz=self.frame_rate_hz,
            delay_s=self._config.delay_ms / 1e3,
            idle_motion_seed=self._config.idle_motion_seed,
            expressiveness=self._config.expressiveness,
        )

    def stop_session(self, session: str) -> None:
        """Forget a session."""
        found = self._sessions.pop(session, None)
        if found is not None and not found.finished:
            self._end(found)

    def flush_session(self, session: str) -> None:
        """Drop what is queued; the frames to come lead to rest."""
        found = self._sessions.get(session)
        if found is not None:
            found.face.flush()

    def use_lips(self, session: str, lips: str) -> None:
        """Let another lip model move the mouth from where it is."""
        found = self._sessions.get(session)
        if found is not None:
            found.face.use_lips(load_lip_model(found.start.language, lips))

    def express(self, message: Express) -> None:
        """Let the face show expressions from where it is."""
        found = self._sessions.get(message.session)
        if found is not None:
            found.face.express(message.expressions, message.hold_s)

    def choose_expressiveness(self, message: ChooseExpressiveness) -> None:
        """Let the mouth move more or less from here on."""
        found = self._sessions.get(message.session)
        if found is not None:
            found.face.choose_expressiveness(message.expressiveness)

    def on_tick(self, now_s: float) -> None:
        """Acknowledge, and lead faces to rest whose live stream has stalled."""
        for session in self._sessions.values():
            session.receiver.tick()
            is_stalled = now_s - session.last_input_s > STALL_S
            if session.start.paced and not session.finished and is_stalled:
                self._relax(session, now_s)

    def session_inputs(self) -> dict[str, SessionInput]:
        """Name the sessions served, so that control can say which of them are no more."""
        return dict.fromkeys(self._sessions, SessionInput())

    def on_drain(self) -> bool:
        """Lead every face to rest and end its stream."""
        for session in self._sessions.values():
            if not session.finished:
                num_frames = round(REST_S * self.frame_rate_hz)
                self._publish(session, session.face.relax(num_frames))
                self._end(session)
        return True

    def _relax(self, session: _Session, now_s: float) -> None:
        begin_s = max(session.relaxed_s, session.last_input_s + STALL_S)
        num_frames = int((now_s - begin_s) * self.frame_rate_hz)
        if num_frames > 0:
            session.relaxed_s = begin_s + num_frames / self.frame_rate_hz
            # Media time stands still with the audio; the sequence number goes on.
            self._publish(session, session.face.relax(num_frames))

    # --- from the recognizer ---------------------------------------------------------------------

    def _on_input(self, message: SpeechMessage, sender: Peer) -> None:
        session = self._sessions.get(message.session)
        if session is None:
            self.warn("unknown-session", "phones of an unknown session", message.session)
            return
        if sender.key != key_of(session.start.endpoints.get("phones", "")):
            self.warn(
                "foreign", "phones from another than the session's recognizer", message.session
            )
            return
        if message.epoch != session.start.epoch:  # sent again until control has told both ends
            self.metrics.count("other_epoch")
            return
        if not session.receiver.accept(message, sender):
            self.metrics.count("repeated")
            return
        event = event_of(message)
        language = session.start.language
        if isinstance(event, Phone) and event.symbol not in load_inventory(language).index:
            text = f"{event.symbol!r} is no phone of {language}"
            self.warn("unknown-phone", text, message.session)
            return
        started_s = time.perf_counter()
        session.last_input_s = time.monotonic()
        if message.epoch != session.epoch_in:  # after a crash, which restarts the count of phones
            session.face.restart(to_seconds(message.media_time))
        session.epoch_in = message.epoch
        self._publish(session, session.face.accept(event))
        if isinstance(event, Progress):
            self.metrics.observe("progress_ms", (time.perf_counter() - started_s) * 1e3)
        elif isinstance(event, EndOfSound):
            self._end(session)

    # --- out -------------------------------------------------------------------------------------

    def _end(self, session: _Session) -> None:
        session.finished = True
        session.sequence_out += 1
        self._faps.send(
            EndOfFaps(
                session=session.start.session,
                epoch=session.start.epoch,
                sequence=session.sequence_out,
                media_time=session.media_time,
            )
        )
        LOG.info("end of frames", extra={"session": session.start.session})

    def _publish(self, session: _Session, frames: Sequence[Frame]) -> None:
        self.metrics.count("out_fap_frame", len(frames))
        for time_s, faps in frames:
            session.sequence_out += 1
            session.media_time = to_samples(time_s)
            self._faps.send(
                FapFrame(
                    session=session.start.session,
                    epoch=session.start.epoch,
                    sequence=session.sequence_out,
                    media_time=session.media_time,
                    values=faps.astype("<f4").tobytes(),
                    mask=MASK,
                )
            )
