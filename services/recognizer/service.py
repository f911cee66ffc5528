"""The recognizer service: receives audio chunks, sends phones and speech events.

Handles: audio-chunk (clients), start-session, close-session, flush-session, set-face (control),
acknowledge (synthesizer).
Sends: results (synthesizer, acknowledged), phone, lip-positions, speech, acoustic, sound
(subscribers), speech (control), acknowledge, error (clients).
"""

import math
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from kouxing_client.messages import Message, SessionFacts, Speech

from kouxing.services.recognizer.acoustic.languages import MODEL_LANGUAGES
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.load_numba import load_numba
from kouxing.services.recognizer.sessions.audio_intake import AudioIntake
from kouxing.services.recognizer.sessions.live_batch_decoder import (
    SESSIONS_PER_RUN,
    LiveBatchDecoder,
)
from kouxing.services.recognizer.sessions.pending_sessions import PendingSessions
from kouxing.services.recognizer.sessions.session import RecognizerSession
from kouxing.services.recognizer.sessions.synthesizer_link import SynthesizerSockets
from kouxing.services.recognizer.sessions.unpaced_decoder import UnpacedDecoder
from kouxing.services.service_kinds import KINDS
from kouxing.shared.fast_record import replace
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.monitoring.metrics import trim_heap
from kouxing.shared.network.peer import NO_PEER, Peer
from kouxing.shared.network.sockets import Socket
from kouxing.shared.phones.events import Waveform
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.wire.control import EventName, SessionProgress, StartSession
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.session import AudioChunk, Error, ErrorCode, FlushSession
from kouxing.shared.wire.speech import Acknowledge, Progress

MAX_QUEUED_S = 60.0  # limit for live audio; later audio waits at the clients
READ_WAIT_S, MAX_READ_S = 0.005, 0.1  # waiting for more late audio: once, and in total
FREE_MEMORY_AFTER_S = 10.0  # after the end of a session, because many often end together
SESSION_TICK_S = 0.04  # interval between ticks while a session is open
MIN_STEP_S = 0.002  # interval between steps with several sessions, to process their audio together
MAX_TICK_S = 0.05  # longer intervals between ticks mean that this process was busy


