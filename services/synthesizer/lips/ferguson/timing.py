"""Times the phones of a known text, from the segments of its recording.

Source: Zhang et al. 2021, section 5, eq. 5 (*reconstructed*): in a syllable that starts at T_x and
lasts T_l, phone n starts at T_n = T_x + D T_l. The influence factor D has four levels; finals of a
higher level overlap more of the preceding consonant.

The paper has one segment per syllable. Energy and zero crossings do not find exactly these, so
syllables are first assigned to segments. A segment may contain several syllables, several segments
may form one syllable, and a segment may be a breath or noise. Dynamic programming finds the
cheapest assignment. Costs depend on the syllables' typical durations, at the rate of the whole
recording, and on whether zero crossings match the first consonant of each syllable.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from kouxing.services.synthesizer.lips.ferguson.phone_table import PhoneTable
from kouxing.services.synthesizer.lips.ferguson.syllable_segmenter import (
    SLICE_S,
    EnergySegment,
    segment_speech,
)
from kouxing.shared.arrays import Doubles, Int16
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, Progress
from kouxing.shared.phones.inventory import Syllable

# Tuned on the training split for the error of syllable onsets.
_DURATION_SD = 0.5  # standard deviation of a syllable's log duration
_HISS_SD = 0.12  # standard deviation of the zero-crossing rate at a syllable onset
_MAX_HISS_COST = 8.0
_SPLIT_COST = 1.0  # per syllable boundary within a segment
_MERGE_COST = 2.0  # per segment boundary within a syllable
_PAUSE_COST_S = 0.05  # pause duration within a syllable that costs 1
_NOISE_COST = 2.0  # cost of a segment without speech
_NOISE_COST_S = 0.1  # noise duration that costs 1 more
_MAX_MERGED = 4
_ONSET_SLICES = 7  # duration of a hissing consonant
MAX_SYLLABLES = 5000
# Read and synthesized speech has ratios of 0.5 to 1.25. Outside these limits, the text is wrong.
MIN_SPEECH_RATIO = 0.4
MAX_SPEECH_RATIO = 2.0


def time_text(
    slices: Sequence[Progress], syllables: Sequence[Syllable], table: PhoneTable
) -> list[Phone]:
    """Return the phones of a text with their times; gaps between them are pauses.

    ``slices`` are the whole recording.

    Raises ``UserError`` if there is no speech, no text, or too much text.
    """
    if not syllables:
        raise UserError("the text is empty; write the spoken words")
    if len(syllables) > MAX_SYLLABLES:
        raise UserError(
            f"the text has {len(syllables)} syllables, but the maximum is {MAX_SYLLABLES}; use"
            " forced alignment (--timing align)"
        )
    phones: list[Phone] = []
    for syllable, (start_s, end_s) in zip(
        syllables, syllable_times(slices, syllables, table), strict=True
    ):
        edges_s = [*phone_onsets(syllable, start_s, end_s, table), float(end_s)]
        phones += [
            Phone(
                index=len(phones) + number,
                symbol=symbol,
                onset_s=edges_s[number],
                duration_s=edges_s[number + 1] - edges_s[number],
                confidence=1.0,
                final=True,
            )
            for number, symbol in enumerate(syllable)
        ]
    return phones


def speech_ratio(
    slices: Sequence[Progress], syllables: Sequence[Syllable], table: PhoneTable
) -> float:
    """Return the duration of the speech divided by the usual duration of the text."""
    return _speech_ratio(segment_speech(slices), _typical_durations(syllables, table).sum())


def phone_onsets(
    syllable: Syllable, start_s: float, end_s: float, table: PhoneTable
) -> list[float]:
    """Return the onsets of a syllable's phones, seconds (eq. 5).

    The influence factor places the final after its initial. A third phone (r-coloring) has its
    typical fraction of the remaining time.
    """
    onsets_s = [start_s]
    rest = list(syllable)
    if len(rest) > 1 and rest[1] in table.influence:
        start_s += table.influence[rest[1]] * (end_s - start_s)  # Zhang 2021, eq. 5
        onsets_s.append(start_s)
        rest = rest[1:]
    ends_s = np.cumsum([table.duration_s[phone] for phone in rest])
    onsets_s += [start_s + (end_s - start_s) * time_s / ends_s[-1] for time_s in ends_s[:-1]]
    return [float(onset_s) for onset_s in onsets_s]


def syllable_times(
    slices: Sequence[Progress], syllables: Sequence[Syllable], table: PhoneTable
) -> Doubles:
    """Return start and end of each syllable (num_syllables, 2), seconds.

    Raises ``UserError`` if there is no speech.
    """
    segments = segment_speech(slices)
    if not segments:
        raise UserError("no speech was found; check that the text matches the recording")
    text = _TypicalValues(
        duration_s=_typical_durations(syllables, table),
        crossings=np.array([table.crossings[phones[0]] for phones in syllables]),
    )
    times_s = np.zeros((len(syllables), 2))
    for group in _cheapest_assignment(segments, text, OnsetCrossings(slices)):
        start_s, end_s = segments[group.first_segment].start_s, segments[group.last_segment].end_s
        duration_s = text.duration_s[group.syllables]
        fraction = np.concatenate([[0.0], np.cumsum(duration_s) / duration_s.sum()])
        edges_s = start_s + (end_s - start_s) * fraction
        times_s[group.syllables] = np.stack([edges_s[:-1], edges_s[1:]], axis=1)
    return times_s


@dataclass(frozen=True, slots=True)
class _TypicalValues:
    """Typical values of each syllable."""

    duration_s: Doubles  # (num_syllables,)
    crossings: Doubles  # (num_syllables,) maximum zero-crossing rate at the onset


@dataclass(frozen=True, slots=True)
class _Assignment:
    """Segments assigned to syllables: one segment with syllables, or one syllable with segments."""

    first_segment: int
    last_segment: int
    syllables: slice


class OnsetCrossings:
    """The maximum zero-crossing rate within a consonant's duration after any time."""

    def __init__(self, slices: Sequence[Progress]) -> None:
        self._start_s = slices[0].time_s - SLICE_S
        rate = np.array([slice_.zero_crossing_rate for slice_ in slices])
        smooth = 0.5 * (rate + np.concatenate([rate[:1], rate[:-1]]))
        ahead = np.pad(smooth, (0, _ONSET_SLICES - 1), mode="edge")
        self._maximum = np.lib.stride_tricks.sliding_window_view(ahead, _ONSET_SLICES).max(axis=1)

    def at(self, times_s: Doubles) -> Doubles:
        """Return the rate, 0 to 1, of a consonant that starts at each time."""
        slices = np.rint((times_s - self._start_s) / SLICE_S).astype(np.intp)
        maximum: Doubles = self._maximum[np.clip(slices, 0, len(self._maximum) - 1)]
        return maximum


