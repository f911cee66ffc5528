"""Holds one session's audio and results between the recognizer's calls.

    chunks -> gaps -> resampler -> 20 ms slices -> scores -> phones, lip positions, level

The chunk sizes do not affect the results. Times are whole samples at 16 kHz, so that messages carry
them without loss.
"""

from __future__ import annotations

from collections.abc import Iterable

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.front_end.features import frame_at
from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.services.recognizer.front_end.slices import SliceMeter
from kouxing.services.recognizer.lips.lip_prediction import LipPredictor, choose_delay
from kouxing.services.recognizer.live.live_decoder import LiveDecoder, StreamOutput
from kouxing.services.recognizer.live.speech_scorer import SpeechScorer
from kouxing.services.recognizer.search.output_rule import OutputRuleConfig
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ, duration_to_samples, to_samples, to_seconds
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import (
    AudioSkipped,
    EndOfSound,
    LipPositions,
    Phone,
    Progress,
    SpeechChange,
    Waveform,
)

MAX_JITTER_SAMPLES = MEDIA_RATE_HZ // 10  # a larger jump of the media time is a gap
SILENT_DB = -120.0  # the level after the last sample


class SpeechStream:
    """One session's audio and its results; created by ``Recognizer.create_stream``.

    A chunk carries the media time of its first sample. If a chunk starts more than
    ``MAX_JITTER_SAMPLES`` after the end of the previous one, there is a gap: the speech before it
    ends, and recognition starts again after it.
    """

    def __init__(
        self,
        model: AcousticModel,
        rule: OutputRuleConfig,
        *,
        sample_rate_hz: int,
        lip_predictor: LipPredictor | None,
        face_delay_s: float,
        speech_time: int,
    ) -> None:
        self.num_gaps = 0  # so far
        self._needs_light_model = False
        self._hop = 1  # hop of the block network, in blocks
        self._model = model
        self._rule = rule
        self._rate_hz = sample_rate_hz
        self._lip_predictor = lip_predictor
        self._face_delay_s = face_delay_s
        self._speech_time = speech_time
        self._first_chunk: int | None = None  # media time of the first chunk after the last gap
        self._num_in = 0  # samples since then, at the audio's own rate
        self._next_index = 0
        self._is_speaking = False
        self._results: list[StreamOutput] = []  # not yet returned
        # early results during scoring on another thread
        self._early_results: list[StreamOutput] | None = None
        self._segments = [self._new_segment(0)]  # the last one accepts audio

    @property
    def uses_light_model(self) -> bool:
        """Whether the light model finds the phones."""
        return self._segments[-1].scorer.uses_light_model

    def set_light_model(self, uses_light_model: bool) -> None:
        """Switch to the light model now, or back at the next start of speech.

        All audio so far must be decoded.
        """
        self._needs_light_model = uses_light_model
        self._segments[-1].scorer.set_light_model(uses_light_model)

    def set_hop(self, num_blocks: int) -> None:
        """Set the hop of the block network, as a number of blocks."""
        self._hop = num_blocks
        self._segments[-1].scorer.set_hop(num_blocks)

    @property
    def media_time(self) -> int:
        """Media time up to which audio was taken, without the resampler's delay, 16 kHz samples."""
        return self._segments[-1].media_time

    @property
    def next_media_time(self) -> int:
        """Media time of the next chunk if no audio is lost, samples at 16 kHz."""
        if self._first_chunk is None:
            return 0
        return self._first_chunk + self._num_in * MEDIA_RATE_HZ // self._rate_hz

    @property
    def scorers(self) -> list[SpeechScorer]:
        """The scorers that may have audio to score."""
        return [segment.scorer for segment in self._segments]

    @property
    def needs_network(self) -> bool:
        """Whether decoding the audio needs a run of the block network."""
        return any(scorer.needs_network for scorer in self.scorers)

    def accept_waveform(self, samples: Floats, media_time: int | None = None) -> None:
        """Queue finite samples, (n,) or (n, channels), in [-1, 1], for decoding.

        ``media_time`` is the time of the first sample, samples at 16 kHz. None: no gap.
        """
        if media_time is None:
            media_time = self.next_media_time
        if self._first_chunk is None:
            self._start_at(media_time)
        elif self._is_gap_before(media_time):
            self.num_gaps += 1
            self._segments[-1].input_finished()
            self._start_at(media_time)
        self._num_in += len(samples)
        self._segments[-1].accept_waveform(samples)

    def skip_to(self, media_time: int) -> None:
        """Continue at a media time, as after a gap. The skipped time has no frames."""
        self._segments[-1].input_finished()
        self._start_at(media_time)
        self._segments[-1].scorer.add_event(AudioSkipped(time_s=to_seconds(media_time)))

    def input_finished(self) -> None:
        """End the audio."""
        self._segments[-1].input_finished()
        self._segments[-1].scorer.add_event(EndOfSound(time_s=to_seconds(self.media_time)))

    def flush(self) -> None:
        """Drop the current speech (an interruption); the next chunk starts a new segment."""
        start = self.next_media_time
        self._segments = [self._new_segment(start)]
        if self._is_speaking:
            self._is_speaking = False
            self._results.append(SpeechChange(active=False, time_s=to_seconds(start)))

    def decode(self) -> None:
        """Search for phones in the scores so far."""
        for segment in self._segments:
            for result in segment.decode():
                if isinstance(result, Phone):
                    self._results.append(self._renumber(result, segment))
                    continue
                if isinstance(result, SpeechChange):
                    self._is_speaking = result.active
                self._results.append(result)
        self._segments = self._segments[-1:]

    def decode_early(self) -> None:
        """Add lip positions and levels of unscored speech to the results, before its phones."""
        if self._early_results is not None:
            self._early_results += self._segments[0].decode_early()
        elif len(self._segments) == 1:
            self.decode()
            self._results += self._segments[0].decode_early()

    def begin_background_scoring(self) -> None:
        """Hand the detected speech to another thread, until ``end_background_scoring``.

        In the meantime, ``take_results`` returns only results of ``decode_early``. The stream may
        take further audio if ``can_accept_while_scoring``, and no other calls.
        """
        if len(self._segments) == 1 and self._segments[0].scorer.begin_background_scoring():
            self._early_results = []

    def end_background_scoring(self) -> None:
        """Take the speech back from the other thread: all calls are allowed again."""
        self._segments[0].scorer.end_background_scoring()
        self._early_results = None

    def can_accept_while_scoring(self, media_time: int) -> bool:
        """Return whether the stream may take audio from this time on during scoring."""
        return self._early_results is not None and not self._is_gap_before(media_time)

    def take_results(self) -> list[StreamOutput]:
        """Return the results since the last call."""
        if self._early_results is not None:
            early, self._early_results = self._early_results, []
            return early
        results, self._results = self._results, []
        return results

    def _is_gap_before(self, media_time: int) -> bool:
        return media_time > self.next_media_time + MAX_JITTER_SAMPLES

    def _renumber(self, phone: Phone, segment: _AudioSegment) -> Phone:
        """Continue the phone indices of the previous segments."""
        if segment.first_index is None:
            segment.first_index = self._next_index
        index = segment.first_index + phone.index
        self._next_index = max(self._next_index, index + 1)
        return replace(phone, index=index)

    def _start_at(self, media_time: int) -> None:
        """Restart the first segment, or add a segment after a gap."""
        is_first, self._first_chunk, self._num_in = self._first_chunk is None, media_time, 0
        segment = self._new_segment(media_time)
        self._segments = [segment] if is_first else [*self._segments, segment]

    def _new_segment(self, media_time: int) -> _AudioSegment:
        lip_stream = start_frame = None
        if self._lip_predictor is not None:
            lip_stream = self._lip_predictor.create_stream(
                [choose_delay(self._lip_predictor.delays_s, self._face_delay_s)]
            )
        if self._speech_time and self._first_chunk is not None:
            start_frame = frame_at(to_seconds(self._speech_time - media_time))
            self._speech_time = 0
        scorer = SpeechScorer(self._model, lip_stream, start_frame)
        scorer.set_light_model(self._needs_light_model)
        scorer.set_hop(self._hop)
        return _AudioSegment(
            media_time,
            Resampler(self._rate_hz),
            scorer,
            LiveDecoder(self._model.topology, self._rule),
        )


