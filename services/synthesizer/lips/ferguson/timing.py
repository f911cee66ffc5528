"""When each phone of a known text is spoken, from the pieces of its sound.

Source: Zhang et al. 2021, section 5, eq. 5 (*reconstructed*): in a syllable that begins at T_x and
lasts T_l, phone n begins at T_n = T_x + D T_l. D, the influence factor, has four levels; finals of
a higher level take in more of the consonant before them.

The paper has one piece for each syllable. Energy and zero crossings do not find exactly those, so
syllables are assigned to pieces first: a piece may hold several syllables, several pieces may make
one, and a piece may be none, a breath or a noise. Dynamic programming finds the assignment that
costs least: by the syllables' usual lengths, at the rate of the whole recording, and by whether it
hisses where a syllable begins with s, and does not where one begins with m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.ferguson.endpoints import SLICE_S, Piece, pieces_of
from kouxing.services.synthesizer.lips.ferguson.table import PhoneTable
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, Progress
from kouxing.shared.phones.inventory import Syllable

Array = NDArray[np.float64]

# Chosen on recordings of the training split, by the error of the syllables' onsets.
_LENGTH_SPREAD = 0.5  # standard deviation of a syllable's length, in natural logarithms
_HISS_SPREAD = 0.12  # standard deviation of the zero-crossing rate where a syllable begins
_MAX_COST_OF_HISS = 8.0
_COST_OF_SPLIT = 1.0  # of each boundary that no piece shows
_COST_OF_MERGE = 2.0  # of each boundary within a syllable
_COST_OF_PAUSE_S = 0.05  # a pause within a syllable costs 1 for each of these
_COST_OF_NOISE = 2.0  # of a piece that is no speech, and 1 for each of these
_COST_OF_NOISE_S = 0.1
_MAX_MERGED = 4
_ONSET_SLICES = 7  # in which a consonant hisses
MAX_SYLLABLES = 5000


def time_text(
    slices: Sequence[Progress], syllables: Sequence[Syllable], table: PhoneTable
) -> list[Phone]:
    """Find when each phone of a text is spoken.

    Parameters
    ----------
    slices
        The sound, from its beginning to its end.
    syllables
        Of the text, in order.
    table
        Usual lengths and zero crossings of the phones, and influence factors.

    Returns
    -------
    list of Phone
        All phones in order; holes between them are pauses.

    Raises
    ------
    UserError
        If there is no speech, no text, or too much text.
    """
    if not syllables:
        raise UserError("the text is empty; give the words that are spoken")
    if len(syllables) > MAX_SYLLABLES:
        raise UserError(
            f"the text has {len(syllables)} syllables; give at most {MAX_SYLLABLES} at once"
        )
    phones: list[Phone] = []
    for syllable, (start_s, end_s) in zip(
        syllables, syllable_times(slices, syllables, table), strict=True
    ):
        edges_s = [*phone_onsets(syllable, start_s, end_s, table), float(end_s)]
        phones += [
            Phone(
                index=len(phones) + place,
                symbol=symbol,
                onset_s=edges_s[place],
                duration_s=edges_s[place + 1] - edges_s[place],
                confidence=1.0,
                final=True,
            )
            for place, symbol in enumerate(syllable)
        ]
    return phones


def phone_onsets(
    syllable: Syllable, start_s: float, end_s: float, table: PhoneTable
) -> list[float]:
    """Return when the phones of a syllable begin, seconds (eq. 5).

    An initial is followed by its final by the final's influence factor; a further phone (r-colour)
    takes its usual share of the rest.
    """
    onsets_s = [start_s]
    rest = list(syllable)
    if len(rest) > 1 and rest[1] in table.influence:
        start_s += table.influence[rest[1]] * (end_s - start_s)  # Zhang 2021, eq. 5
        onsets_s.append(start_s)
        rest = rest[1:]
    lengths_s = np.cumsum([table.duration_s[phone] for phone in rest])
    onsets_s += [start_s + (end_s - start_s) * one / lengths_s[-1] for one in lengths_s[:-1]]
    return [float(onset_s) for onset_s in onsets_s]


def syllable_times(
    slices: Sequence[Progress], syllables: Sequence[Syllable], table: PhoneTable
) -> Array:
    """Assign syllables to pieces of the sound.

    Returns
    -------
    array (num_syllables, 2)
        Start and end of each syllable, seconds.

    Raises
    ------
    UserError
        If there is no speech.
    """
    pieces = pieces_of(slices)
    if not pieces:
        raise UserError("no speech was found; check that text and recording belong together")
    text = _Text(
        usual_s=np.array([sum(table.duration_s[phone] for phone in one) for one in syllables]),
        crossings=np.array([table.crossings[one[0]] for one in syllables]),
    )
    times_s = np.zeros((len(syllables), 2))
    for group in _cheapest_assignment(pieces, text, Hiss(slices)):
        start_s, end_s = pieces[group.first_piece].start_s, pieces[group.last_piece].end_s
        usual_s = text.usual_s[group.syllables]
        share = np.concatenate([[0.0], np.cumsum(usual_s) / usual_s.sum()])
        edges_s = start_s + (end_s - start_s) * share
        times_s[group.syllables] = np.stack([edges_s[:-1], edges_s[1:]], axis=1)
    return times_s


@dataclass(frozen=True, slots=True)
class _Text:
    """What is usual of each syllable."""

    usual_s: Array  # (num_syllables,) length
    crossings: Array  # (num_syllables,) greatest zero-crossing rate where it begins


@dataclass(frozen=True, slots=True)
class _Group:
    """Syllables and pieces that belong together; one piece or one syllable."""

    first_piece: int
    last_piece: int
    syllables: slice


class Hiss:
    """The greatest zero-crossing rate within a consonant's length of any time.

    Parameters
    ----------
    slices
        The sound; at least one.
    """

    def __init__(self, slices: Sequence[Progress]) -> None:
        self._start_s = slices[0].time_s - SLICE_S
        rate = np.array([one.zero_crossing_rate for one in slices])
        smooth = 0.5 * (rate + np.concatenate([rate[:1], rate[:-1]]))
        ahead = np.pad(smooth, (0, _ONSET_SLICES - 1), mode="edge")
        self._greatest = np.lib.stride_tricks.sliding_window_view(ahead, _ONSET_SLICES).max(axis=1)

    def at(self, times_s: Array) -> Array:
        """Return the rate of a consonant that begins at each of some times, 0 to 1."""
        slices = np.rint((times_s - self._start_s) / SLICE_S).astype(np.intp)
        greatest: Array = self._greatest[np.clip(slices, 0, len(self._greatest) - 1)]
        return greatest


def _cheapest_assignment(pieces: Sequence[Piece], text: _Text, hiss: Hiss) -> list[_Group]:
    """Assign every syllable; cost[p, s] is that of the first p pieces and s syllables."""
    num_pieces, num_syllables = len(pieces), len(text.usual_s)
    until_s = np.concatenate([[0.0], np.cumsum(text.usual_s)])
    rate = sum(piece.end_s - piece.start_s for piece in pieces) / until_s[-1]
    max_split = min(num_syllables, 4 + 2 * -(-num_syllables // num_pieces))
    cost = np.full((num_pieces + 1, num_syllables + 1), np.inf)
    cost[0, 0] = 0.0
    taken = np.zeros((num_pieces + 1, num_syllables + 1, 2), dtype=np.int16)

    def offer(row: int, merged: int, num: int, price: Array | float) -> None:
        """Offer to end any ``num`` syllables with piece ``row``, begun ``merged`` before."""
        total = cost[row - merged, : num_syllables + 1 - num] + price
        is_better = total < cost[row, num:]
        cost[row, num:][is_better] = total[is_better]
        taken[row, num:][is_better] = merged, num

    def hiss_price(times_s: Array, first: int, num: int) -> Array:
        """Price that syllable ``first`` of any ``num`` begins at each of some times."""
        usual = text.crossings[first : num_syllables + 1 - num + first]
        misfit = 0.5 * ((hiss.at(times_s) - usual) / _HISS_SPREAD) ** 2
        return np.minimum(misfit, _MAX_COST_OF_HISS)

    for row in range(1, num_pieces + 1):
        start_s, length_s = pieces[row - 1].start_s, pieces[row - 1].end_s - pieces[row - 1].start_s
        offer(row, 1, 0, _COST_OF_NOISE + length_s / _COST_OF_NOISE_S)
        for num in range(1, max_split + 1):
            usual_s = until_s[num:] - until_s[:-num]
            price = num * _misfit(length_s / (rate * usual_s)) + _COST_OF_SPLIT * (num - 1)
            for first in range(num):
                before_s = until_s[first : first + len(usual_s)] - until_s[: len(usual_s)]
                price += hiss_price(start_s + length_s * before_s / usual_s, first, num)
            offer(row, 1, num, price)
        for merged in range(2, min(_MAX_MERGED, row) + 1):
            group = pieces[row - merged : row]
            pause_s = sum(after.start_s - one.end_s for one, after in pairwise(group))
            lasting_s = group[-1].end_s - group[0].start_s
            price = _misfit(lasting_s / (rate * text.usual_s)) + _COST_OF_MERGE * (merged - 1)
            price += hiss_price(np.full(num_syllables, group[0].start_s), 0, 1)
            offer(row, merged, 1, price + pause_s / _COST_OF_PAUSE_S)
    return _trace_back(taken)


def _misfit(ratio: Array) -> Array:
    """Cost of a length, relative to the usual one."""
    misfit: Array = 0.5 * (np.log(ratio) / _LENGTH_SPREAD) ** 2
    return misfit


def _trace_back(taken: NDArray[np.int16]) -> list[_Group]:
    row, column = taken.shape[0] - 1, taken.shape[1] - 1
    groups = []
    while row:
        merged, num = (int(one) for one in taken[row, column])
        if num:
            groups.append(_Group(row - merged, row - 1, slice(column - num, column)))
        row, column = row - merged, column - num
    return groups[::-1]
