"""The synthesizer service: receives phones and lip positions, sends FAP frames.

Handles: results (recognizer), start-session, close-session, flush-session, set-face (control).
Sends: fap-frame, end-of-faps (subscribers), acknowledge (recognizer).

Processed audio, not the wall clock, drives the frames. Load, or audio faster than real time,
therefore changes only when frames appear. Only a stalled live stream uses the wall clock, to return
the face to rest.
"""

import itertools
import logging
import math
import time
from collections import deque
from collections.abc import Sequence
from operator import attrgetter

import numpy as np
from kouxing_client.field_types import MASK_BYTES
from kouxing_client.messages import EndOfFaps, FapFrame, Message, SessionFacts

from kouxing.services.lip_models import lip_model_names
from kouxing.services.service_kinds import KINDS
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import REST_S, Frame
from kouxing.services.synthesizer.face_maker import FaceMaker
from kouxing.services.synthesizer.lateness import NO_LATENESS
from kouxing.services.synthesizer.session import RECOGNIZER_TIMEOUT_S, SynthesizerSession
from kouxing.shared.clock import to_samples, to_seconds
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.network.bus import PHONE_LIMITS
from kouxing.shared.network.peer import Peer
from kouxing.shared.phones import events
from kouxing.shared.phones.events import AudioSkipped, EndOfSound, LipPositions, Phone, SpeechChange
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory
from kouxing.shared.service.message_loop import MAX_TURN_S
from kouxing.shared.service.overload import CATCH_UP_S, GRACE_PERIOD_S
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.settings.endpoints import key_of
from kouxing.shared.wire.control import EventName, SessionProgress, StartSession
from kouxing.shared.wire.events import SpeechMessage, is_state_report, message_to_event, split_batch
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.session import ErrorCode, FlushSession
from kouxing.shared.wire.speech import AudioState, NewestFrame, Progress, Results

MAX_BURST_S = 0.06  # frames of one session at a time, so that a gap does not delay other sessions
MAX_QUEUED_EVENTS = 200  # events of a session; the recognizer resends later ones
CHECK_INTERVAL_S = 1.0  # interval between checks for stopped subscribers and for lateness
MAX_CATCH_UP_S = 0.2  # limit for making up late frames without sound
LOW_LEVEL_FAPS = range(2, NUM_FAPS)  # all but FAP 1 and 2
FAP_MASK = sum(1 << index for index in LOW_LEVEL_FAPS).to_bytes(MASK_BYTES, "little")


