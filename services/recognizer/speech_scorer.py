"""Audio to state scores of speech.

    samples -> speech segmenter -> [speech only] acoustic model -> events

Any chunking of the same audio gives the same result.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    AcousticStream,
    Floats,
    Work,
)
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.lip_frames import LipFrameStream
from kouxing.services.recognizer.speech_segmenter import (
    SpeechEnd,
    SpeechFrames,
    SpeechSegmenter,
    SpeechStart,
)
from kouxing.shared.phones.events import (
    AudioSkipped,
    EndOfSound,
    LipPositions,
    Progress,
    Waveform,
)


@dataclass(frozen=True, slots=True)
class FrameScores:
    """State scores of the next frames of speech."""

    settled: Floats  # (m, states) of the frames after those settled before
    provisional: Floats  # (k, states) of the frames after those, until the next FrameScores


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


class SpeechScorer:
    """Scores the speech of one session.

    ``accept_waveform`` queues the audio, ``score_streams`` scores it together with other sessions'
    audio, and ``get_events`` returns the results in order.

    The parameters besides the model are those of :class:`SpeechSegmenter`.
    """

    def __init__(
        self,
        model: AcousticModel,
        lip_stream: LipFrameStream | None = None,
        start_frame: int | None = None,
    ) -> None:
        self._own: AcousticStream = model.create_stream()
        self._stream = self._own  # the one in use
        light = model.light if isinstance(model, BlockModel) else None
        self._light = light.create_stream() if light else None
        front_end = WhisperMel() if self._own.uses_ear else model.create_front_end()
        self._segmenter = SpeechSegmenter(front_end, lip_stream, start_frame)
        self._needs_light = False  # whether the light model scores the next speech
        # Frames to score, and events in order. The first item is to be scored; SpeechEnd is too.
        self._queue: deque[SpeechFrames | ScoreEvent] = deque()
        self._events: list[ScoreEvent] = []  # not yet returned
        self._num_unscored = 0  # frames of the current speech without settled scores

    @property
    def is_light(self) -> bool:
        """Whether the light model scores the speech."""
        return self._stream.uses_ear

    def set_light(self, is_light: bool) -> None:
        """Use the light model, or the session's own model from the next start of speech on."""
        self._needs_light = is_light
        if not is_light or self._light is None or self.is_light or self._queue:
            return
        provisional = self._stream.provisional
        if len(provisional):
            self._events.append(FrameScores(provisional, provisional[:0]))
        self._own.reset()
        self._light.start(self._num_unscored - len(provisional))
        self._stream = self._light

    def accept_waveform(self, samples: Floats, progress: Progress | None = None) -> None:
        """Queue samples, 16 kHz mono, shape (n,), and the measurement of the slice they end."""
        self._queue.extend(self._segmenter.accept_waveform(samples))
        if progress is not None:
            self._queue.append(replace(progress, **self._segmenter.traits._asdict()))
        self._release_events()

    def input_finished(self) -> None:
        """End the audio."""
        self._queue.extend(self._segmenter.input_finished())

    def add_event(self, event: ScoreEvent) -> None:
        """Queue an event, to be returned after the results of the audio so far."""
        self._queue.append(event)
        self._release_events()

    @property
    def is_ready(self) -> bool:
        """Whether there is audio to score."""
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
        """Make the events available that no queued audio precedes."""
        while self._queue and not isinstance(event := self._queue[0], SpeechFrames | SpeechEnd):
            self._queue.popleft()
            self._events.append(event)
            if isinstance(event, SpeechStart):
                self._stream = (self._needs_light and self._light) or self._own
                self._num_unscored = 0

    def next_work(self) -> Work:
        """Return the audio to score next."""
        item, stream = self._queue[0], self._stream
        self._last_provisional = stream.provisional
        if not isinstance(item, SpeechFrames):
            return stream, None
        self._num_unscored += len(item.features)
        return stream, item.phones if stream.uses_ear else item.features

    def add_scores(self, settled: Floats) -> None:
        """Add the settled scores of ``next_work``, (m, states)."""
        item, provisional = self._queue.popleft(), self._stream.provisional
        self._num_unscored -= len(settled)
        if len(settled) or provisional is not self._last_provisional:
            self._events.append(FrameScores(settled, provisional))
        if isinstance(item, SpeechEnd):
            self._events.append(item)
        self._release_events()


def score_streams(scorers: Sequence[SpeechScorer]) -> None:
    """Score the queued audio of several sessions, in one batch for each model."""
    while ready := [scorer for scorer in scorers if scorer.is_ready]:
        model = ready[0].model
        batch = [scorer for scorer in ready if scorer.model is model]
        scores = model.score([scorer.next_work() for scorer in batch])
        for scorer, settled in zip(batch, scores, strict=True):
            scorer.add_scores(settled)
