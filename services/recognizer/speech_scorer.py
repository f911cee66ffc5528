"""Audio to state scores of speech: what live and offline recognition share.

    samples -> VAD, front end -> [speech only] acoustic model -> events

Time is media time, counted from the first sample of the scorer. Feature frame ``t`` covers the
10 ms around the middle of its window. Any chunking of the same audio gives the same result, because
every step processes whole frames and whole VAD blocks, in order.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Floats, Work
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_POSITION
from kouxing.services.recognizer.front_end.features import HOP_S, SAMPLE_RATE_HZ, WINDOW_S
from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.services.recognizer.front_end.vad import BLOCK_SAMPLES, VoiceActivityDetector
from kouxing.services.recognizer.lip_frames import LipFrameStream
from kouxing.shared.phones.events import (
    AudioSkipped,
    EndOfSound,
    LipPositions,
    Progress,
    Waveform,
)

PRE_ROLL_S = 0.20  # audio before the detection that counts as speech: weak consonants
_FIRST_NEWEST_FRAME = 2  # the newest frame that the network's first position sees
# Speech starts at an odd frame. So every position ends POSITION_LAG_S before a multiple of 20 ms.
_FIRST_FRAME_PARITY = 1
_BLOCK_FRAMES = 10  # of the longest blocks of a network; they start with the speech
_PRE_ROLL_FRAMES = round((PRE_ROLL_S + BLOCK_SAMPLES / SAMPLE_RATE_HZ) / HOP_S)


@dataclass(frozen=True, slots=True)
class SpeechStart:
    """Speech starts. Its first scored frame is ``frame``."""

    frame: int


@dataclass(frozen=True, slots=True)
class SpeechEnd:
    """Speech has ended before ``frame``."""

    frame: int


@dataclass(frozen=True, slots=True)
class FrameScores:
    """State scores of the next frames of speech."""

    settled: Floats  # (m, states) of the frames after those settled before
    provisional: Floats  # (k, states) of the frames after those, until the next FrameScores


WithProgress: TypeAlias = Callable[[Sequence[Any]], Iterable[Any]]  # ``iter``, or a progress bar
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


def frame_time_s(frame: int) -> float:
    """Time of the boundary before a feature frame: halfway between two windows' middles."""
    return frame * HOP_S + (WINDOW_S - HOP_S) / 2


def frame_at(time_s: float) -> int:
    """Return the feature frame whose preceding boundary is nearest to a time."""
    return round((time_s - (WINDOW_S - HOP_S) / 2) / HOP_S)


