"""The recognizer as a service: audio chunks in, phones and speech events out.

Reacts to: audio-chunk, end-of-audio (clients), start-session, stop-session, flush-now (control),
acknowledge (synthesizer).
Emits: phone, lips, speech, progress, end-of-phones (synthesizer, acknowledged), the same phones,
lips and speech with the sound itself (followers), speech (control), error (clients).
"""

from __future__ import annotations

import dataclasses
import secrets
import time
from collections.abc import Sequence

from services.recognizer.acoustic.acoustic_model import run_scoring_tasks
from services.recognizer.acoustic.load import load_live_model
from services.recognizer.config import RecognizerConfig
from services.recognizer.front_end.pcm import BadAudio, pcm16_of, samples_of
from services.recognizer.lip_source import LipsFromSound
from services.recognizer.lips import lips_for
from services.recognizer.recognizer import warm_up
from services.recognizer.stream import Chunk, SpeechStream, StreamOutput, Waveform
from shared.bus import Socket
from shared.clock import MEDIA_RATE_HZ, to_samples
from shared.endpoints import reachable
from shared.errors import UserError
from shared.keys import Peer
from shared.logs import LOG
from shared.phones.events import LipFrame, Phone, SpeechChange
from shared.reliable import ReliableSender
from shared.service import Service
from shared.wire.audio import AudioChunk, EndOfAudio, Sound
from shared.wire.control import SessionInput, StartSession
from shared.wire.events import message_of
from shared.wire.message import Message
from shared.wire.session import Error, ErrorCode
from shared.wire.speech import Acknowledge

MAX_MEDIA_TIME = 2**40  # two years of samples; more is no sample index
MAX_BACKLOG = 2000  # messages the synthesizer may owe acknowledgement for before audio waits
MAX_BACKLOG_S = 5.0  # for so long; then the session's link is given up for the others' sake
MAX_QUEUED_S = 0.3  # of audio, of all sessions, that is processed together


class _Session:
    """One session: its stream, and its place among messages."""

    def __init__(self, start: StartSession, stream: SpeechStream) -> None:
        self.start = start
        self.first_epoch = start.epoch  # when this recognizer took the session
        self.stream = stream
        self.link: ReliableSender | None = None
        self.sequence_in = 0
        self.sequence_out = 0
        self.last_audio_s = time.monotonic()
        self.voice_refusal = ""  # why the client's voice is not used, if it was not told yet
        self.finished = False
        self.num_gaps = 0  # of the stream's, counted
        self.late_since_s: float | None = None  # since when the synthesizer owes too much


