"""Sound in, state scores of speech out: what live and offline recognition share.

    samples -> resampler -> the model's front end -> [only speech] acoustic model

Time is media time: seconds from the session's first sample. Feature frame ``t`` stands for the
10 ms around the middle of its window. Any chunking of the same sound gives the same result, because
every step works on whole frames and whole blocks of the voice detector, in order.
"""

from __future__ import annotations

import weakref
from collections import deque
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    PositionStream,
    ScoringTask,
    run_scoring_tasks,
)
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_POSITION
from kouxing.services.recognizer.front_end.features import HOP_S, SAMPLE_RATE_HZ, WINDOW_S
from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.services.recognizer.front_end.vad import BLOCK_SAMPLES, VoiceActivityDetector
from kouxing.services.recognizer.lip_source import LipFrameStream
from kouxing.shared.phones.events import LipFrame

PRE_ROLL_S = 0.20  # sound before the detector's decision that counts as speech: weak consonants
_FIRST_NEWEST_FRAME = 2  # the last one that the network's first position has seen
# Speech begins at an odd frame. So every position ends POSITION_LAG_S before a multiple of 20 ms.
_FIRST_FRAME_PARITY = 1
_BLOCK_FRAMES = 10  # of the longest blocks of a network; they begin with the speech
_PRE_ROLL_FRAMES = round((PRE_ROLL_S + BLOCK_SAMPLES / SAMPLE_RATE_HZ) / HOP_S)


@dataclass(frozen=True, slots=True)
class SpeechStart:
    """Speech begins; its first scored frame is ``frame``."""

    frame: int


@dataclass(frozen=True, slots=True)
class SpeechEnd:
    """Speech has ended before ``frame``."""

    frame: int


@dataclass(frozen=True, slots=True)
class FrameScores:
    """State scores of the next frames of speech."""

    settled: NDArray[np.float32]  # (m, states) of the frames after those settled before
    provisional: NDArray[np.float32]  # (k, states) of the frames after them, until the next come


ScoreEvent = SpeechStart | SpeechEnd | LipFrame | FrameScores


def frame_time_s(frame: int) -> float:
    """Time of the boundary before a feature frame: halfway between two windows' middles."""
    return frame * HOP_S + (WINDOW_S - HOP_S) / 2


def frame_at(time_s: float) -> int:
    """Return the feature frame whose boundary before it is nearest to a time."""
    return round((time_s - (WINDOW_S - HOP_S) / 2) / HOP_S)


