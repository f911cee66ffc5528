"""Finds speech in audio and scores it with the acoustic model.

    samples -> speech segmenter -> [speech only] acoustic model -> events

Any chunking of the same audio gives the same result.
"""

from collections import deque
from collections.abc import Sequence
from typing import TypeAlias

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    AcousticStream,
    ScoreRequest,
)
from kouxing.services.recognizer.acoustic.blocks import BlockModel, BlockStream
from kouxing.services.recognizer.acoustic.encoder import (
    EncoderOutput,
    EncoderStream,
    process_encoder_frames,
)
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.lips.lip_prediction import LipPredictorStream
from kouxing.services.recognizer.live.speech_segmenter import (
    EncoderInput,
    SpeechEnd,
    SpeechFrames,
    SpeechSegmenter,
    SpeechStart,
)
from kouxing.shared.arrays import Floats
from kouxing.shared.fast_record import Record, replace
from kouxing.shared.phones.events import AudioSkipped, EndOfSound, LipPositions, Progress, Waveform


class FrameScores(Record, frozen=True):
    """State scores of the next frames of speech."""

    settled: Floats  # (m, states) of the frames after the last settled frame
    provisional: Floats  # (k, states) of the frames after ``settled``, until the next event


ScoreEvent: TypeAlias = (
    SpeechStart
    | SpeechEnd
    | FrameScores
    | LipPositions
    | Progress
    | AudioSkipped
    | EndOfSound
    | Waveform
)


EarlyEvent: TypeAlias = LipPositions | Progress | Waveform


class _SliceEnd(Record, frozen=True):
    """The end of a slice of 20 ms."""

    progress: Progress  # the slice's measurement, without the traits of the voice