class RecognizerService(Service):
    """The recognizer process."""

    name = "recognizer"
    role = "worker"
    needs = ("phone_input",)

    def __init__(self, config: RecognizerConfig, lips: LipsFromSound | None = None) -> None:
        super().__init__(config)
        self._config = config
        self._sessions: dict[str, _Session] = {}
        self._queued: dict[str, list[Chunk]] = {}  # by session, not yet processed
        self._queued_s = 0.0
        self._synthesizers: dict[str, Socket] = {}  # by endpoint
        self._audio = self.bus.bind_router(config.audio, "recognizer.audio")
        self._phones = self.bus.bind_publisher(config.phones, "recognizer.phones")
        self.endpoints = {
            "audio": reachable(self._audio.endpoint, config.advertise, "recognizer.audio"),
            "phones": reachable(self._phones.endpoint, config.advertise, "recognizer.phones"),
        }
        self._model = load_live_model(config.acoustic, look_ahead_ms=config.look_ahead_ms)
        self.language = self._model.inventory.language
        self._lips = lips or lips_for(self._model)
        if self._lips is None:
            LOG.warning(
                "there are no lips from sound for this acoustic model: dynamic visemes move the "
                "mouth; with synthesizer.lips=dynamic-visemes they have the delay that suits them"
            )
        warm_up(self._model)
        self.register(self._audio, {AudioChunk: self._on_audio, EndOfAudio: self._on_end})
        self.register(self._phones, {})

    def step(self, timeout_s: float) -> None:
        """Take in what has arrived, then process the audio of all sessions together."""
        super().step(timeout_s)
        self._process_queued()

    def start_session(self, start: StartSession) -> bool:
        """Make a stream, or after a crash of the synthesizer give the old one a new link."""
        self._process_queued()
        session = self._sessions.get(start.session)
        if session is None or session.start.token != start.token:
            lips, voice_refusal = self._lips_of(start)
            session = _Session(start, self._new_stream(start, lips))
            session.voice_refusal = voice_refusal
            self._sessions[start.session] = session
        if session.link is None or session.start.epoch != start.epoch:
            session.start = start
            owed = session.link.waiting if session.link is not None else ()
            socket = self._connect(start.endpoints["phone_input"])
            session.link = ReliableSender(socket, start.session, start.epoch)
            for message in owed:
                session.link.send(message, time.monotonic())
        return True

    def _lips_of(self, start: StartSession) -> tuple[LipsFromSound | None, str]:
        """Return the model of lips with the session's voice, or without it and why."""
        if not start.voice:
            return self._lips, ""
        if self._lips is None:
            return None, "the voice is not used: this recognizer makes no lips from sound"
        try:
            return self._lips.for_voice(start.voice), ""
        except UserError as error:
            return self._lips, f"the voice is not used: {error}"

    def _new_stream(self, start: StartSession, lips: LipsFromSound | None) -> SpeechStream:
        return SpeechStream(
            self._model,
            sample_rate_hz=start.sample_rate_hz,
            num_channels=start.num_channels,
            num_stable_frames=self._config.num_stable_frames,
            min_confidence=self._config.min_confidence,
            lips=lips,
            face_delay_s=start.delay_ms / 1e3,
        )

    def stop_session(self, session: str) -> None:
        """Forget a session."""
        self._process_queued()
        self._sessions.pop(session, None)

    def flush_session(self, session: str) -> None:
        """Drop the speech under way; the next audio starts again."""
        self._process_queued()
        found = self._sessions.get(session)
        if found is not None:
            self._emit(found, found.stream.flush())

    def on_tick(self, now_s: float) -> None:
        """Repeat what the synthesizer did not acknowledge, and let audio wait if it is behind."""
        any_late = False
        for name, session in self._sessions.items():
            if session.link is None:
                continue
            self.metrics.count("resent", session.link.tick(now_s))
            if session.link.backlog <= MAX_BACKLOG:
                session.late_since_s = None
                continue
            any_late = True
            session.late_since_s = session.late_since_s or now_s
            if now_s - session.late_since_s > MAX_BACKLOG_S:
                self.warn("no-link", "the synthesizer takes no phones; they are dropped", name)
                session.link = None
        self.pause(self._audio, paused=any_late)

    def on_drain(self) -> bool:
        """Finish every utterance and wait until the synthesizer has it."""
        self._process_queued()
        for session in self._sessions.values():
            self._finish(session)
        return all(s.link is None or s.link.backlog == 0 for s in self._sessions.values())

    def session_inputs(self) -> dict[str, SessionInput]:
        """Return how far the audio of each session has come."""
        now_s = time.monotonic()
        return {
            name: SessionInput(idle_s=now_s - session.last_audio_s, sequence=session.sequence_in)
            for name, session in self._sessions.items()
        }

    # --- from clients ----------------------------------------------------------------------------

    def _on_audio(self, chunk: AudioChunk, sender: Peer) -> None:
        session = self._admit(chunk, sender)
        if session is None:
            return
        if session.voice_refusal:
            self._refuse(chunk, sender, ErrorCode.BAD_VOICE, session.voice_refusal)
            session.voice_refusal = ""
        start = session.start
        try:
            samples = samples_of(chunk.pcm, start.encoding, start.num_channels)
        except BadAudio as error:
            self._refuse(chunk, sender, ErrorCode.BAD_AUDIO, str(error))
            return
        rate_hz = start.sample_rate_hz
        piece = round(MAX_QUEUED_S * rate_hz)
        for begin in range(0, max(1, len(samples)), piece):  # a long chunk must not hold others up
            part = samples[begin : begin + piece]
            media_time = chunk.media_time + begin * MEDIA_RATE_HZ // rate_hz
            self._queued.setdefault(chunk.session, []).append((media_time, part))
            self._queued_s += len(part) / rate_hz
            if self._queued_s >= MAX_QUEUED_S:
                self._process_queued()
                self.beat_if_due()

    def _process_queued(self) -> None:
        """Process the queued chunks; the network scores all sessions' frames in one go."""
        if not self._queued:
            return
        started_s = time.perf_counter()
        sessions = [self._sessions[name] for name in self._queued]
        tasks = [
            session.stream.process(chunks)
            for session, chunks in zip(sessions, self._queued.values(), strict=True)
        ]
        self._queued, self._queued_s = {}, 0.0
        for session, outputs in zip(sessions, run_scoring_tasks(self._model, tasks), strict=True):
            self._emit(session, outputs)
            self.metrics.count("audio_gaps", session.stream.num_gaps - session.num_gaps)
            session.num_gaps = session.stream.num_gaps
        self.metrics.observe("chunk_ms", (time.perf_counter() - started_s) * 1e3)

    def _on_end(self, end: EndOfAudio, sender: Peer) -> None:
        self._process_queued()
        session = self._admit(end, sender)
        if session is not None:
            self._finish(session)

    def _admit(self, message: AudioChunk | EndOfAudio, sender: Peer) -> _Session | None:
        """Return the session if the sender may write to it, in order."""
        session = self._sessions.get(message.session)
        if session is None:
            text = f"there is no session {message.session!r} here; open it at control"
            self._refuse(message, sender, ErrorCode.UNKNOWN_SESSION, text)
        elif not secrets.compare_digest(session.start.token.encode(), message.token.encode()):
            text = f"the token is not that of session {message.session!r}"
            self._refuse(message, sender, ErrorCode.BAD_TOKEN, text)
        elif session.finished:
            text = f"session {message.session!r} has ended; open another"
            self._refuse(message, sender, ErrorCode.FINISHED, text)
        elif message.media_time > MAX_MEDIA_TIME:
            text = f"media_time {message.media_time} is no sample index at 16 kHz; count from 0"
            self._refuse(message, sender, ErrorCode.BAD_AUDIO, text)
        elif 0 < message.epoch < session.first_epoch:  # meant for the recognizer before this one
            self.metrics.count("other_epoch")
        elif message.sequence <= session.sequence_in:
            text = f"sequence {message.sequence} came after {session.sequence_in}; it must grow"
            self._refuse(message, sender, ErrorCode.REPLAYED, text)
        else:
            session.sequence_in = message.sequence
            session.last_audio_s = time.monotonic()
            return session
        return None

    def _refuse(self, message: Message, sender: Peer, code: ErrorCode, text: str) -> None:
        self.warn(code, text, message.session)
        self._audio.send(
            Error(session=message.session, media_time=message.media_time, code=code, text=text),
            to=sender,
        )

    # --- out -------------------------------------------------------------------------------------

    def _finish(self, session: _Session) -> None:
        if not session.finished:
            session.finished = True
            self._emit(session, run_scoring_tasks(self._model, [session.stream.finish()])[0])
            LOG.info("end of audio", extra={"session": session.start.session})

    def _emit(self, session: _Session, outputs: Sequence[StreamOutput]) -> None:
        now_s = time.monotonic()
        for output in outputs:
            message = _message_of(output)
            if session.link is not None and not isinstance(output, Waveform):
                session.link.send(message, now_s)
            if isinstance(output, Phone | LipFrame | SpeechChange | Waveform):
                session.sequence_out += 1
                self._phones.send(_addressed(message, session))
            if isinstance(output, SpeechChange) and self.control is not None:
                self.control.send(_addressed(message, session))

    def _connect(self, endpoint: str) -> Socket:
        if endpoint not in self._synthesizers:
            socket = self.bus.connect_dealer(endpoint)
            self._synthesizers[endpoint] = socket
            self.register(socket, {Acknowledge: self._on_acknowledge, Error: self._on_error})
        return self._synthesizers[endpoint]

    def _on_acknowledge(self, ack: Acknowledge, _sender: Peer) -> None:
        session = self._sessions.get(ack.session)
        if session is not None and session.link is not None and ack.epoch == session.start.epoch:
            session.link.acknowledge(ack.sequence, time.monotonic())


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
