"""One session's audio to sound events, without sockets: the recognizer as a session sees it.

    chunks -> gaps -> resampler -> 20 ms slices -> recognizer -> events, level

What is emitted does not depend on how the audio was cut into chunks. Times are whole samples at
16 kHz, so that messages carry them without loss.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    ScoringTask,
    run_scoring_tasks,
)
from kouxing.services.recognizer.front_end.pcm import SLICE, progress_at, slices
from kouxing.services.recognizer.front_end.pitch import Pitch
from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.services.recognizer.lip_source import LipsFromSound, delay_for
from kouxing.services.recognizer.recognizer import DEFAULT_RULE, Emission, Recognizer
from kouxing.services.recognizer.speech_scores import frame_at
from kouxing.shared.clock import MEDIA_RATE_HZ, duration_to_samples, to_samples, to_seconds
from kouxing.shared.phones.events import (
    EndOfSound,
    LipFrame,
    Phone,
    Progress,
    SoundEvent,
    SpeechChange,
)

MAX_JITTER = MEDIA_RATE_HZ // 10  # media time that jumps further ahead leaves a gap; samples
SILENT_DB = -120.0  # the level after the last sample

Chunk: TypeAlias = tuple[int, NDArray[np.float32]]  # media time; samples, (n, channels)


@dataclass(frozen=True, slots=True, kw_only=True)
class Waveform:
    """A stretch of the session's sound as the recognizer processes it."""

    time_s: float  # of the first sample
    samples: NDArray[np.float32]  # (n,) 16 kHz mono


StreamOutput: TypeAlias = SoundEvent | Waveform


class SpeechStream:
    """One session's audio in, sound events and the 16 kHz sound out.

    Chunks carry the media time of their first sample. One that comes later than the last one
    ended, by more than ``MAX_JITTER``, leaves a gap: the speech before it ends, and recognition
    starts again behind it.

    Parameters
    ----------
    model
        The acoustic model, shared by any number of streams.
    sample_rate_hz
        Rate of the audio, 8000 to 48000.
    num_channels
        Channels of the audio; they are averaged.
    num_stable_frames, min_confidence
        The output rule, as in ``Recognizer``.
    lips
        The model of lips, shared by any number of streams; None: no lip frames are emitted. It
        needs a model whose streams are ``PositionStream``s.
    face_delay_s
        How much later than its sound a frame of the face is made: the lip frames have the longest
        delay that is in time for it.
    speech_time
        Media time, samples at 16 kHz, at which speech that another recognizer has begun began: the
        networks' blocks lie as there. 0: there is none, or nobody knows.

    Attributes
    ----------
    num_gaps : int
        Gaps met so far.

    Raises
    ------
    UserError
        If the rate or the channels are out of range.
    """

    def __init__(
        self,
        model: AcousticModel,
        *,
        sample_rate_hz: int = MEDIA_RATE_HZ,
        num_channels: int = 1,
        num_stable_frames: int = DEFAULT_RULE[0],
        min_confidence: float = DEFAULT_RULE[1],
        lips: LipsFromSound | None = None,
        face_delay_s: float = 0.0,
        speech_time: int = 0,
    ) -> None:
        self.num_gaps = 0
        self._speech_time = speech_time
        self._model = model
        self._rate_hz = sample_rate_hz
        self._num_channels = num_channels
        self._rule = (num_stable_frames, min_confidence)
        self._lips = lips
        self._face_delay_s = face_delay_s
        self._first_chunk: int | None = None  # media time of the first chunk after the last gap
        self._num_in = 0  # samples since then, at the audio's own rate
        self._next_index = 0
        self._speaking = False
        self._segment = self._new_segment(0)

    @property
    def media_time(self) -> int:
        """Media time up to which the audio has been processed, samples at 16 kHz."""
        return self._segment.media_time

    @property
    def next_media_time(self) -> int:
        """Media time of the next chunk if nothing is lost, samples at 16 kHz."""
        if self._first_chunk is None:
            return 0
        return self._first_chunk + self._num_in * MEDIA_RATE_HZ // self._rate_hz

    def process(self, chunks: Sequence[Chunk]) -> ScoringTask[list[StreamOutput]]:
        """Take chunks in order, for ``run_scoring_tasks`` beside other sessions."""
        outputs: list[StreamOutput] = []
        for media_time, samples in chunks:
            if self._first_chunk is None:
                self._start_at(media_time)
            elif media_time > self.next_media_time + MAX_JITTER:
                self.num_gaps += 1
                outputs += yield from self._end_segment()
                self._start_at(media_time)
            self._num_in += len(samples)
            outputs += self._numbered((yield from self._segment.process(samples)))
        return outputs

    def finish(self) -> ScoringTask[list[StreamOutput]]:
        """End the audio, for ``run_scoring_tasks`` beside other sessions."""
        outputs = yield from self._end_segment()
        return [*outputs, EndOfSound(time_s=to_seconds(self.media_time))]

    def accept_waveform(self, samples: NDArray[np.float32]) -> list[StreamOutput]:
        """Take the next samples, shape (n,) or (n, channels), without a gap.

        Returns
        -------
        list
            What became known, in order.

        Raises
        ------
        UserError
            If the samples have another shape or are no numbers.
        """
        task = self.process([(self.next_media_time, samples)])
        return run_scoring_tasks(self._model, [task])[0]

    def input_finished(self) -> list[StreamOutput]:
        """Return all that is still owed; no more sound will come."""
        return run_scoring_tasks(self._model, [self.finish()])[0]

    def flush(self) -> list[SoundEvent]:
        """Drop the speech under way (an interruption); the next chunk starts again."""
        start = self.next_media_time
        self._segment = self._new_segment(start)
        if not self._speaking:
            return []
        self._speaking = False
        return [SpeechChange(active=False, time_s=to_seconds(start))]

    def _start_at(self, media_time: int) -> None:
        self._first_chunk, self._num_in = media_time, 0
        self._segment = self._new_segment(media_time)

    def _new_segment(self, media_time: int) -> _Segment:
        num_stable_frames, min_confidence = self._rule
        lips = None
        if self._lips is not None:
            lips = self._lips.stream([delay_for(self._lips.delays_s, self._face_delay_s)])
        under_way = None
        if self._speech_time and self._first_chunk is not None:
            under_way = frame_at(to_seconds(self._speech_time - media_time))
            self._speech_time = 0
        recognizer = Recognizer(
            self._model,
            sample_rate_hz=MEDIA_RATE_HZ,
            num_stable_frames=num_stable_frames,
            min_confidence=min_confidence,
            lips=lips,
            under_way=under_way,
        )
        self._index_base = self._next_index
        return _Segment(media_time, Resampler(self._rate_hz, self._num_channels), recognizer)

    def _end_segment(self) -> ScoringTask[list[StreamOutput]]:
        return self._numbered((yield from self._segment.finish()))

    def _numbered(self, outputs: list[StreamOutput]) -> list[StreamOutput]:
        """Let the indices of a segment's phones continue those before it."""
        numbered: list[StreamOutput] = []
        for output in outputs:
            if isinstance(output, Phone):
                index = self._index_base + output.index
                self._next_index = max(self._next_index, index + 1)
                numbered.append(replace(output, index=index))
            else:
                numbered.append(output)
            if isinstance(output, SpeechChange):
                self._speaking = output.active
        return numbered