class RecognizerService(SessionService):
    """The recognizer process."""

    kind = KINDS["recognizer"]

    def __init__(self, config: RecognizerConfig) -> None:
        super().__init__(config)
        self._sessions: dict[str, RecognizerSession] = {}
        self._max_lag_s = config.max_lag_s
        self._is_live_blocked = False  # by a synthesizer's backlog
        self._free_memory_at_s = math.inf
        self._last_step_s = 0.0
        self._last_stall_check_s = time.monotonic()
        self._synthesizers = SynthesizerSockets(
            self, {Acknowledge: self._on_acknowledge, Error: self.on_error}
        )
        self._audio = self.bus.bind_router(config.audio, "recognizer.audio", role="client")
        self._phones = self.bus.bind_publisher(
            config.phones, "recognizer.phones", self._on_subscribe
        )
        self._unpaced_audio = self.bus.bind_router(
            config.unpaced_audio, "recognizer.unpaced_audio", role="client"
        )
        self.endpoints = {
            "audio": config.advertised_endpoint(self._audio.endpoint),
            "phones": config.advertised_endpoint(self._phones.endpoint),
            "unpaced_audio": config.advertised_endpoint(self._unpaced_audio.endpoint),
        }
        with ThreadPoolExecutor(max_workers=1) as executor:  # a restart must be quick
            loading = executor.submit(load_model, config.acoustic)
            load_numba()
            model = loading.result()
        self._recognizer = Recognizer(model, config.output_rule)
        self.facts = SessionFacts(language=model.inventory.language)
        self.languages = [*MODEL_LANGUAGES]
        self._pending = PendingSessions(model.inventory.language, self.waker.wake)
        self._lip_predictor = load_lip_predictor()
        self._recognizer.warm_up()
        self._live = LiveBatchDecoder(
            self._sessions,
            self._recognizer,
            self.load_meter,
            self.waker.wake,
            on_early=self._send_results,
            on_decoded=self._send_decoded,
            on_batch=self.send_heartbeat_if_due,
        )
        self._unpaced = UnpacedDecoder(
            self._sessions,
            self._recognizer,
            self,
            self._unpaced_audio,
            self._live,
            on_decoded=self._send_decoded,
        )
        self._intake = AudioIntake(self)
        for socket in (self._audio, self._unpaced_audio):
            self.register(socket, {AudioChunk: partial(self._on_audio, socket)})
        self.register(self._phones, {})

    def step(self, timeout_s: float) -> None:
        """Read new messages, then decode some audio of all live sessions together.

        If no live audio is left, decode some unpaced audio.
        """
        super().step(0.0 if self._unpaced.can_decode or self._has_live_audio else timeout_s)
        self._read_late_audio()
        self._live.decode(self._live_sessions)
        if self._unpaced.can_decode and not self._is_live_waiting:
            self._unpaced.decode()

    def wait(self, timeout_s: float) -> list[Socket]:
        """Wait for messages; with several sessions, also for those that arrive soon after."""
        sockets = super().wait(timeout_s)
        early_s = self._last_step_s + MIN_STEP_S - time.monotonic()
        if sockets and early_s > 0.0 and len(self._sessions) >= SESSIONS_PER_RUN:
            time.sleep(early_s)
            sockets = super().wait(0.0)
        self._last_step_s = time.monotonic()
        return sockets

    # --- sessions --------------------------------------------------------------------------------

    def served_sessions(self) -> Iterable[StartSession]:
        """Return the current state of the sessions, for a restarted control."""
        now_s = time.monotonic()
        for session in self._sessions.values():
            start = session.start.with_face(session.face.at(now_s))
            yield replace(start, speech_time=session.speech_time)

    def change_face(self, message: SetFace) -> None:
        """Change the acoustic model and the face that a move restores."""
        self._pending.set_face(message.session, message.face)
        if (session := self._sessions.get(message.session)) is not None:
            session.face.change(message.face, time.monotonic())

    def start_session(self, start: StartSession) -> bool:
        """Create a session, or connect an existing one to another synthesizer.

        The first session in another language starts when its model is loaded.
        """
        if self._pending.add(start):
            return False
        session = self._sessions.get(start.session)
        is_new = session is None or session.start.token != start.token
        if session is None or is_new:
            socket = self._audio if start.opening.paced else self._unpaced_audio
            session = RecognizerSession(
                start,
                self._recognizer,
                self._lip_predictor,
                socket,
                self._phones,
                time.monotonic(),
                self._max_lag_s,
            )
            self._sessions[start.session] = session
        if is_new or session.start.epoch != start.epoch:
            session.start = start
            socket = self._synthesizers.connect(start.endpoints["phone_input"])
            session.link.connect(socket, start.session, start.epoch, time.monotonic())
            if not is_new:  # the new synthesizer must receive the stalled state
                session.silent_s = 0.0
            used = {active.start.endpoints["phone_input"] for active in self._sessions.values()}
            self._synthesizers.close_unused(used)
        return True

    def stop_session(self, session: str) -> None:
        """Remove a session."""
        self._pending.remove(session)
        if self._sessions.pop(session, None) is not None:
            free_at_s = time.monotonic() + FREE_MEMORY_AFTER_S
            self._free_memory_at_s = min(self._free_memory_at_s, free_at_s)

    def flush_session(self, message: FlushSession) -> None:
        """Drop the current speech; the next audio starts a new segment."""
        if (flushed := self._sessions.get(message.session)) is not None:
            flushed.audio.clear()
            self._live.decode_all([flushed])  # what the network's thread has
            flushed.link.forget()
            flushed.stream.flush()
            self._send_results(flushed)
            flushed.on_flush(message.sequence, time.monotonic())
            if flushed.last_chunk is not None:
                self._finish(flushed)

    def on_tick(self, now_s: float) -> float:
        """Start sessions, acknowledge audio, report stalled clients, and resend to synthesizers.

        Clients must wait while a synthesizer's acknowledgements are overdue.
        """
        for start in self._pending.take_ready():
            self._on_start_session(start, NO_PEER)
        if now_s >= self._free_memory_at_s:
            self._free_memory_at_s = math.inf
            trim_heap()
        self._report_stalled(now_s)
        for session in self._sessions.values():
            session.acknowledge_if_due(now_s)
            self.metrics.count("resent", session.link.tick(now_s))
            if session.link.check_overdue(now_s):
                text = "the synthesizer is too slow, so the face misses part of the speech"
                self.warn(ErrorCode.NO_LINK, text, session.name)
                self.publish_event(EventName.ERROR, session.start, f"{ErrorCode.NO_LINK}: {text}")
            self.report_skipped(session.start, session.audio.skip_policy.take_report_s(now_s))
        full = [session for session in self._sessions.values() if session.link.is_full]
        is_live_full = any(session.is_paced for session in full)
        self._is_live_blocked = is_live_full or self._live_queued_s > MAX_QUEUED_S
        self.pause(self._audio, paused=self._is_live_blocked)
        self._unpaced.is_blocked = not all(session.is_paced for session in full)
        self._unpaced.limit_reading()
        return now_s + SESSION_TICK_S if self._sessions else self._free_memory_at_s

    def _report_stalled(self, now_s: float) -> None:
        """Report stalled live clients to their synthesizers, once their audio is decoded."""
        tick_s, self._last_stall_check_s = min(now_s - self._last_stall_check_s, MAX_TICK_S), now_s
        if self._audio.wait(0.0):
            return
        for session in self._sessions.values():
            if not session.is_decoding:
                session.check_stalled(tick_s, now_s)

    def on_drain(self) -> bool:
        """Hand sessions over to other recognizers; finish the remaining ones."""
        sessions = self._sessions.values()
        self._live.decode_all(self._live_sessions)
        if self.is_handing_over and not all(session.is_finished for session in sessions):
            return False
        while self._unpaced.has_audio:
            self._unpaced.decode()
        for session in sessions:
            self._finish(session)
        return all(session.link.backlog == 0 for session in sessions)

    def session_progress(self) -> dict[str, SessionProgress]:
        """Return the input progress of each session."""
        now_s = time.monotonic()
        progress = {}
        for name, session in self._sessions.items():
            read_s = now_s if session.is_paced else self._unpaced.last_read_s
            progress[name] = SessionProgress(
                idle_s=max(0.0, read_s - session.last_audio_s),
                last_droppable_sequence=session.replay_window.last_droppable_sequence,
                skipped_s=session.audio.skip_policy.skipped_s,
            )
        return progress

    def gauges(self) -> dict[str, float]:
        """Return gauges of queued audio, unacknowledged messages and the light model."""
        backlogs = [session.link.backlog for session in self._sessions.values()]
        return {
            "queued_audio_seconds": self._live_queued_s + self._unpaced.queued_s,
            "unacknowledged_messages": max(backlogs, default=0),
            "network_hop": self._live.hop,
            "light_sessions": sum(
                session.stream.uses_light_model for session in self._sessions.values()
            ),
        }

    # --- audio -----------------------------------------------------------------------------------

    def _on_audio(self, socket: Socket, message: AudioChunk, sender: Peer) -> None:
        session = self._sessions.get(message.session)
        self._intake.receive(session, socket, message, sender)
        if session is None:
            return
        if not session.is_paced:
            self._unpaced.limit_reading()
        if session.last_chunk is not None and not session.is_decoding:
            self._finish(session)

    @property
    def _live_sessions(self) -> list[RecognizerSession]:
        return [session for session in self._sessions.values() if session.is_paced]

    @property
    def _live_queued_s(self) -> float:
        """Duration of the live audio that is not decoded yet."""
        return sum(session.audio.duration_s for session in self._live_sessions)

    @property
    def _has_live_audio(self) -> bool:
        return any(session.can_accept for session in self._live_sessions)

    @property
    def _is_live_waiting(self) -> bool:
        return self._has_live_audio or (not self._is_live_blocked and self._audio.wait(0.0))

    def _read_late_audio(self) -> None:
        """After a stall, read all received audio, so that it can be skipped at once."""
        end_s = time.monotonic() + MAX_READ_S
        while not self._is_live_blocked and (now_s := time.monotonic()) < end_s:
            queues = [session.audio for session in self._sessions.values()]
            late = [audio for audio in queues if audio.is_outdated(now_s)]
            if not late:
                return
            before_s = [audio.duration_s for audio in late]
            if self._audio.wait(READ_WAIT_S):
                self.handle_messages(self._audio)
            if [audio.duration_s for audio in late] == before_s:  # only others' audio has arrived
                for audio in late:
                    audio.skip_policy.adapt(now_s)
                return

    def _send_decoded(self, sessions: Sequence[RecognizerSession]) -> None:
        """Send the results of decoded sessions; finish those whose audio ends."""
        self.resync_with_control()  # after a stall, other recognizers may serve the sessions
        for session in sessions:
            if self._sessions.get(session.name) is not session:
                continue
            self._send_results(session)
            self.metrics.count("audio_gaps", session.stream.num_gaps - session.num_gaps_counted)
            session.num_gaps_counted = session.stream.num_gaps
            if session.is_paced:
                self.metrics.observe("chunk_ms", 1e3 * (time.monotonic() - session.accepted_s))
            if session.last_chunk is not None and not session.is_decoding:
                self._finish(session)

    def _finish(self, session: RecognizerSession) -> None:
        if not session.is_finished:
            session.is_finished = True
            session.stream.input_finished()
            self._recognizer.decode_streams([session.stream])
            self._send_results(session)
            if session.last_chunk is not None and session.last_chunk.acknowledge:
                session.request_acknowledgement(time.monotonic(), at_once=True)
            LOG.info("end of audio", extra={"session": session.name})

    # --- messages --------------------------------------------------------------------------------

    def _send_results(self, session: RecognizerSession) -> None:
        """Send new results to the subscribers, the synthesizer and control.

        Subscribers come first, because a replacement recognizer does not repeat results that the
        synthesizer has. All messages are sent together at the end, so that each receiver wakes up
        only once.
        """
        now_s = time.monotonic()
        results = session.new_results()
        published = [*session.published_messages(results)]
        for message in published:
            session.replay.send(message, now_s)
        for result in results:
            if not isinstance(result, Waveform):
                session.link.send(result, now_s)
        for message in published:
            if isinstance(message, Speech):
                self.send_to_control(message)
        for result in results:
            if isinstance(result, Progress) and result.laughter != session.is_laughing:
                session.is_laughing = result.laughter
                name = EventName.LAUGHTER_START if result.laughter else EventName.LAUGHTER_STOP
                self.publish_event(name, session.start, media_time=result.media_time)

    def _on_subscribe(self, session: str) -> Sequence[Message]:
        subscribed = self._sessions.get(session)
        return () if subscribed is None else subscribed.replay.repeated(time.monotonic())

    def _on_acknowledge(self, ack: Acknowledge, _sender: Peer) -> None:
        if (session := self._sessions.get(ack.session)) is not None:
            session.on_acknowledge(ack, time.monotonic())