class SpeechScorer:
    """Scores the speech of one session.

    ``accept_waveform`` queues the audio. ``detect_speech`` finds the speech in it and
    ``score_speech`` scores the speech, together with other sessions' audio. ``get_events`` returns
    the results in order.

    For the other parameters, see :class:`SpeechSegmenter`.
    """

    def __init__(
        self,
        model: AcousticModel,
        lip_stream: LipPredictorStream | None = None,
        start_frame: int | None = None,
    ) -> None:
        self._default_stream: AcousticStream = model.create_stream()
        self._stream = self._default_stream  # the stream in use
        self._block_stream = (
            self._default_stream if isinstance(self._default_stream, BlockStream) else None
        )
        light = model.light_model if isinstance(model, BlockModel) else None
        self._light_stream = light.create_stream() if light else None
        front_end = (
            WhisperMel() if self._default_stream.uses_encoder_phones else model.create_front_end()
        )
        self._segmenter = SpeechSegmenter(front_end, lip_stream, start_frame)
        # Audio that the encoder has not processed, and events, in order; None: the end of the audio
        self._encoder_queue: deque[EncoderInput | _SliceEnd | ScoreEvent | None] = deque()
        self._needs_light = False  # whether the light model scores the next speech
        # Frames to score, and events, in order. The first item is SpeechFrames or SpeechEnd.
        self._queue: deque[SpeechFrames | ScoreEvent] = deque()
        self._detected = self._queue  # output of the encoder; a separate queue during scoring
        self._events: list[ScoreEvent] = []  # not yet returned
        self._num_unscored = 0  # frames of the current speech without settled scores

    @property
    def uses_light_model(self) -> bool:
        """Whether the light model scores the speech."""
        return self._stream.uses_encoder_phones

    def set_light_model(self, uses_light_model: bool) -> None:
        """Switch to the light model now, or back at the next start of speech."""
        self._needs_light = uses_light_model
        if (
            not uses_light_model
            or self._light_stream is None
            or self.uses_light_model
            or self._queue
        ):
            return
        provisional = self._stream.provisional
        if len(provisional):
            self._events.append(FrameScores(provisional, provisional[:0]))
        self._default_stream.reset()
        self._light_stream.start(self._num_unscored - len(provisional))
        self._stream = self._light_stream

    @property
    def needs_network(self) -> bool:
        """Whether scoring the queued audio needs a run of the block network."""
        if self._block_stream is None or self._stream is not self._block_stream:
            return False
        frames = (item.features for item in self._queue if isinstance(item, SpeechFrames))
        has_end = any(isinstance(item, SpeechEnd) for item in self._queue)
        return has_end or self._block_stream.is_due_after(sum(map(len, frames)))

    def set_hop(self, num_blocks: int) -> None:
        """Set the hop of the block network, if the session uses it."""
        if self._block_stream is not None:
            self._block_stream.set_hop(num_blocks)

    def accept_waveform(self, samples: Floats, progress: Progress | None = None) -> None:
        """Queue samples, 16 kHz mono, shape (n,), and the measurement of a slice that they end."""
        self._encoder_queue.extend(self._segmenter.encoder_inputs(samples))
        if progress is not None:
            self._encoder_queue.append(_SliceEnd(progress))

    def input_finished(self) -> None:
        """End the audio."""
        self._encoder_queue.append(None)

    def add_event(self, event: ScoreEvent) -> None:
        """Queue an event, to be returned after the results of the audio so far."""
        self._encoder_queue.append(event)

    def next_encoder_input(self) -> EncoderInput | None:
        """Return the next encoder frame to process, or None if the queue is empty."""
        while self._encoder_queue:
            item = self._encoder_queue[0]
            if isinstance(item, EncoderInput):
                return item
            self._encoder_queue.popleft()
            if item is None:
                self._detected.extend(self._segmenter.input_finished())
            elif isinstance(item, _SliceEnd):
                traits = self._segmenter.traits._asdict()
                self._detected.append(replace(item.progress, **traits))
            else:
                self._detected.append(item)
        if self._detected is self._queue:
            self._release_events()
        return None

    @property
    def encoder(self) -> EncoderStream:
        """The stream that processes the encoder frames."""
        return self._segmenter.encoder

    def add_encoder_output(self, encoder_input: EncoderInput, output: EncoderOutput) -> None:
        """Add the output of the encoder at ``next_encoder_input``."""
        self._encoder_queue.popleft()
        self._detected.extend(self._segmenter.process(encoder_input, output))

    def begin_background_scoring(self) -> bool:
        """Hand the speech so far to another thread; return whether more audio may follow now.

        If so, ``detect_speech`` and ``take_early_events`` process only audio that follows, until
        ``end_background_scoring``. Queued events prevent this, because their order would change.
        """
        if all(isinstance(item, SpeechFrames) for item in self._queue):
            self._detected = deque()
        return self._detected is not self._queue

    def end_background_scoring(self) -> None:
        """Take the speech back: this thread scores the speech that follows."""
        if self._detected is not self._queue:
            self._queue.extend(self._detected)
            self._detected = self._queue

    @property
    def has_speech(self) -> bool:
        """Whether there is speech to score, or its end."""
        return bool(self._queue)

    @property
    def model(self) -> AcousticModel:
        """The model that scores the next audio."""
        return self._stream.model

    def get_events(self) -> list[ScoreEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def _release_events(self) -> None:
        """Release the events that precede all queued audio."""
        while self._queue and not isinstance(event := self._queue[0], SpeechFrames | SpeechEnd):
            self._queue.popleft()
            self._events.append(event)
            if isinstance(event, SpeechStart):
                self._stream = (self._needs_light and self._light_stream) or self._default_stream
                self._num_unscored = 0

    def take_early_events(self) -> list[EarlyEvent]:
        """Return lip positions and levels of unscored speech, before its phones."""
        unscored: list[SpeechFrames] = []
        early: list[EarlyEvent] = []
        while self._detected and isinstance(item := self._detected[0], SpeechFrames | EarlyEvent):
            self._detected.popleft()
            if isinstance(item, SpeechFrames):
                unscored.append(item)
            else:
                early.append(item)
        self._detected.extendleft(reversed(unscored))
        return early

    def next_request(self) -> ScoreRequest:
        """Return the audio to score next."""
        item, stream = self._queue[0], self._stream
        self._last_provisional = stream.provisional
        if not isinstance(item, SpeechFrames):
            return stream, None
        self._num_unscored += len(item.features)
        return stream, item.phones if stream.uses_encoder_phones else item.features

    def add_scores(self, settled: Floats) -> None:
        """Add the settled scores of ``next_request``, (m, states)."""
        item, provisional = self._queue.popleft(), self._stream.provisional
        self._num_unscored -= len(settled)
        if len(settled) or provisional is not self._last_provisional:
            self._events.append(FrameScores(settled, provisional))
        if isinstance(item, SpeechEnd):
            self._events.append(item)
        self._release_events()


def detect_speech(scorers: Sequence[SpeechScorer]) -> None:
    """Find the speech in the queued audio of several sessions, in batches."""
    while waiting := [
        (scorer, encoder_input)
        for scorer in scorers
        if (encoder_input := scorer.next_encoder_input())
    ]:
        streams = [scorer.encoder for scorer, _ in waiting]
        outputs = process_encoder_frames(
            streams, [encoder_input.mels for _, encoder_input in waiting]
        )
        for (scorer, encoder_input), output in zip(waiting, outputs, strict=True):
            scorer.add_encoder_output(encoder_input, output)


def score_streams(scorers: Sequence[SpeechScorer]) -> None:
    """Score the queued audio of several sessions, in one batch for each model."""
    detect_speech(scorers)
    score_speech(scorers)


def score_speech(scorers: Sequence[SpeechScorer]) -> None:
    """Score the speech that ``detect_speech`` has found, in one batch for each model."""
    while ready := [scorer for scorer in scorers if scorer.has_speech]:
        model = ready[0].model
        batch = [scorer for scorer in ready if scorer.model is model]
        scores = model.score([scorer.next_request() for scorer in batch])
        for scorer, settled in zip(batch, scores, strict=True):
            scorer.add_scores(settled)