class SynthesizerService(SessionService):
    """The synthesizer process."""

    kind = KINDS["synthesizer"]

    def __init__(self, config: SynthesizerConfig) -> None:
        super().__init__(config)
        self._config = config
        self.frame_rate_hz = config.frame_rate_hz
        self.facts = SessionFacts(
            frame_rate_hz=config.frame_rate_hz,
            delay_ms=config.delay_ms,
            lip_model=config.lips,
            expressiveness=config.expressiveness,
            feeling=config.feeling,
        )
        self.lip_models = lip_model_names()
        self._face_maker = FaceMaker(config, self._report_bad_face)
        self._sessions: dict[str, SynthesizerSession] = {}
        self._turn = 0  # round robin of sessions with queued events
        self._last_check_s = 0.0  # last check for stopped subscribers and for lateness
        self._input = self.bus.bind_router(
            config.phone_input, "synthesizer.phone_input", PHONE_LIMITS, role="service"
        )
        self._faps = self.bus.bind_publisher(config.faps, "synthesizer.faps", self._on_subscribe)
        self.endpoints = {
            "phone_input": config.advertised_endpoint(self._input.endpoint),
            "faps": config.advertised_endpoint(self._faps.endpoint),
        }
        self.register(self._input, {Results: self._on_results})
        self.register(self._faps, {})

    def start_session(self, start: StartSession) -> bool:
        """Create a face at rest. A session that returns to this synthesizer keeps its face."""
        session = self._sessions.get(start.session)
        if session is None or session.start.token != start.token:
            session = SynthesizerSession(
                start, self._face_maker.make(start), self._input, self._faps, self._config.max_lag_s
            )
            self._sessions[start.session] = session
        session.start = start
        self.session_started(start, session.final_time.media_time)
        return False

    def stop_session(self, session: str) -> None:
        """Remove a session."""
        stopped = self._sessions.pop(session, None)
        # a stopping synthesizer leaves the session to another one
        if stopped is not None and not stopped.is_finished and not self.should_exit:
            self._end(stopped)

    def flush_session(self, message: FlushSession) -> None:
        """Drop queued phones and lip positions; the next frames return to rest."""
        if (flushed := self._sessions.get(message.session)) is not None:
            flushed.events = deque(
                event for event in flushed.events if not isinstance(event, Phone | LipPositions)
            )
            flushed.face.flush()

    def change_face(self, message: SetFace) -> None:
        """Change the face of a session."""
        if (session := self._sessions.get(message.session)) is not None:
            self._face_maker.change(session, message.face)

    def _report_bad_face(self, start: StartSession, text: str) -> None:
        self.warn(ErrorCode.BAD_FACE, text, start.session)
        self.publish_event(EventName.ERROR, start, f"{ErrorCode.BAD_FACE}: {text}")

    def on_tick(self, now_s: float) -> float:
        """Acknowledge messages, relax the faces of stalled live streams, and drop old frames."""
        if not self._sessions:
            return math.inf
        if now_s >= self._last_check_s + CHECK_INTERVAL_S:
            self._last_check_s = now_s
            live = [name for name, session in self._sessions.items() if session.is_paced]
            self._faps.disconnect_stalled((FapFrame,), live)
            for session in self._sessions.values():
                session.lateness.measure(now_s)
        due_s = self._last_check_s + CHECK_INTERVAL_S
        for session in self._sessions.values():
            due_s = min(due_s, session.receiver.tick(now_s))
            self.report_skipped(session.start, session.skip_policy.take_report_s(now_s))
            if session.is_paced and not session.is_finished and not session.events:
                self._relax(session, now_s)
                due_s = min(due_s, session.relax_at_s + 1.0 / self.frame_rate_hz)
        busy = [session for session in self._sessions.values() if session.events]
        end_s = time.monotonic() + MAX_TURN_S
        for _ in busy:
            self._turn += 1
            session = busy[self._turn % len(busy)]
            self._make_frames(session)
            if not session.events and not self._input.wait(0.0):
                session.skip_policy.adapt(now_s)
            if time.monotonic() > end_s:
                break
        return now_s if busy else due_s

    def session_progress(self) -> dict[str, SessionProgress]:
        """Return each session's progress: end of its final phones, lateness and skipped time."""
        return {
            name: SessionProgress(
                final_until=session.final_time.media_time,
                lateness=session.lateness.newest,
                skipped_s=session.skip_policy.skipped_s,
            )
            for name, session in self._sessions.items()
        }

    def gauges(self) -> dict[str, float]:
        """Return the worst lateness of all sessions."""
        measured = [session.lateness.newest for session in self._sessions.values()]
        latest = max(filter(None, measured), key=attrgetter("worst_ms"), default=NO_LATENESS)
        return {
            f"lateness_{name}_seconds": getattr(latest, f"{name}_ms") / 1e3
            for name in ("p50", "p95", "worst")
        }

    def on_drain(self) -> bool:
        """Wait until other synthesizers have taken over sessions; end the remaining ones."""
        unfinished = [session for session in self._sessions.values() if not session.is_finished]
        if unfinished and self.is_handing_over:
            return False
        for session in unfinished:
            self._publish(session, session.face.relax(round(REST_S * self.frame_rate_hz)))
            self._end(session)
        return True

    def _relax(self, session: SynthesizerSession, now_s: float) -> None:
        # after a stall of this process, not all missed frames are made
        session.relax_at_s = max(session.relax_at_s, now_s - MAX_CATCH_UP_S)
        num_frames = int((now_s - session.relax_at_s) * self.frame_rate_hz)
        if num_frames > 0:
            session.relax_at_s += num_frames / self.frame_rate_hz
            # media time stops with the audio; the sequence number continues
            self._publish(session, session.face.relax(num_frames))
            session.lateness.pause()
            session.receiver.acknowledge()

    # --- from the recognizer ---------------------------------------------------------------------

    def _on_results(self, results: Results, sender: Peer) -> None:
        for message in split_batch(results):
            self._on_input(message, sender)

    def _on_input(self, message: SpeechMessage, sender: Peer) -> None:
        session = self._accept(message, sender)
        if session is None:
            return
        now_s = time.monotonic()
        state = newest_frame = None
        if isinstance(message, Progress):
            state, newest_frame = message.state, message.newest_frame
        has_stalled = state == AudioState.STALLED
        if is_state_report(message):
            session.skip_policy.resume()
        session.relax_at_s = now_s if has_stalled else now_s + RECOGNIZER_TIMEOUT_S
        if message.epoch != session.input_epoch:
            self._start_epoch(session, message, newest_frame)
        if not is_state_report(message):
            self._queue_event(session, message)

    def _start_epoch(
        self, session: SynthesizerSession, message: SpeechMessage, newest_frame: NewestFrame | None
    ) -> None:
        """Continue a face with another recognizer, or after another synthesizer's frames."""
        if session.input_epoch:
            session.face.change_recognizer()
        elif newest_frame is not None:
            faps = np.frombuffer(newest_frame.values, "<f4")
            session.resume(newest_frame.media_time, newest_frame.sequence, faps)
        elif message.epoch > 1:  # both workers were lost, so the other face's frame is unknown
            time_s = to_seconds(message.media_time)
            session.resume(message.media_time, int(time_s * self.frame_rate_hz), None)
        if message.epoch > 1:
            session.skip_policy.postpone(time.monotonic() + CATCH_UP_S)
        session.input_epoch = message.epoch

    def _accept(self, message: SpeechMessage, sender: Peer) -> SynthesizerSession | None:
        """Return the session of a message if it is the next message of its recognizer."""
        session = self._sessions.get(message.session)
        if session is None:
            text = "dropped phones of an unknown session"  # the session has just been closed
            self.warn("unknown-session", text, message.session, logging.INFO)
        elif sender.key != key_of(session.start.endpoints.get("phones", "")):
            self.warn("foreign", "dropped phones of another recognizer", message.session)
        elif message.epoch != session.start.epoch:  # resent until both workers have the new epoch
            self.metrics.count("other_epoch")
        elif len(session.events) >= MAX_QUEUED_EVENTS:
            self.metrics.count("too_early")
        elif not session.receiver.receive(message, sender):
            self.metrics.count("repeated")
        else:
            return session
        return None

    def _queue_event(self, session: SynthesizerSession, message: SpeechMessage) -> None:
        event = message_to_event(message)
        language = session.start.facts.language or DEFAULT_LANGUAGE
        if isinstance(event, Phone) and event.symbol not in load_inventory(language).index:
            text = f"{event.symbol!r} is not a phone of {language}"
            self.warn("unknown-phone", text, message.session)
            return
        session.final_time.update(message)
        if not session.events and isinstance(event, Phone | LipPositions | SpeechChange):
            session.face.process(event)  # makes no frames
            return
        session.events.append(event)
        now_s = time.monotonic()
        if isinstance(event, events.Progress | AudioSkipped):
            duration_s = max(0.0, event.time_s - session.newest_event_s)
            session.skip_policy.add(duration_s, now_s, has_queued=len(session.events) > 1)
            session.newest_event_s = max(session.newest_event_s, event.time_s)
        if session.is_paced and session.skip_policy.is_late(now_s, by_s=GRACE_PERIOD_S):
            return  # newer events may have arrived
        if len(session.events) == 1:
            self._make_frames(session)

    def _make_frames(self, session: SynthesizerSession) -> None:
        """Publish the frames of queued events, up to ``MAX_BURST_S``."""
        num_left = max(1, round(MAX_BURST_S * self.frame_rate_hz))
        if session.is_paced:
            session.skip_if_behind(time.monotonic())
        while session.events:
            event = session.events[0]
            if session.pending_frames is None:
                session.pending_frames = session.face.iter_frames(event)
            started_s = time.perf_counter()
            frames = list(itertools.islice(session.pending_frames, num_left))
            self._publish(session, frames)
            if session.is_paced and not isinstance(event, EndOfSound):
                session.lateness.add((time_s for time_s, _ in frames), time.monotonic())
            if isinstance(event, events.Progress):
                self.metrics.observe("progress_ms", (time.perf_counter() - started_s) * 1e3)
            num_left -= len(frames)
            if num_left == 0:
                return
            session.pending_frames = None
            session.events.popleft()
            if isinstance(event, EndOfSound):
                self._end(session)

    # --- out -------------------------------------------------------------------------------------

    def _end(self, session: SynthesizerSession) -> None:
        session.is_finished = True
        session.output_sequence += 1
        end = EndOfFaps(
            session=session.start.session,
            epoch=session.start.epoch,
            sequence=session.output_sequence,
            media_time=session.media_time,
        )
        session.replay.send(end, time.monotonic())
        LOG.info("end of frames", extra={"session": session.start.session})

    def _publish(self, session: SynthesizerSession, frames: Sequence[Frame]) -> None:
        self.metrics.count("out_fap_frame", len(frames))
        for time_s, faps in frames:
            session.output_sequence += 1
            session.newest_frame = FapFrame(
                session=session.start.session,
                epoch=session.start.epoch,
                sequence=session.output_sequence,
                media_time=to_samples(time_s),
                packed_values=faps.astype("<f4").tobytes(),
                mask=FAP_MASK,
                packed_shapes={
                    name: SHAPE_SETS[name].weights(faps).astype("<f4").tobytes()
                    for name in session.shapes
                },
            )
            session.replay.send(session.newest_frame, time.monotonic())

    def _on_subscribe(self, session: str) -> Sequence[Message]:
        subscribed = self._sessions.get(session)
        return () if subscribed is None else subscribed.replay.repeated(time.monotonic())
