"""The recognizer as a service: audio chunks in, phones and speech events out.

Reacts to: audio, finish (clients), start, stop, drop (control), ack (synthesizer).
Emits: phone, speech, progress, spoken (synthesizer, acknowledged), the same phones, speech and the
sound itself (observers), speech (control), error (clients).
"""

from __future__ import annotations

import dataclasses
import secrets
import time
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import AcousticModel, Listening, listen
from services.recognizer.load import load_model, model_path
from services.recognizer.pcm import SLICE, BadAudio, level_db, pcm16_of, samples_of, slices
from services.recognizer.pipeline import Recognizer, warm_up
from services.recognizer.resample import Resampler
from shared.bus import AUDIO_QUEUE_LENGTH, Socket
from shared.clock import to_samples
from shared.config import RecognizerConfig, reachable
from shared.logs import LOG
from shared.messages import (
    MEDIA_RATE_HZ,
    Acknowledge,
    AudioChunk,
    EndOfAudio,
    EndOfPhones,
    Error,
    Message,
    PhoneHeard,
    Progress,
    Sound,
    Speech,
    StartSession,
)
from shared.phones import Phone, SpeechChange
from shared.reliable import ReliableSender
from shared.service import Service

GAP = MEDIA_RATE_HZ // 10  # a jump of media time by more than this is a pause, less is jitter
LAST_MEDIA_TIME = 2**40  # two years of samples; more is no sample index
BACKLOG_LIMIT = 2000  # messages the synthesizer may owe acknowledgement for before audio waits
BACKLOG_LIMIT_S = 5.0  # for so long; then the session's link is given up for the others' sake
MOST_WAITING_S = 0.3  # of audio, all sessions', that is heard together

Chunk: TypeAlias = tuple[int, NDArray[np.float32]]  # media time; samples, (n, channels)


class _Stream:
    """One session's audio on its way to phones."""

    def __init__(self, start: StartSession, model: AcousticModel, rule: tuple[int, float]) -> None:
        self.start = start
        self.link: ReliableSender | None = None
        self.sequence_in = 0
        self.sequence_out = 0
        self.heard_s = time.monotonic()
        self.finished = False
        self.speaking = False
        self.num_gaps = 0  # not yet counted
        self.late_since_s: float | None = None  # since when the synthesizer owes too much
        self._origin_in: int | None = None  # media time of the first chunk without a gap since
        self._num_in = 0  # samples in the session's own rate since then
        self._model = model
        self._rule = rule
        self._next_index = 0
        self.restart(0)

    @property
    def media_time_in(self) -> int | None:
        """Media time of the next chunk if nothing is lost; None before the first."""
        if self._origin_in is None:
            return None
        return self._origin_in + self._num_in * MEDIA_RATE_HZ // self.start.sample_rate_hz

    def begin(self, media_time: int) -> None:
        """Begin anew with a chunk that does not follow the last one."""
        self._origin_in, self._num_in = media_time, 0
        self.restart(media_time)

    def restart(self, media_time: int) -> None:
        """Forget what was being said; the next audio is that of a media time."""
        self.origin = media_time
        self.num_samples = 0
        self._slice: list[NDArray[np.float32]] = []  # what came of the 20 ms under way
        self._index_base = self._next_index
        self._resampler = Resampler(self.start.sample_rate_hz, self.start.num_channels)
        agreement, least_confidence = self._rule
        self._recognizer = Recognizer(
            self._model,
            sample_rate_hz=MEDIA_RATE_HZ,
            agreement=agreement,
            least_confidence=least_confidence,
        )

    @property
    def media_time(self) -> int:
        """Up to here the audio has been heard."""
        return self.origin + self.num_samples

    def hear_chunks(self, chunks: list[Chunk]) -> Listening[list[Message]]:
        """Take chunks in order; return what is to be said about them."""
        messages: list[Message] = []
        for media_time, samples in chunks:
            expected = self.media_time_in
            if expected is None:
                self.begin(media_time)
            elif media_time > expected + GAP:
                self.num_gaps += 1
                messages += yield from self.hear_end()
                self.begin(media_time)
            messages += yield from self._hear(samples)
        return messages

    def _hear(self, samples: NDArray[np.float32]) -> Listening[list[Message]]:
        self._num_in += len(samples)
        mono = self._resampler.accept_waveform(samples)
        messages: list[Message] = [Sound(media_time=self.media_time, pcm=pcm16_of(mono))]
        for part in slices(mono, self.num_samples):
            self.num_samples += len(part)
            self._slice.append(part)
            messages += self._as_messages((yield from self._recognizer.hear(part)))
            if self.num_samples % SLICE == 0:
                level = level_db(np.concatenate(self._slice))
                messages.append(Progress(media_time=self.media_time, level_db=level))
                self._slice.clear()
        return messages

    def hear_end(self) -> Listening[list[Message]]:
        """End the audio; return what is left to say."""
        mono = self._resampler.finish()
        sound = Sound(media_time=self.media_time, pcm=pcm16_of(mono))
        self.num_samples += len(mono)
        results = yield from self._recognizer.hear(mono)
        said = self._as_messages(results + (yield from self._recognizer.hear_end()))
        if self.speaking:
            self.speaking = False
            said.append(Speech(media_time=self.media_time, active=False))
        return [sound, *said, Progress(media_time=self.media_time, level_db=-120.0)]

    def _as_messages(self, results: list[Phone | SpeechChange]) -> list[Message]:
        messages: list[Message] = []
        for result in results:
            if isinstance(result, SpeechChange):
                self.speaking = result.active
                media_time = self.origin + to_samples(result.time_s)
                messages.append(Speech(media_time=media_time, active=result.active))
            else:
                index = self._index_base + result.index
                self._next_index = max(self._next_index, index + 1)
                messages.append(
                    PhoneHeard(
                        media_time=self.origin + to_samples(result.onset_s),
                        index=index,
                        unit=result.unit,
                        duration=to_samples(result.duration_s),
                        confidence=result.confidence,
                        final=result.final,
                    )
                )
        return messages


