"""The recognizer as a service: audio chunks in, phones and speech events out.

Reacts to: audio-chunk (clients), start-session, stop-session, flush-session, set-face (control),
acknowledge-phones (synthesizer).
Emits: phone, lips, speech, progress, resume-face (synthesizer, acknowledged), the same phones, lips
and speech with the sound itself (followers), speech (control), acknowledge-audio, error (clients).
"""

from __future__ import annotations

import dataclasses
import math
import secrets
import time
from collections import deque
from collections.abc import Iterable, Sequence
from functools import partial

from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.audio_order import AudioOrder
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.front_end.pcm import BadAudio, pcm16_of, samples_of
from kouxing.services.recognizer.kind import KIND
from kouxing.services.recognizer.link import SynthesizerLink
from kouxing.services.recognizer.lip_frames import LipFrameModel
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.recognizer.live_decoder import StreamOutput
from kouxing.services.recognizer.recognizer import Recognizer
from kouxing.services.recognizer.resumption import WARM_UP_S, Chunk, Resumption
from kouxing.services.recognizer.stream import SpeechStream
from kouxing.shared.bus import Socket
from kouxing.shared.clock import MAX_GAP_S, MEDIA_RATE_HZ, to_samples, to_seconds
from kouxing.shared.errors import UserError
from kouxing.shared.keys import NOBODY, Peer
from kouxing.shared.logs import LOG
from kouxing.shared.message_loop import Handler
from kouxing.shared.metrics import give_back_memory
from kouxing.shared.phones.events import LipFrame, Phone, SpeechChange, Waveform
from kouxing.shared.phones.final_time import FinalTime
from kouxing.shared.service import Service
from kouxing.shared.wire.audio import AcknowledgeAudio, AudioChunk, Sound
from kouxing.shared.wire.control import SessionInput, StartSession
from kouxing.shared.wire.events import SpeechMessage, event_of, message_of
from kouxing.shared.wire.face import CurrentFace, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import Error, ErrorCode, SessionFacts
from kouxing.shared.wire.speech import AcknowledgePhones, AudioState, Progress

MAX_MEDIA_TIME = 2**40  # two years of samples; more is no sample index
MAX_BACKLOG = 2000  # messages the synthesizer may owe acknowledgement for before audio waits
MAX_BACKLOG_S = 5.0  # for so long; then the session's link is given up for the others' sake
MAX_QUEUED_S = 0.3  # of audio, of all sessions, that is processed together
MAX_UNPACED_S = 0.06  # of those that are not paced, while another is: live audio waits for it
MIN_CHUNK_S = 0.001  # that a chunk counts for at least
MAX_LEAD_S = 15.0  # of a paced client before the clock; one that was behind may catch up as much
CLOCK_RATE = 1.01  # its clock may be faster than this one
ACKNOWLEDGE_EVERY_S = 0.1  # to a client that sends audio
GIVE_BACK_S = 10.0  # after the end of a session: sessions of different lengths leave holes
STALL_S = 0.2  # a live client silent for so long has stalled
MAX_TICK_S = 0.05  # of silence between two ticks; more, and this process did not listen
MAX_NEEDED = 5000  # messages of audio that a client keeps