class _Segment:
    """Sound without a gap."""

    def __init__(self, start: int, resampler: Resampler, recognizer: Recognizer) -> None:
        self._start = start  # media time, samples at 16 kHz
        self._num_samples = 0  # processed since then
        self._slice: list[NDArray[np.float32]] = []  # pieces of the 20 ms under way
        self._pitch = Pitch(start // SLICE)
        self._resampler = resampler
        self._recognizer = recognizer

    @property
    def media_time(self) -> int:
        """Media time up to which the sound has been processed, samples at 16 kHz."""
        return self._start + self._num_samples

    def process(self, samples: NDArray[np.float32]) -> ScoringTask[list[StreamOutput]]:
        """Take samples, shape (n,) or (n, channels), at the input's rate."""
        return (yield from self._process_mono(self._resampler.accept_waveform(samples)))

    def finish(self) -> ScoringTask[list[StreamOutput]]:
        """End the sound."""
        outputs = yield from self._process_mono(self._resampler.finish())
        outputs += self._placed((yield from self._recognizer.finish()))
        return [*outputs, Progress(time_s=to_seconds(self.media_time), level_db=SILENT_DB)]

    def _process_mono(self, samples: NDArray[np.float32]) -> ScoringTask[list[StreamOutput]]:
        outputs: list[StreamOutput] = [
            Waveform(time_s=to_seconds(self.media_time), samples=samples)
        ]
        for piece in slices(samples, self._num_samples):
            self._num_samples += len(piece)
            self._slice.append(piece)
            outputs += self._placed((yield from self._recognizer.process(piece)))
            if self._num_samples % SLICE == 0:
                outputs.append(
                    progress_at(self.media_time, np.concatenate(self._slice), self._pitch)
                )
                self._slice.clear()
        return outputs

    def _placed(self, results: Sequence[Emission]) -> list[Emission]:
        """Count results' times from the session's first sample, in whole samples.

        Lips before the sound are dropped.
        """
        return [
            self._place(result)
            for result in results
            if not (isinstance(result, LipFrame) and result.time_s < 0.0)
        ]

    def _place(self, result: Emission) -> Emission:
        if isinstance(result, LipFrame):
            return replace(
                result,
                time_s=self._media_s(result.time_s),
                delay_s=to_seconds(duration_to_samples(result.delay_s)),
            )
        if isinstance(result, SpeechChange):
            return replace(result, time_s=self._media_s(result.time_s))
        return replace(
            result,
            onset_s=self._media_s(result.onset_s),
            duration_s=to_seconds(to_samples(result.duration_s)),
        )

    def _media_s(self, time_s: float) -> float:
        return to_seconds(self._start + to_samples(time_s))