class SpeechScorer:
    """Scores the speech of one session.

    ``accept_waveform`` queues the audio, ``score_streams`` scores it together with other sessions'
    audio, and ``get_events`` returns the results in order.

    Parameters
    ----------
    model, lip_stream
        The acoustic model must have positions if there are lip frames.
    start_frame
        Frame at which speech started, if another recognizer processed its start; negative before
        the audio. The first speech then starts where the network's blocks align with those of the
        other recognizer.
    """

    def __init__(
        self,
        model: AcousticModel,
        lip_stream: LipFrameStream | None = None,
        start_frame: int | None = None,
    ) -> None:
        self._stream = model.create_stream(keep_positions=lip_stream is not None)
        self._lip_stream = lip_stream
        self._detector = VoiceActivityDetector()
        self._start_frame = start_frame
        self._front_end = model.create_front_end()
        self._block = np.empty(0, np.float32)  # of the VAD, incomplete
        self._recent: deque[Floats] = deque(maxlen=_PRE_ROLL_FRAMES + _BLOCK_FRAMES - 1)
        self._num_frames = 0
        self._speaking = False
        # Frames to score, and events in order. The first item is to be scored; SpeechEnd is too.
        self._queue: deque[Floats | ScoreEvent] = deque()
        self._events: list[ScoreEvent] = []  # not yet returned
        self._next_newest = 0  # frame at which the network's next position ends

    def accept_waveform(self, samples: Floats) -> None:
        """Queue samples, 16 kHz mono, shape (n,)."""
        while len(samples):  # cut at the ends of the VAD's blocks
            piece = samples[: BLOCK_SAMPLES - len(self._block)]
            samples = samples[len(piece) :]
            self._block = np.concatenate([self._block, piece])
            self._queue_frames(self._front_end.accept_waveform(piece))
            if len(self._block) == BLOCK_SAMPLES:
                self._detect_speech()
                self._block = self._block[:0]

    def input_finished(self) -> None:
        """End the audio."""
        if self._speaking:
            self._end_speech()

    def add_event(self, event: ScoreEvent) -> None:
        """Queue an event, to be returned after the results of the audio so far."""
        self._queue.append(event)
        self._release_events()

    @property
    def is_ready(self) -> bool:
        """Whether there is audio to score."""
        return bool(self._queue)

    def get_events(self) -> list[ScoreEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def _queue_frames(self, frames: Floats) -> None:
        """Queue the front end's frames, shape (n, k), if they are speech.

        Each piece ends with a position, so that any chunking gives the same provisional scores.
        """
        if not self._speaking:
            self._num_frames += len(frames)
            self._recent.extend(frames)
            return
        while len(frames):
            piece = frames[: FRAMES_PER_POSITION - self._num_frames % FRAMES_PER_POSITION]
            frames = frames[len(piece) :]
            self._num_frames += len(piece)
            self._queue.append(piece)

    def _detect_speech(self) -> None:
        """Start or end speech, depending on the complete VAD block."""
        is_speech = self._detector.detect(self._block).is_speech
        first = self._first_frame()
        if is_speech and not self._speaking and self._num_frames - first >= FRAMES_PER_POSITION:
            self._speaking = True
            self._start_frame = None
            self.add_event(SpeechStart(first))
            self._queue.append(np.array(self._recent)[first - self._num_frames :])
            self._recent.clear()
        elif self._speaking and not is_speech:
            self._end_speech()

    def _first_frame(self) -> int:
        """Return the frame at which speech starts if it is detected now."""
        oldest = self._num_frames - len(self._recent)
        first = max(oldest, self._num_frames - _PRE_ROLL_FRAMES)
        first += (_FIRST_FRAME_PARITY - first) % FRAMES_PER_POSITION
        if self._start_frame is not None:
            first -= (first - self._start_frame) % _BLOCK_FRAMES
            first += _BLOCK_FRAMES * (first < oldest)
        return first

    def _end_speech(self) -> None:
        self._speaking = False
        self._queue.append(SpeechEnd(self._num_frames))

    def _release_events(self) -> None:
        """Make the events available that no queued audio precedes."""
        while self._queue and not isinstance(event := self._queue[0], np.ndarray | SpeechEnd):
            self._queue.popleft()
            if isinstance(event, SpeechStart):
                self._next_newest = event.frame + _FIRST_NEWEST_FRAME
                if self._lip_stream is not None:
                    self._lip_stream.reset()
            self._events.append(event)

    def next_work(self) -> Work:
        """Return the audio to score next."""
        item = self._queue[0]
        self._last_provisional = self._stream.provisional
        return self._stream, item if isinstance(item, np.ndarray) else None

    def add_scores(self, settled: Floats) -> None:
        """Add the settled scores of ``next_work``, (m, states)."""
        item, provisional = self._queue.popleft(), self._stream.provisional
        if len(settled) or provisional is not self._last_provisional:
            self._events.append(FrameScores(settled, provisional))
        if isinstance(item, SpeechEnd):  # positions at the end see repeated frames, not audio
            self._events.append(item)
        elif self._lip_stream is not None:
            for position in self._stream.positions:
                known_s = self._next_newest * HOP_S + WINDOW_S
                self._events += self._lip_stream.process_position(known_s, *position)
                self._next_newest += FRAMES_PER_POSITION
        self._stream.positions.clear()
        self._release_events()


def score_streams(model: AcousticModel, scorers: Sequence[SpeechScorer]) -> None:
    """Score the queued audio of several sessions, in batches."""
    while ready := [scorer for scorer in scorers if scorer.is_ready]:
        scores = model.score([scorer.next_work() for scorer in ready])
        for scorer, settled in zip(ready, scores, strict=True):
            scorer.add_scores(settled)


def score_recording(
    model: AcousticModel,
    samples: Floats,
    sample_rate_hz: int,
    lip_stream: LipFrameStream | None = None,
    *,
    silence_s: float = 0.0,
    with_progress: WithProgress = iter,
) -> Iterator[ScoreEvent]:
    """Score a whole recording, second by second.

    Parameters
    ----------
    model, lip_stream
        As for :class:`SpeechScorer`.
    samples
        The recording, shape (n,) or (n, channels).
    sample_rate_hz
        Sample rate of the recording.
    silence_s
        Duration of the silence to append.
    with_progress
        Shows the progress.
    """
    scorer = SpeechScorer(model, lip_stream)
    resampler = Resampler(sample_rate_hz, 1 if samples.ndim == 1 else samples.shape[1])

    def score(more: Floats) -> list[ScoreEvent]:
        scorer.accept_waveform(more)
        score_streams(model, [scorer])
        return scorer.get_events()

    for start in with_progress(range(0, len(samples), sample_rate_hz)):
        yield from score(resampler.accept_waveform(samples[start : start + sample_rate_hz]))
    yield from score(resampler.finish())
    yield from score(np.zeros(round(silence_s * SAMPLE_RATE_HZ), np.float32))
    scorer.input_finished()
    yield from score(np.zeros(0, np.float32))
