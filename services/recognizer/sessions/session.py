"""One session of the recognizer service: its audio, its stream and its synthesizer."""

import math
import secrets
from collections.abc import Iterator, Sequence
from typing import TypeVar

from kouxing_client.messages import Message, Phone, Speech

from kouxing.services.recognizer.lips.lip_prediction import LipPredictor
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.sessions.audio_queue import AudioQueue
from kouxing.services.recognizer.sessions.resumption import Chunk, ReplayWindow, ResumeFilter
from kouxing.services.recognizer.sessions.sound_messages import SoundMessages
from kouxing.services.recognizer.sessions.synthesizer_link import SynthesizerLink
from kouxing.shared.audio.encoding_check import EncodingCheck
from kouxing.shared.audio.pcm import decode_pcm
from kouxing.shared.clock import CLIENT_CLOCK_RATE, MAX_GAP_S, MEDIA_RATE_HZ, to_seconds
from kouxing.shared.errors import Rejected, UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.network.peer import NO_PEER
from kouxing.shared.network.replaying_publisher import ReplayingPublisher
from kouxing.shared.network.sockets import Socket
from kouxing.shared.phones.events import Waveform
from kouxing.shared.service.overload import CATCH_UP_S, SkipPolicy
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.events import SpeechMessage, event_to_message
from kouxing.shared.wire.face import CurrentFace
from kouxing.shared.wire.session import AudioChunk, ErrorCode
from kouxing.shared.wire.speech import (
    Acknowledge,
    Acoustic,
    AcousticModelName,
    AudioState,
    LipPositions,
    Progress,
)

MAX_MEDIA_TIME = 2**40  # samples: two years
MAX_LEAD_S = 15.0  # limit for the lead of a paced client over the clock, and for catching up
ACKNOWLEDGE_EVERY_S = 0.1  # interval between acknowledgements to a client that sends audio
STALLED_AFTER_S = 0.2  # a live client that sends no audio for this time has stalled
JITTER_S = 0.1  # a client that sends longer bursts has stalled if the next is this much late
MAX_BURST_S = 1.0  # longer bursts count as this duration
MOVE_GRACE_S = 3.0  # extra time after a move, for the client to connect to this recognizer
RESEND_WAIT_S = 1.0  # wait for resent audio; then the session continues after the gap
M = TypeVar("M", bound=Message)