class SpeechScores:
    """Yields state scores for speech frames, interleaved with speech-start and speech-end events.

    With a stream of lips, the lip frames follow the scores that come with them.

    Parameters
    ----------
    model
        The acoustic model.
    sample_rate_hz
        Rate of the input, 8000 to 48000.
    num_channels
        Channels of the input.
    lips
        The session's lips; they need a model whose streams are ``PositionStream``s.
    under_way
        Frame at which speech that another recognizer has begun began, negative before the sound:
        the first speech begins where blocks lie as there. None: where it is found.
    """

    def __init__(
        self,
        model: AcousticModel,
        sample_rate_hz: int,
        num_channels: int = 1,
        lips: LipFrameStream | None = None,
        under_way: int | None = None,
    ) -> None:
        self._model = model
        self._stream = model.stream()
        self._lips = lips
        if lips is not None and isinstance(self._stream, PositionStream):
            # weakly: in a cycle all would stay until Python looks for cycles
            own = weakref.proxy(self)
            self._stream.on_position = partial(SpeechScores._take_position, own)
        self._resampler = Resampler(sample_rate_hz, num_channels)
        self._detector = VoiceActivityDetector()
        self._under_way = under_way
        self._reset_frames()

    def _reset_frames(self) -> None:
        self._front_end = self._model.front_end()
        self._block = np.empty(0, dtype=np.float32)
        self._recent: deque[NDArray[np.float32]] = deque(
            maxlen=_PRE_ROLL_FRAMES + _BLOCK_FRAMES - 1
        )
        self._num_frames = 0
        self._speaking = False
        self._lip_frames: list[LipFrame] = []  # not yet returned
        self._next_newest = 0  # frame at which the network's next position ends

    @property
    def num_frames_done(self) -> int:
        """Feature frames whose scores, if they are speech, are settled."""
        return max(0, self._num_frames - self._stream.look_ahead_frames)

    def process(self, samples: NDArray[np.float32]) -> ScoringTask[list[ScoreEvent]]:
        """Take samples, shape (n,) or (n, channels); return the new events."""
        return (yield from self._process(self._resampler.accept_waveform(samples)))

    def finish(self) -> ScoringTask[list[ScoreEvent]]:
        """End the stream; return the remaining events."""
        events = yield from self._process(self._resampler.finish())
        return events + ((yield from self._end()) if self._speaking else [])

    def reset(self) -> None:
        """Start a new session: new clock, new speaker."""
        self._stream.reset()
        self._resampler.reset()
        self._detector.reset()
        self._reset_frames()

    def _process(self, samples: NDArray[np.float32]) -> ScoringTask[list[ScoreEvent]]:
        events: list[ScoreEvent] = []
        while len(samples):  # cut at the ends of the detector's blocks
            piece = samples[: BLOCK_SAMPLES - len(self._block)]
            samples = samples[len(piece) :]
            self._block = np.concatenate([self._block, piece])
            events += yield from self._take_frames(self._front_end.accept_waveform(piece))
            if len(self._block) == BLOCK_SAMPLES:
                events += yield from self._detect()
                self._block = self._block[:0]
        return events

    def _take_frames(self, frames: NDArray[np.float32]) -> ScoringTask[list[ScoreEvent]]:
        """Take the front end's frames, shape (n, k).

        They are scored up to the end of each position alone, so that in any chunking the same
        provisional scores come.
        """
        if not self._speaking:
            self._num_frames += len(frames)
            self._recent.extend(frames)
            return []
        events: list[ScoreEvent] = []
        while len(frames):
            piece = frames[: FRAMES_PER_POSITION - self._num_frames % FRAMES_PER_POSITION]
            frames = frames[len(piece) :]
            self._num_frames += len(piece)
            events += yield from self._score(piece)
        return events

    def _detect(self) -> ScoringTask[list[ScoreEvent]]:
        """Begin or end speech by the block that is complete."""
        speech = self._detector.accept_block(self._block).is_speech
        begin = self._first_frame()
        if speech and not self._speaking and self._num_frames - begin >= FRAMES_PER_POSITION:
            self._speaking = True
            self._under_way = None
            start = SpeechStart(begin)
            self._next_newest = start.frame + _FIRST_NEWEST_FRAME
            if self._lips is not None:
                self._lips.reset()
            pre_roll = np.array(self._recent)[begin - self._num_frames :]
            self._recent.clear()
            return [start, *(yield from self._score(pre_roll))]
        if self._speaking and not speech:
            return (yield from self._end())
        return []

    def _first_frame(self) -> int:
        """Return the frame at which speech begins if it is found now."""
        oldest = self._num_frames - len(self._recent)
        begin = max(oldest, self._num_frames - _PRE_ROLL_FRAMES)
        begin += (_FIRST_FRAME_PARITY - begin) % FRAMES_PER_POSITION
        if self._under_way is not None:
            begin -= (begin - self._under_way) % _BLOCK_FRAMES
            begin += _BLOCK_FRAMES * (begin < oldest)
        return begin

    def _end(self) -> ScoringTask[list[ScoreEvent]]:
        self._speaking = False
        return [*(yield from self._score(None)), SpeechEnd(self._num_frames)]

    def _score(self, frames: NDArray[np.float32] | None) -> ScoringTask[list[ScoreEvent]]:
        """Return the scores of frames, shape (n, k), or of a segment's end, and the lips."""
        before = self._stream.provisional
        scores = FrameScores((yield self._stream, frames), self._stream.provisional)
        lip_frames, self._lip_frames = self._lip_frames, []
        is_new = len(scores.settled) > 0 or scores.provisional is not before
        return [*([scores] if is_new else []), *lip_frames]

    def _take_position(self, frames: NDArray[np.float32], values: NDArray[np.float32]) -> None:
        """Pass on what the network has computed at a position."""
        newest, self._next_newest = self._next_newest, self._next_newest + FRAMES_PER_POSITION
        # At the end of a segment the network sees its last frame again: no sound, no lips.
        if self._lips is not None and newest < self._num_frames:
            known_s = newest * HOP_S + WINDOW_S
            self._lip_frames += self._lips.accept(known_s, frames, values)


def score_recording(
    model: AcousticModel,
    samples: NDArray[np.float32],
    sample_rate_hz: int,
    lips: LipFrameStream | None = None,
) -> list[ScoreEvent]:
    """Score a whole recording, shape (n,) or (n, channels)."""
    num_channels = 1 if samples.ndim == 1 else samples.shape[1]
    scores = SpeechScores(model, sample_rate_hz, num_channels, lips)
    return (
        run_scoring_tasks(model, [scores.process(samples)])[0]
        + run_scoring_tasks(model, [scores.finish()])[0]
    )