def _cheapest_assignment(
    segments: Sequence[EnergySegment], text: _TypicalValues, onset_crossings: OnsetCrossings
) -> list[_Assignment]:
    """Assign every syllable; total_cost[n, s] is for the first n segments and s syllables."""
    num_segments, num_syllables = len(segments), len(text.duration_s)
    until_s = np.concatenate([[0.0], np.cumsum(text.duration_s)])
    rate = _speech_ratio(segments, until_s[-1])
    max_split = min(num_syllables, 4 + 2 * -(-num_syllables // num_segments))
    total_cost = np.full((num_segments + 1, num_syllables + 1), np.inf)
    total_cost[0, 0] = 0.0
    best = np.zeros((num_segments + 1, num_syllables + 1, 2), dtype=np.int16)

    def consider(row: int, num_merged: int, num_grouped: int, cost: Doubles | float) -> None:
        """Consider a group of ``num_merged`` segments to ``row`` and ``num_grouped`` syllables."""
        total = total_cost[row - num_merged, : num_syllables + 1 - num_grouped] + cost
        is_better = total < total_cost[row, num_grouped:]
        total_cost[row, num_grouped:][is_better] = total[is_better]
        best[row, num_grouped:][is_better] = num_merged, num_grouped

    def hiss_cost(times_s: Doubles, place: int, num_grouped: int) -> Doubles:
        """Return the cost of the onsets at which the syllable ``place`` of each group starts."""
        typical = text.crossings[place : num_syllables + 1 - num_grouped + place]
        misfit = 0.5 * ((onset_crossings.at(times_s) - typical) / _HISS_SD) ** 2
        return np.minimum(misfit, _MAX_HISS_COST)

    for row in range(1, num_segments + 1):
        start_s = segments[row - 1].start_s
        length_s = segments[row - 1].end_s - start_s
        consider(row, 1, 0, _NOISE_COST + length_s / _NOISE_COST_S)
        for num_grouped in range(1, max_split + 1):
            typical_s = until_s[num_grouped:] - until_s[:-num_grouped]
            cost = num_grouped * _duration_cost(length_s / (rate * typical_s)) + _SPLIT_COST * (
                num_grouped - 1
            )
            for place in range(num_grouped):
                before_s = until_s[place : place + len(typical_s)] - until_s[: len(typical_s)]
                cost += hiss_cost(start_s + length_s * before_s / typical_s, place, num_grouped)
            consider(row, 1, num_grouped, cost)
        for num_merged in range(2, min(_MAX_MERGED, row) + 1):
            group = segments[row - num_merged : row]
            pause_s = sum(after.start_s - before.end_s for before, after in pairwise(group))
            group_s = group[-1].end_s - group[0].start_s
            cost = _duration_cost(group_s / (rate * text.duration_s)) + _MERGE_COST * (
                num_merged - 1
            )
            cost += hiss_cost(np.full(num_syllables, group[0].start_s), 0, 1)
            consider(row, num_merged, 1, cost + pause_s / _PAUSE_COST_S)
    return _trace_back(best)


def _speech_ratio(segments: Sequence[EnergySegment], typical_s: float) -> float:
    return sum(segment.end_s - segment.start_s for segment in segments) / typical_s


def _typical_durations(syllables: Sequence[Syllable], table: PhoneTable) -> Doubles:
    return np.array([sum(table.duration_s[phone] for phone in phones) for phones in syllables])


def _duration_cost(ratio: Doubles) -> Doubles:
    """Return the cost of a duration, given its ratio to the typical duration."""
    return 0.5 * (np.log(ratio) / _DURATION_SD) ** 2


def _trace_back(best: Int16) -> list[_Assignment]:
    row, column = best.shape[0] - 1, best.shape[1] - 1
    groups = []
    while row:
        num_merged, num_grouped = (int(value) for value in best[row, column])
        if num_grouped:
            groups.append(
                _Assignment(row - num_merged, row - 1, slice(column - num_grouped, column))
            )
        row, column = row - num_merged, column - num_grouped
    return groups[::-1]