class _AudioSegment:
    """Audio without a gap."""

    def __init__(
        self, start: int, resampler: Resampler, scorer: SpeechScorer, decoder: LiveDecoder
    ) -> None:
        self.scorer = scorer
        self.first_index: int | None = None  # index of the segment's first phone in the session
        self._start = start  # media time, samples at 16 kHz
        self._meter = SliceMeter(start)
        self._resampler = resampler
        self._decoder = decoder

    @property
    def media_time(self) -> int:
        """Media time of the end of the resampled audio, samples at 16 kHz."""
        return self._meter.media_time

    def accept_waveform(self, samples: Floats) -> None:
        """Queue samples, shape (n,) or (n, channels), at the input's rate."""
        self._queue(self._resampler.accept_waveform(samples))

    def input_finished(self) -> None:
        """End the audio."""
        self._queue(self._resampler.finish())
        self.scorer.input_finished()
        self.scorer.add_event(Progress(time_s=to_seconds(self.media_time), level_db=SILENT_DB))

    def _queue(self, samples: Floats) -> None:
        self.scorer.add_event(Waveform(time_s=to_seconds(self.media_time), samples=samples))
        for chunk, progress in self._meter.accept_waveform(samples):
            self.scorer.accept_waveform(chunk, progress)

    def decode(self) -> list[StreamOutput]:
        """Return the new results at the session's times, without lip positions before the audio."""
        return self._to_session_times(self._decoder.decode(self.scorer.get_events()))

    def decode_early(self) -> list[StreamOutput]:
        """Return the lip positions and levels of unscored speech, as ``decode`` would later."""
        return self._to_session_times(self.scorer.take_early_events())

    def _to_session_times(self, results: Iterable[StreamOutput]) -> list[StreamOutput]:
        return [
            self._to_session_time(result)
            for result in results
            if not (isinstance(result, LipPositions) and result.time_s < 0.0)
        ]

    def _to_session_time(self, result: StreamOutput) -> StreamOutput:
        """Count the time from the session's first sample, in whole samples."""
        match result:
            case LipPositions():
                delay_s = to_seconds(duration_to_samples(result.delay_s))
                return replace(result, time_s=self._media_s(result.time_s), delay_s=delay_s)
            case SpeechChange():
                return replace(result, time_s=self._media_s(result.time_s))
            case Phone():
                return replace(
                    result,
                    onset_s=self._media_s(result.onset_s),
                    duration_s=to_seconds(to_samples(result.duration_s)),
                )
        return result

    def _media_s(self, time_s: float) -> float:
        return to_seconds(self._start + to_samples(time_s))