class RecognizerService(Service):
    """The recognizer process."""

    name = "recognizer"

    def __init__(self, config: RecognizerConfig) -> None:
        super().__init__(config)
        self._rule = (config.agreement, config.least_confidence)
        self._streams: dict[str, _Stream] = {}
        self._waiting: dict[str, list[Chunk]] = {}  # to be heard, by session
        self._waiting_s = 0.0
        self._synthesizers: dict[str, Socket] = {}  # by endpoint
        self._audio = self.bus.bind_router(
            config.audio, "recognizer.audio", queue_length=AUDIO_QUEUE_LENGTH
        )
        self._phones = self.bus.bind_publisher(config.phones, "recognizer.phones")
        self.endpoints = {
            "audio": reachable(self._audio.endpoint, config.advertise, "recognizer.audio"),
            "phones": reachable(self._phones.endpoint, config.advertise, "recognizer.phones"),
        }
        self._model = load_model(model_path(config.acoustic), look_ahead_ms=config.look_ahead_ms)
        warm_up(self._model)
        self.listen(self._audio, {AudioChunk: self._on_audio, EndOfAudio: self._on_finish})
        self.listen(self._phones, {})

    def step(self, timeout_s: float) -> None:
        """Take in what has arrived, then hear what all sessions said, together."""
        super().step(timeout_s)
        self._hear_waiting()

    def start_session(self, start: StartSession) -> bool:
        """Make a stream, or after a crash of the synthesizer give the old one a new link."""
        self._hear_waiting()
        stream = self._streams.get(start.session)
        if stream is None or stream.start.token != start.token:
            stream = _Stream(start, self._model, self._rule)
            self._streams[start.session] = stream
        if stream.link is None or stream.start.epoch != start.epoch:
            stream.start = start
            owed = stream.link.waiting if stream.link is not None else ()
            socket = self._connect(start.phone_input)
            stream.link = ReliableSender(socket, start.session, start.epoch)
            for message in owed:
                stream.link.send(message, time.monotonic())
        return True

    def stop_session(self, session: str) -> None:
        """Forget a session."""
        self._hear_waiting()
        self._streams.pop(session, None)

    def flush_session(self, session: str) -> None:
        """Forget what was being said; the next audio begins anew."""
        self._hear_waiting()
        stream = self._streams.get(session)
        if stream is not None:
            media_time = stream.media_time_in
            stream.restart(stream.media_time if media_time is None else media_time)
            if stream.speaking:
                stream.speaking = False
                self._say(stream, [Speech(media_time=stream.media_time, active=False)])

    def on_tick(self, now_s: float) -> None:
        """Repeat what the synthesizer did not acknowledge, and let audio wait if it is behind."""
        any_late = False
        for session, stream in self._streams.items():
            if stream.link is None:
                continue
            self.metrics.count("resent", stream.link.tick(now_s))
            if stream.link.backlog <= BACKLOG_LIMIT:
                stream.late_since_s = None
                continue
            any_late = True
            stream.late_since_s = stream.late_since_s or now_s
            if now_s - stream.late_since_s > BACKLOG_LIMIT_S:
                self.warn("no-link", "the synthesizer takes no phones; they are dropped", session)
                stream.link = None
        self.pause(self._audio, paused=any_late)

    def on_drain(self) -> bool:
        """Finish every utterance and wait until the synthesizer has it."""
        self._hear_waiting()
        for stream in self._streams.values():
            self._finish(stream)
        return all(s.link is None or s.link.backlog == 0 for s in self._streams.values())

    def idle_s(self) -> dict[str, float]:
        """Return the seconds since each session's last audio."""
        now_s = time.monotonic()
        return {name: now_s - stream.heard_s for name, stream in self._streams.items()}

    # --- from clients ----------------------------------------------------------------------------

    def _on_audio(self, chunk: AudioChunk, sender: bytes) -> None:
        stream = self._admit(chunk, sender)
        if stream is None:
            return
        try:
            samples = samples_of(chunk.pcm, stream.start.encoding, stream.start.num_channels)
        except BadAudio as error:
            self._refuse(chunk, sender, "bad-audio", str(error))
            return
        rate_hz = stream.start.sample_rate_hz
        piece = round(MOST_WAITING_S * rate_hz)
        for begin in range(0, max(1, len(samples)), piece):  # long chunks keep nobody waiting long
            part = samples[begin : begin + piece]
            media_time = chunk.media_time + begin * MEDIA_RATE_HZ // rate_hz
            self._waiting.setdefault(chunk.session, []).append((media_time, part))
            self._waiting_s += len(part) / rate_hz
            if self._waiting_s >= MOST_WAITING_S:
                self._hear_waiting()
                self.beat_if_due()

    def _hear_waiting(self) -> None:
        """Hear the chunks that wait; the network scores all sessions' frames in one go."""
        if not self._waiting:
            return
        started_s = time.perf_counter()
        streams = [self._streams[session] for session in self._waiting]
        listenings = [
            stream.hear_chunks(chunks)
            for stream, chunks in zip(streams, self._waiting.values(), strict=True)
        ]
        self._waiting, self._waiting_s = {}, 0.0
        for stream, said in zip(streams, listen(self._model, listenings), strict=True):
            self._say(stream, said)
            self.metrics.count("audio_gaps", stream.num_gaps)
            stream.num_gaps = 0
        self.metrics.observe("chunk_ms", (time.perf_counter() - started_s) * 1e3)

    def _on_finish(self, end: EndOfAudio, sender: bytes) -> None:
        self._hear_waiting()
        stream = self._admit(end, sender)
        if stream is not None:
            self._finish(stream)

    def _admit(self, message: AudioChunk | EndOfAudio, sender: bytes) -> _Stream | None:
        """Return the session's stream if the sender may write to it, in order."""
        stream = self._streams.get(message.session)
        if stream is None:
            text = f"there is no session {message.session!r} here; open it at control"
            self._refuse(message, sender, "unknown-session", text)
        elif not secrets.compare_digest(stream.start.token.encode(), message.token.encode()):
            text = f"the token is not that of session {message.session!r}"
            self._refuse(message, sender, "bad-token", text)
        elif stream.finished:
            text = f"session {message.session!r} has ended; open another"
            self._refuse(message, sender, "finished", text)
        elif message.media_time > LAST_MEDIA_TIME:
            text = f"media_time {message.media_time} is no sample index at 16 kHz; count from 0"
            self._refuse(message, sender, "bad-audio", text)
        elif message.sequence <= stream.sequence_in:
            text = f"sequence {message.sequence} came after {stream.sequence_in}; it must grow"
            self._refuse(message, sender, "replayed", text)
        else:
            stream.sequence_in = message.sequence
            stream.heard_s = time.monotonic()
            return stream
        return None

    def _refuse(self, message: Message, sender: bytes, code: str, text: str) -> None:
        self.warn(code, text, message.session)
        self._audio.send(
            Error(session=message.session, media_time=message.media_time, code=code, text=text),
            to=sender,
        )

    # --- out -------------------------------------------------------------------------------------

    def _finish(self, stream: _Stream) -> None:
        if not stream.finished:
            stream.finished = True
            self._say(stream, listen(self._model, [stream.hear_end()])[0])
            self._say(stream, [EndOfPhones(media_time=stream.media_time)])
            LOG.info("end of audio", extra={"session": stream.start.session})

    def _say(self, stream: _Stream, messages: list[Message]) -> None:
        now_s = time.monotonic()
        for message in messages:
            if isinstance(message, Sound):
                stream.sequence_out += 1
                self._phones.send(_addressed(message, stream))
                continue
            if stream.link is not None:
                stream.link.send(message, now_s)
            if isinstance(message, PhoneHeard | Speech):
                stream.sequence_out += 1
                self._phones.send(_addressed(message, stream))
            if isinstance(message, Speech) and self.control is not None:
                self.control.send(_addressed(message, stream))

    def _connect(self, endpoint: str) -> Socket:
        if endpoint not in self._synthesizers:
            socket = self.bus.connect_dealer(endpoint)
            self._synthesizers[endpoint] = socket
            self.listen(socket, {Acknowledge: self._on_acknowledge, Error: self._on_error})
        return self._synthesizers[endpoint]

    def _on_acknowledge(self, ack: Acknowledge, _sender: bytes) -> None:
        stream = self._streams.get(ack.session)
        if stream is not None and stream.link is not None and ack.epoch == stream.start.epoch:
            stream.link.acknowledge(ack.sequence, time.monotonic())


def _addressed(message: Message, stream: _Stream) -> Message:
    return dataclasses.replace(
        message,
        session=stream.start.session,
        epoch=stream.start.epoch,
        sequence=stream.sequence_out,
    )