class RecognizerSession:
    """The state of one session. A mouth profile that does not fit is ignored and reported."""

    def __init__(
        self,
        start: StartSession,
        recognizer: Recognizer,
        lip_predictor: LipPredictor,
        socket: Socket,
        publisher: Socket,
        now_s: float,
        max_lag_s: float,
    ) -> None:
        self.start = start
        self.replay = ReplayingPublisher(publisher, now_s)
        self.first_epoch = start.epoch
        opening = start.opening
        self.is_paced = opening.paced
        self.face = CurrentFace(opening.face, now_s)
        self.socket = socket
        self.mouth_profile_error = ""  # why the profile is not used; empty once reported
        if opening.mouth_profile is not None:
            try:
                lip_predictor = lip_predictor.with_mouth_profile(opening.mouth_profile)
            except UserError as error:
                self.mouth_profile_error = f"the mouth profile is not used: {error}"
        face_delay_s = (start.facts.delay_ms or 0.0) / 1e3
        self.stream = recognizer.create_stream(
            sample_rate_hz=opening.sample_rate_hz,
            lip_predictor=lip_predictor,
            face_delay_s=face_delay_s,
            speech_time=start.speech_time or 0,
            language=start.facts.language,
        )
        self.resume_filter: ResumeFilter | None = None  # after a lost recognizer
        if start.final_until:
            self.resume_filter = ResumeFilter(to_seconds(start.final_until))
        skip_policy = SkipPolicy(
            max_lag_s if opening.paced else math.inf,
            now_s + CATCH_UP_S if start.epoch > 1 else now_s,
        )
        self.audio = AudioQueue(opening.sample_rate_hz, skip_policy)  # not decoded yet
        self.waits_for_network = False  # waits for the block network's thread
        self.is_scoring = False  # on the block network's thread
        self.accepted_s = now_s  # when the stream last took audio, except during scoring
        self.link = SynthesizerLink()
        self.replay_window = ReplayWindow()
        self.last_sequence = 0  # number of the newest accepted audio message
        self._gap_since_s: float | None = None  # when messages after a gap were first dropped
        self.flushed_sequence = 0  # number of the last audio message before an interruption
        self.client = NO_PEER  # sender of the newest audio
        self.last_chunk: AudioChunk | None = None  # None until it has arrived
        self.is_finished = False  # all audio up to the end is decoded
        self.last_audio_s = now_s
        # time in which this process could have received audio but did not
        self.silent_s = -MOVE_GRACE_S if start.epoch > 1 else 0.0
        self.acknowledge_due_s: float | None = None
        self.acknowledged_s = 0.0
        self.speech_time = start.speech_time  # start of the current speech; None: silence
        self.is_laughing = False  # whether the speaker laughs
        # None after a move: the recognizer before may have published another model
        self._published_acoustic = AcousticModelName.FULL if start.epoch <= 1 else None
        self._sound_messages = SoundMessages(face_delay_s)
        is_checked = opening.encoding == "s16le" and start.epoch <= 1
        self._encoding_check = EncodingCheck(opening.num_channels) if is_checked else None
        self.output_sequence = 0
        self.num_gaps_counted = 0
        # After a loss, the client sends the audio that it kept in the meantime.
        self._lead_limit = _LeadLimiter(now_s, may_catch_up=start.epoch > 1)

    @property
    def name(self) -> str:
        """The session's name."""
        return self.start.session

    @property
    def is_decoding(self) -> bool:
        """Whether received audio is not decoded yet."""
        return bool(self.audio) or self.waits_for_network or self.is_scoring

    @property
    def received_sequence(self) -> int:
        """Number of the newest audio message that the client need not resend."""
        if self.last_chunk is None or self.is_finished:
            return self.last_sequence
        return min(self.last_sequence, self.last_chunk.sequence - 1)

    def accept_in_order(self, message: AudioChunk, now_s: float) -> bool:
        """Accept a message newer than the last, unless messages before it are missing.

        ZeroMQ loses messages in flight when a connection ends. A client that asks for
        acknowledgements resends them. Until then, or for ``RESEND_WAIT_S``, later messages are
        dropped. Returns whether the message was accepted.
        """
        is_next = message.sequence - 1 <= max(self.last_sequence, self.flushed_sequence)
        if message.acknowledge and self.last_sequence and not is_next:
            self._gap_since_s = now_s if self._gap_since_s is None else self._gap_since_s
            if now_s < self._gap_since_s + RESEND_WAIT_S:
                return False
        self.last_sequence, self._gap_since_s = message.sequence, None
        return True

    def on_flush(self, sequence: int, now_s: float) -> None:
        """Record an interruption: audio up to this message may be missing, and is not used.

        The client has stopped sending, so the face must return to rest at once.
        """
        self.flushed_sequence = sequence
        self.silent_s = 0.0  # so that a stalled client is reported again
        self.check_stalled(math.inf, now_s)

    def check_sender(self, message: AudioChunk, socket: Socket) -> None:
        """Raise ``Rejected`` if the sender may not send this message here."""
        if not secrets.compare_digest(self.start.token.encode(), message.token.encode()):
            text = f"wrong token for session {self.name!r}; use the token from session-opened"
            raise Rejected(ErrorCode.BAD_TOKEN, text)
        if socket is not self.socket:
            text = f"send the audio of session {self.name!r} to the endpoint in session-opened"
            raise Rejected(ErrorCode.BAD_AUDIO, text)
        if message.sequence == 0:
            text = "the message has no sequence; number audio messages from 1"
            raise Rejected(ErrorCode.BAD_AUDIO, text)

    def check_open(self, message: AudioChunk) -> None:
        """Raise ``Rejected`` if the session has ended or the media time is impossible."""
        if message.media_time > MAX_MEDIA_TIME:
            text = f"media_time {message.media_time} is too large; count samples at 16 kHz from 0"
            raise Rejected(ErrorCode.BAD_AUDIO, text)
        if self.last_chunk is not None:
            text = f"session {self.name!r} has ended; open another"
            raise Rejected(ErrorCode.FINISHED, text)

    def read_chunk(self, chunk: AudioChunk, now_s: float) -> Chunk | None:
        """Return the audio of a message; None if all of it must be skipped.

        Raises ``Rejected`` if the audio is not valid, or too early.
        """
        opening, media_time = self.start.opening, chunk.media_time
        rate_hz = opening.sample_rate_hz
        try:
            samples = decode_pcm(chunk.pcm, opening.encoding, opening.num_channels)
            if self._encoding_check is not None:
                self._encoding_check.check(chunk.pcm)
        except UserError as error:
            raise Rejected(ErrorCode.BAD_AUDIO, str(error)) from None
        duration_s = len(samples) / rate_hz
        if self.is_paced and not self._lead_limit.allows(to_seconds(media_time), duration_s, now_s):
            text = (
                f"the audio is more than {MAX_LEAD_S:g} s ahead of the clock; check sample_rate_hz,"
                " or, to send faster than real time, open the session with paced = false"
            )
            raise Rejected(ErrorCode.BAD_AUDIO, text)
        end = media_time + len(samples) * MEDIA_RATE_HZ // rate_hz
        self.replay_window.add(chunk.sequence, end)
        if self.resume_filter is None:
            return media_time, samples
        aligned = self.resume_filter.align((media_time, samples), rate_hz)
        return aligned if len(aligned[1]) else None

    @property
    def can_accept(self) -> bool:
        """Whether there is queued audio that the stream may take now."""
        if not self.audio:
            return False
        return not self.is_scoring or self.stream.can_accept_while_scoring(self.audio.media_time)

    def accept_waveform(self, max_s: float, now_s: float, hop: int) -> None:
        """Pass up to ``max_s`` of queued audio to the stream. Skip audio that is too old.

        ``hop`` is the hop of the block network, in blocks. During scoring, it does not change, and
        nothing is skipped.
        """
        has_skipped = False
        if not self.is_scoring:
            self.accepted_s = now_s
            self.stream.set_hop(hop)
            has_skipped = self.audio.skip_old(now_s)
            uses_light_model = self.face.settings.acoustic == AcousticModelName.LIGHT
            self.stream.set_light_model(
                uses_light_model or self.audio.skip_policy.needs_light_model(now_s)
            )
        chunks = self.audio.take(max_s)
        while self.can_accept and (chunk := next(chunks, None)) is not None:
            media_time, samples = chunk
            if has_skipped:
                self.stream.skip_to(media_time)
                has_skipped = False
            self.stream.accept_waveform(samples, media_time)

    def check_stalled(self, tick_s: float, now_s: float) -> None:
        """Count time in which no audio arrived; report a live client that has now stalled."""
        before_s, self.silent_s = self.silent_s, self.silent_s + tick_s
        is_live = self.is_paced and not self.is_finished
        if is_live and before_s <= self._stalled_after_s < self.silent_s:
            self._report(AudioState.STALLED, now_s)

    @property
    def _stalled_after_s(self) -> float:
        return max(STALLED_AFTER_S, self._lead_limit.burst_s + JITTER_S)

    def on_new_audio(self, now_s: float) -> None:
        """Record that audio arrived; the face must not return to rest until it is processed."""
        if self.is_paced and self.silent_s > self._stalled_after_s:
            self._report(AudioState.RESUMED, now_s)
            self.audio.skip_policy.resume()
        self.last_audio_s, self.silent_s = now_s, 0.0

    def _report(self, state: AudioState, now_s: float) -> None:
        media_time = max(self.stream.media_time, self.start.final_until)
        self.link.send(Progress(media_time=media_time, state=state), now_s)

    def request_acknowledgement(self, now_s: float, *, at_once: bool) -> None:
        """Schedule an acknowledgement to the client."""
        due_s = now_s if at_once else self.acknowledged_s + ACKNOWLEDGE_EVERY_S
        self.acknowledge_due_s = min(self.acknowledge_due_s or due_s, due_s)

    def acknowledge_if_due(self, now_s: float) -> None:
        """Acknowledge audio that the client need not resend, if this is due."""
        if self.acknowledge_due_s is None or now_s < self.acknowledge_due_s:
            return
        self.acknowledge_due_s, self.acknowledged_s = None, now_s
        acknowledgement = Acknowledge(
            session=self.name, epoch=self.start.epoch, sequence=self.received_sequence
        )
        self.socket.send(acknowledgement, to=self.client)

    def new_results(self) -> list[SpeechMessage | Waveform]:
        """Return the stream's new results, without those that a lost recognizer has emitted."""
        results = self.stream.take_results()
        if self.resume_filter is not None:
            results = self.resume_filter.new_results(results)
        messages = [
            result if isinstance(result, Waveform) else event_to_message(result)
            for result in results
        ]
        for message in messages:
            if isinstance(message, Speech) and not message.active:
                self.speech_time = None
            elif isinstance(message, Speech) and self.speech_time is None:
                self.speech_time = message.media_time
        return messages

    def published_messages(self, results: Sequence[SpeechMessage | Waveform]) -> Iterator[Message]:
        """Yield the messages for subscribers; ``speech`` is first if a recognizer was lost."""
        for result in results:
            if isinstance(result, Phone | LipPositions | Speech):
                yield self._number(result)
            else:
                yield from map(self._number, self._sound_messages.add(result))
        if results:
            yield from self._acoustic_messages(results)

    def _acoustic_messages(self, results: Sequence[SpeechMessage | Waveform]) -> Iterator[Acoustic]:
        """Yield a message about the acoustic model if it has changed or speech starts."""
        model = AcousticModelName.LIGHT if self.stream.uses_light_model else AcousticModelName.FULL
        starts = any(isinstance(result, Speech) and result.active for result in results)
        if model != self._published_acoustic or starts:
            self._published_acoustic = model
            yield self._number(Acoustic(model=model, media_time=self.stream.media_time))

    def _number(self, message: M) -> M:
        self.output_sequence += 1
        return replace(
            message, session=self.name, epoch=self.start.epoch, sequence=self.output_sequence
        )

    def on_acknowledge(self, ack: Acknowledge, now_s: float) -> None:
        """Process the synthesizer's acknowledgement."""
        for message in self.link.acknowledge(ack, now_s):
            self.replay_window.update(message, self.last_sequence)