class _Session:
    """One session: its stream, and its place among messages."""

    def __init__(self, start: StartSession, stream: SpeechStream, socket: Socket) -> None:
        self.start = start
        self.face = CurrentFace(start.face, time.monotonic())
        self.socket = socket  # where its audio comes in
        self.first_epoch = start.epoch  # when this recognizer took the session
        self.stream = stream
        self.resumption: Resumption | None = None  # of a session that another has lost
        self.has_begun = False  # some audio came
        self.final = FinalTime()  # up to where the synthesizer knows that phones are final
        # Audio messages that another recognizer would need: number and where the sound ends.
        self.needed: deque[tuple[int, int]] = deque(maxlen=MAX_NEEDED)
        self.num_needless = 0  # number of the newest one that none would
        self.link = SynthesizerLink()
        self.client = NOBODY  # who sent the newest audio
        self.order = AudioOrder()
        self.acknowledge_s: float | None = None  # when that is due to the client
        self.acknowledged_s = 0.0  # when it was sent last
        self.sequence_out = 0
        self.last_audio_s = time.monotonic()
        self.silent_s = 0.0  # for how long this process listened and no audio came
        self.mouth_profile_error = ""  # why the profile is not used; empty once reported
        self.end: AudioChunk | None = None  # the last chunk, if it has come
        self.finished = False  # all audio up to the end is processed
        self.num_gaps = 0  # of the stream's, counted
        self.late_since_s: float | None = None  # since when the synthesizer owes too much
        # Before the clock, and when. Where another was lost, the client kept what came meanwhile.
        self._lead_s, self._lead_at_s = -MAX_LEAD_S if start.epoch > 1 else 0.0, time.monotonic()
        self._end_s: float | None = None  # media time of the end of the newest sound taken

    @property
    def num_taken(self) -> int:
        """Number of the newest audio message that its client need not send again."""
        if self.end is None or self.finished:
            return self.order.last
        return min(self.order.last, self.end.sequence - 1)

    def is_ahead(self, begin_s: float, duration_s: float, now_s: float) -> bool:
        """Return whether sound of a live client comes too long before its time.

        So does a gap before it that would be filled with frames.
        """
        gap_s = 0.0 if self._end_s is None else max(0.0, begin_s - self._end_s)
        passed_s = (now_s - self._lead_at_s) * CLOCK_RATE
        lead_s = max(self._lead_s - passed_s, -MAX_LEAD_S) + duration_s
        lead_s += gap_s if gap_s <= MAX_GAP_S else 0.0
        if lead_s > MAX_LEAD_S:
            return True
        self._lead_s, self._lead_at_s = lead_s, now_s
        self._end_s = begin_s + duration_s
        return False