class _LeadLimiter:
    """Limits how far a paced client's audio is ahead of the clock."""

    def __init__(self, now_s: float, *, may_catch_up: bool) -> None:
        self._lead_s, self._updated_s = -MAX_LEAD_S if may_catch_up else 0.0, now_s
        self._end_s: float | None = None  # media time of the end of the newest audio
        self.burst_s = 0.0  # duration of the newest audio that has arrived together

    def allows(self, begin_s: float, duration_s: float, now_s: float) -> bool:
        """Return whether audio is within the allowed lead, including the gap before it."""
        gap_s = 0.0 if self._end_s is None else max(0.0, begin_s - self._end_s)
        passed_s = (now_s - self._updated_s) * CLIENT_CLOCK_RATE
        lead_s = max(self._lead_s - passed_s, -MAX_LEAD_S) + duration_s
        lead_s += gap_s if gap_s <= MAX_GAP_S else 0.0
        if lead_s > MAX_LEAD_S:
            return False
        # twice as fast as real time, so that a delayed burst does not count for long
        earlier_s = max(self.burst_s - 2.0 * passed_s, 0.0)
        self.burst_s = min(earlier_s + duration_s, MAX_BURST_S)
        self._lead_s, self._updated_s = lead_s, now_s
        self._end_s = begin_s + duration_s
        return True