class RecognizerService(Service):
    """The recognizer process."""

    kind = KIND

    def __init__(self, config: RecognizerConfig, lips: LipFrameModel | None = None) -> None:
        super().__init__(config)
        self._config = config
        self._sessions: dict[str, _Session] = {}
        self._queued: dict[str, list[Chunk]] = {}  # by session, not yet processed
        self._give_back_s = math.inf  # when the memory of sessions that have ended is given back
        self._queued_share = 0.0  # of what is processed together
        # Of sessions that are not paced: chunks that came, and (None) the end of the audio.
        self._unpaced: deque[tuple[_Session, Chunk | None]] = deque()
        self._unpaced_s = 0.0  # of sound therein
        self._listened_s = time.monotonic()  # when such sessions were last listened to
        self._late = {True: False, False: False}  # by paced: a synthesizer owes too much
        self._ticked_s = time.monotonic()
        self._synthesizers: dict[str, Socket] = {}  # by endpoint
        self._audio = self.bus.bind_router(config.audio, "recognizer.audio", role="client")
        self._phones = self.bus.bind_publisher(config.phones, "recognizer.phones")
        self._unpaced_audio = self.bus.bind_router(
            config.unpaced_audio, "recognizer.unpaced_audio", role="client"
        )
        self.endpoints = {
            "audio": config.reachable(self._audio.endpoint),
            "phones": config.reachable(self._phones.endpoint),
            "unpaced_audio": config.reachable(self._unpaced_audio.endpoint),
        }
        model = load_live_model(config.acoustic, look_ahead_ms=config.look_ahead_ms)
        self._recognizer = Recognizer(model, config.output_rule)
        self.facts = SessionFacts(language=model.inventory.language)
        self._lips = lips or lip_predictor_for(model)
        if self._lips is None:
            LOG.warning(
                "there are no lips from sound for this acoustic model: dynamic visemes move the "
                "mouth; with synthesizer.lips=dynamic-visemes they have the delay that suits them"
            )
        self._recognizer.warm_up()
        for socket in (self._audio, self._unpaced_audio):
            on_audio = partial(self._on_audio, socket)
            self.register(socket, {AudioChunk: on_audio})
        self.register(self._phones, {})

    def step(self, timeout_s: float) -> None:
        """Take in what has arrived, then process the audio of all live sessions together.

        Once no live audio waits, some of the others' is processed. What they send meanwhile waits
        in their own socket, and where that is full at the sender.
        """
        super().step(0.0 if self._unpaced and not self._late[False] else timeout_s)
        self._process_queued()
        is_live_waiting = not self._late[True] and self._audio.wait(0.0)
        if not self._late[False] and not is_live_waiting:
            self._process_unpaced()

    def control_handlers(self) -> dict[type[Message], Handler]:
        """Return the handlers of control's messages."""
        return super().control_handlers() | {SetFace: self._on_set_face}

    def served_sessions(self) -> Iterable[StartSession]:
        """Return the sessions that a restarted control learns from here, as they are now."""
        now_s = time.monotonic()
        for session in self._sessions.values():
            yield dataclasses.replace(session.start, face=session.face.at(now_s))

    def _on_set_face(self, message: SetFace, _sender: Peer) -> None:
        session = self._sessions.get(message.session)
        if session is not None:
            session.face.change(message.face, time.monotonic())

    def start_session(self, start: StartSession) -> bool:
        """Make a stream, or after a crash of the synthesizer give the old one a new link."""
        self._process_queued()
        session = self._sessions.get(start.session)
        is_new = False
        if session is None or session.start.token != start.token:
            lips, mouth_profile_error = self._lips_of(start)
            socket = self._audio if start.paced else self._unpaced_audio
            session = _Session(start, self._new_stream(start, lips), socket)
            session.mouth_profile_error = mouth_profile_error
            if start.media_time:
                silence = self._recognizer.model.inventory.silence
                session.resumption = Resumption(to_seconds(start.media_time), silence)
            self._sessions[start.session] = session
            is_new = True
        if is_new or session.start.epoch != start.epoch:
            session.start = start
            socket = self._connect(start.endpoints["phone_input"])
            session.link.connect(socket, start.session, start.epoch, time.monotonic())
            session.silent_s = 0.0  # another face does not know yet that its client is
            self._leave_synthesizers()
        return True

    def _lips_of(self, start: StartSession) -> tuple[LipFrameModel | None, str]:
        """Return the lip model for a session, and why its mouth profile is not used, if so."""
        if start.mouth_profile is None:
            return self._lips, ""
        if self._lips is None:
            return None, "the mouth profile is not used: this recognizer has no lip model"
        try:
            return self._lips.with_mouth_profile(start.mouth_profile), ""
        except UserError as error:
            return self._lips, f"the mouth profile is not used: {error}"

    def _new_stream(self, start: StartSession, lips: LipFrameModel | None) -> SpeechStream:
        return self._recognizer.create_stream(
            sample_rate_hz=start.sample_rate_hz,
            num_channels=start.num_channels,
            lips=lips,
            face_delay_s=(start.facts.delay_ms or 0.0) / 1e3,
            speech_time=start.speech_time or 0,
        )

    def stop_session(self, session: str) -> None:
        """Forget a session."""
        self._process_queued()
        if self._sessions.pop(session, None) is not None:
            self._give_back_s = min(self._give_back_s, time.monotonic() + GIVE_BACK_S)

    def flush_session(self, session: str) -> None:
        """Drop the speech under way; the next audio starts again."""
        self._process_queued()
        found = self._sessions.get(session)
        if found is not None:
            self._unpaced = deque(
                (each, chunk) for each, chunk in self._unpaced if each is not found or chunk is None
            )
            found.link.forget()
            found.silent_s = 0.0  # the face shall learn anew that its client is
            found.stream.flush()
            self._emit(found)

    def on_tick(self, now_s: float) -> None:
        """Acknowledge audio, tell who is silent, repeat what the synthesizer did not acknowledge.

        Audio waits if the synthesizer is behind.
        """
        if now_s >= self._give_back_s:
            self._give_back_s = math.inf
            give_back_memory()
        self._find_stalled(now_s)
        late = {True: False, False: False}
        for name, session in self._sessions.items():
            self._take_in_order(session, session.order.tick(now_s), session.client)
            if session.acknowledge_s is not None and now_s >= session.acknowledge_s:
                self._acknowledge(session, now_s)
            self.metrics.count("resent", session.link.tick(now_s))
            if session.link.backlog <= MAX_BACKLOG:
                session.late_since_s = None
                continue
            late[session.start.paced] = True
            session.late_since_s = session.late_since_s or now_s
            if now_s - session.late_since_s > MAX_BACKLOG_S:
                self.warn("no-link", "the synthesizer takes no phones; they are dropped", name)
                session.link.disconnect()
        self._late = late
        self.pause(self._audio, paused=late[True])
        self._hold_back()

    def _find_stalled(self, now_s: float) -> None:
        """Tell the synthesizer whose live client sends nothing.

        Only the time counts in which this process listened: neither what it did not read yet, nor
        that it was too busy to read, is a client's silence.
        """
        tick_s, self._ticked_s = min(now_s - self._ticked_s, MAX_TICK_S), now_s
        if self._queued or self._audio.wait(0.0):
            return
        for session in self._sessions.values():
            before_s, session.silent_s = session.silent_s, session.silent_s + tick_s
            has_stalled = before_s <= STALL_S < session.silent_s
            if has_stalled and session.start.paced and not session.finished:
                media_time = max(session.stream.media_time, session.start.media_time)
                stalled = Progress(media_time=media_time, state=AudioState.STALLED)
                session.link.send(stalled, now_s)

    def on_drain(self) -> bool:
        """Let others take the sessions; finish those that nobody takes, to the last message."""
        self._process_queued()
        sessions = self._sessions.values()
        if self.is_handing_over and not all(session.finished for session in sessions):
            return False
        while self._unpaced:
            self._process_unpaced()
        for session in sessions:
            self._finish(session)
        return all(session.link.backlog == 0 for session in sessions)

    def session_inputs(self) -> dict[str, SessionInput]:
        """Return how far the audio of each session has come."""
        listened_s = {True: time.monotonic(), False: self._listened_s}  # by paced
        return {
            name: SessionInput(
                idle_s=max(0.0, listened_s[session.start.paced] - session.last_audio_s),
                sequence=session.num_needless,
                media_time=to_samples(session.final.time_s),
            )
            for name, session in self._sessions.items()
        }

    def gauges(self) -> dict[str, float]:
        """Return how much waits: sound to be processed, and messages to be acknowledged."""
        backlogs = [each.link.backlog for each in self._sessions.values()]
        queued_s = sum(
            len(part) / self._sessions[name].start.sample_rate_hz
            for name, chunks in self._queued.items()
            for _, part in chunks
        )
        return {
            "queued_audio_seconds": queued_s + self._unpaced_s,
            "unacknowledged_messages": max(backlogs, default=0),
        }

    # --- from clients ----------------------------------------------------------------------------

    def _on_audio(self, socket: Socket, message: AudioChunk, sender: Peer) -> None:
        session = self._admit(socket, message, sender)
        if session is None:
            return
        now_s = time.monotonic()
        session.client = sender
        if message.sequence <= session.order.last:
            self.metrics.count("repeated")
            in_order = []
        else:
            session.last_audio_s, session.silent_s = now_s, 0.0
            in_order = session.order.accept(message, now_s)
        self._take_in_order(session, in_order, sender)
        if message.acknowledge:
            is_awaited = not in_order or session.finished  # also by who repeats or left a hole
            due_s = now_s if is_awaited else session.acknowledged_s + ACKNOWLEDGE_EVERY_S
            session.acknowledge_s = min(session.acknowledge_s or due_s, due_s)

    def _take_in_order(
        self, session: _Session, messages: Sequence[AudioChunk], sender: Peer
    ) -> None:
        """Take what is in order; what is refused counts as taken."""
        for message in messages:
            if message.media_time > MAX_MEDIA_TIME:
                text = f"media_time {message.media_time} is no sample index at 16 kHz; count from 0"
                self._refuse(session.socket, message, sender, ErrorCode.BAD_AUDIO, text)
            elif session.end is not None:
                text = f"session {message.session!r} has ended; open another"
                self._refuse(session.socket, message, sender, ErrorCode.FINISHED, text)
            else:
                if message.pcm or not message.last:
                    self._take_chunk(session, message, sender)
                if not message.last:
                    continue
                session.end = message
                if session.start.paced:
                    self._process_queued()
                    self._finish(session)
                else:
                    self._unpaced.append((session, None))

    def _acknowledge(self, session: _Session, now_s: float) -> None:
        """Tell the client which audio it need not send again."""
        session.acknowledge_s, session.acknowledged_s = None, now_s
        session.socket.send(
            AcknowledgeAudio(
                session=session.start.session,
                epoch=session.start.epoch,
                sequence=session.num_taken,
            ),
            to=session.client,
        )

    def _take_chunk(self, session: _Session, chunk: AudioChunk, sender: Peer) -> None:
        if error := session.mouth_profile_error:
            self._refuse(session.socket, chunk, sender, ErrorCode.BAD_MOUTH_PROFILE, error)
            session.mouth_profile_error = ""
        start = session.start
        try:
            samples = samples_of(chunk.pcm, start.encoding, start.num_channels)
        except BadAudio as bad_audio:
            self._refuse(session.socket, chunk, sender, ErrorCode.BAD_AUDIO, str(bad_audio))
            return
        rate_hz, media_time = start.sample_rate_hz, chunk.media_time
        begin_s, duration_s = to_seconds(media_time), len(samples) / rate_hz
        if start.paced and session.is_ahead(begin_s, duration_s, time.monotonic()):
            text = f"it is more than {MAX_LEAD_S:g} s ahead of the clock; open with paced false"
            self._refuse(session.socket, chunk, sender, ErrorCode.BAD_AUDIO, text)
            return
        end = media_time + len(samples) * MEDIA_RATE_HZ // rate_hz
        session.needed.append((chunk.sequence, end))
        if session.resumption is not None and not session.has_begun:
            media_time, samples = session.resumption.on_grid((media_time, samples), rate_hz)
            session.has_begun = len(samples) > 0
            if not session.has_begun:
                return
        if not start.paced:
            self._unpaced.append((session, (media_time, samples)))
            self._unpaced_s += max(MIN_CHUNK_S, len(samples) / rate_hz)
            self._hold_back()
            return
        piece = round(MAX_QUEUED_S * rate_hz)
        for begin in range(0, max(1, len(samples)), piece):  # a long chunk must not hold others up
            part = samples[begin : begin + piece]
            part_time = media_time + begin * MEDIA_RATE_HZ // rate_hz
            self._queued.setdefault(chunk.session, []).append((part_time, part))
            self._queued_share += len(part) / piece
            if self._queued_share >= 1.0:
                self._process_queued()
                self.send_heartbeat_if_due()

    @property
    def _max_unpaced_s(self) -> float:
        """How much of sessions that are not paced is processed, and read, at a time."""
        has_live = any(session.start.paced for session in self._sessions.values())
        return MAX_UNPACED_S if has_live else MAX_QUEUED_S

    def _hold_back(self) -> None:
        """Let clients that are not paced wait while there is enough of theirs."""
        is_enough = self._unpaced_s >= self._max_unpaced_s
        self.pause(self._unpaced_audio, paused=is_enough or self._late[False])
        if not is_enough and not self._late[False]:
            self._listened_s = time.monotonic()

    def _process_unpaced(self) -> None:
        """Process some audio of sessions that are not paced, and end those that are through."""
        left_s = self._max_unpaced_s
        while self._unpaced and left_s > 0.0:
            session, chunk = self._unpaced.popleft()
            start = session.start
            if self._sessions.get(start.session) is not session:
                continue
            if chunk is None:
                self._process_queued()
                self._finish(session)
                if session.end is not None and session.end.acknowledge:
                    session.acknowledge_s = time.monotonic()
                continue
            media_time, samples = chunk
            rate_hz = start.sample_rate_hz
            part = samples[: max(1, round(left_s * rate_hz))]
            self._queued.setdefault(start.session, []).append((media_time, part))
            left_s -= len(part) / rate_hz
            if len(part) < len(samples):
                rest_time = media_time + len(part) * MEDIA_RATE_HZ // rate_hz
                self._unpaced.appendleft((session, (rest_time, samples[len(part) :])))
        self._unpaced_s = sum(
            max(MIN_CHUNK_S, len(chunk[1]) / session.start.sample_rate_hz)
            for session, chunk in self._unpaced
            if chunk is not None
        )
        self._process_queued()
        self._hold_back()

    def _process_queued(self) -> None:
        """Process the queued chunks; the network scores all sessions' frames in one go."""
        if not self._queued:
            return
        started_s = time.perf_counter()
        sessions = [self._sessions[name] for name in self._queued]
        for session, chunks in zip(sessions, self._queued.values(), strict=True):
            for media_time, samples in chunks:
                session.stream.accept_waveform(samples, media_time)
        self._queued, self._queued_share = {}, 0.0
        self._recognizer.decode_streams([session.stream for session in sessions])
        self.resync_with_control()  # after a stall, other workers may serve the sessions
        for session in sessions:
            if self._sessions.get(session.start.session) is not session:
                continue
            self._emit(session)
            self.metrics.count("audio_gaps", session.stream.num_gaps - session.num_gaps)
            session.num_gaps = session.stream.num_gaps
        self.metrics.observe("chunk_ms", (time.perf_counter() - started_s) * 1e3)

    def _admit(self, socket: Socket, message: AudioChunk, sender: Peer) -> _Session | None:
        """Return the session if the sender may write to it."""
        session = self._sessions.get(message.session)
        if session is None:
            text = f"there is no session {message.session!r} here; open it at control"
            self._refuse(socket, message, sender, ErrorCode.UNKNOWN_SESSION, text)
        elif not secrets.compare_digest(session.start.token.encode(), message.token.encode()):
            text = f"the token is not that of session {message.session!r}"
            self._refuse(socket, message, sender, ErrorCode.BAD_TOKEN, text)
        elif socket is not session.socket:
            text = f"send the audio of session {message.session!r} where session-opened says"
            self._refuse(socket, message, sender, ErrorCode.BAD_AUDIO, text)
        elif message.sequence == 0:
            text = "the message has no sequence; number audio messages from 1"
            self._refuse(socket, message, sender, ErrorCode.BAD_AUDIO, text)
        elif 0 < message.epoch < session.first_epoch:  # meant for the recognizer before this one
            self.metrics.count("other_epoch")
        else:
            return session
        return None

    def _refuse(
        self, socket: Socket, message: Message, sender: Peer, code: ErrorCode, text: str
    ) -> None:
        self.warn(code, text, message.session)
        socket.send(
            Error(session=message.session, media_time=message.media_time, code=code, text=text),
            to=sender,
        )

    # --- out -------------------------------------------------------------------------------------

    def _finish(self, session: _Session) -> None:
        if not session.finished:
            session.finished = True
            session.stream.input_finished()
            self._recognizer.decode_streams([session.stream])
            self._emit(session)
            LOG.info("end of audio", extra={"session": session.start.session})

    def _emit(self, session: _Session) -> None:
        now_s = time.monotonic()
        outputs = self._recognizer.get_result(session.stream)
        if session.resumption is not None:
            outputs = session.resumption.pass_on(outputs)
        for output in outputs:
            message = _message_of(output)
            if not isinstance(output, Waveform):
                session.link.send(message, now_s)
            if isinstance(output, Phone | LipFrame | SpeechChange | Waveform):
                session.sequence_out += 1
                self._phones.send(_addressed(message, session))
            if isinstance(output, SpeechChange):
                self.send_to_control(_addressed(message, session))

    def _connect(self, endpoint: str) -> Socket:
        if endpoint not in self._synthesizers:
            socket = self.bus.connect_dealer(endpoint)
            self._synthesizers[endpoint] = socket
            self.register(socket, {AcknowledgePhones: self._on_acknowledge, Error: self.on_error})
        return self._synthesizers[endpoint]

    def _leave_synthesizers(self) -> None:
        """Close the sockets to synthesizers that no session has any more."""
        used = {each.start.endpoints["phone_input"] for each in self._sessions.values()}
        for endpoint in self._synthesizers.keys() - used:
            self.unregister(self._synthesizers.pop(endpoint))

    def _on_acknowledge(self, ack: AcknowledgePhones, _sender: Peer) -> None:
        session = self._sessions.get(ack.session)
        if session is not None:
            for message in session.link.acknowledge(ack, time.monotonic()):
                _note_known(session, message)


def _note_known(session: _Session, message: Message) -> None:
    """Note what the synthesizer knows, and which audio is needless therefore."""
    if isinstance(message, Progress) and message.state != AudioState.RUNNING:
        if message.state == AudioState.ENDED:
            session.num_needless = session.order.last
    elif isinstance(message, SpeechMessage):
        session.final.accept(event_of(message))
        needed_from = to_samples(max(0.0, session.final.time_s - WARM_UP_S))
        while session.needed and session.needed[0][1] <= needed_from:
            session.num_needless, _ = session.needed.popleft()


def _message_of(output: StreamOutput) -> Message:
    if isinstance(output, Waveform):
        return Sound(media_time=to_samples(output.time_s), pcm=pcm16_of(output.samples))
    return message_of(output)


def _addressed(message: Message, session: _Session) -> Message:
    return dataclasses.replace(
        message,
        session=session.start.session,
        epoch=session.start.epoch,
        sequence=session.sequence_out,
    )
