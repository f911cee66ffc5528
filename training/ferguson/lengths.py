"""Usual durations, zero crossings and influence of the phones, from aligned speech.

Source of the influence factors: Zhang et al. 2021, table 2, gives vowels four levels. Their values
are learned here from each final's mean fraction of the syllable that is the initial. Finals are
grouped into levels such that the fractions deviate least from their level's mean.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, islice, pairwise

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.ferguson.table import PhoneTable
from kouxing.services.synthesizer.lips.ferguson.timing import Hiss
from kouxing.shared.phones.events import Phone, Progress
from kouxing.shared.phones.inventory import PhoneInventory, Syllable

Array = NDArray[np.float64]

NUM_LEVELS = 4
_RIDGE = 5.0  # weight of the mean of all phones of a kind, phones


@dataclass(frozen=True, slots=True)
class AlignedSpeech:
    """A recording with its syllables and the times of their phones."""

    slices: Sequence[Progress]
    syllables: Sequence[Syllable]
    phones: Sequence[Phone]  # without silence


def phone_table(
    opening: dict[str, float], speech: Iterable[AlignedSpeech], inventory: PhoneInventory
) -> PhoneTable:
    """Add durations, zero crossings and influence to the openings of the phones."""
    durations: dict[str, list[float]] = defaultdict(list)
    crossings: dict[str, list[float]] = defaultdict(list)
    shares: dict[str, list[float]] = defaultdict(list)
    for recording in speech:
        hiss = Hiss(recording.slices)
        remaining = iter(recording.phones)
        for syllable in recording.syllables:
            phones = list(islice(remaining, len(syllable)))
            for phone in phones:
                durations[phone.symbol].append(phone.duration_s)
            crossings[syllable[0]].append(float(hiss.at(np.array([phones[0].onset_s]))[0]))
            if len(syllable) > 1 and syllable[0] in inventory.initials:
                length_s = phones[0].duration_s + phones[1].duration_s
                shares[syllable[1]].append(phones[0].duration_s / length_s)
    kind = dict(zip(inventory.phones, inventory.kinds, strict=True))
    share = _means(shares, sorted(inventory.vowels), lambda _: "vowel")
    counts = {phone: len(shares[phone]) + _RIDGE for phone in share}
    level, influence = influence_levels(share, counts)
    return PhoneTable(
        opening=opening,
        duration_s=_means(durations, inventory.phones, kind.__getitem__),
        crossings=_means(crossings, inventory.phones, kind.__getitem__),
        level=level,
        influence=influence,
    )


def influence_levels(
    share: Mapping[str, float], weight: Mapping[str, float]
) -> tuple[dict[str, int], dict[str, float]]:
    """Group finals by their initials' share; return level and factor of each.

    ``share`` is the mean fraction of the syllable that is the initial, for at least ``NUM_LEVELS``
    finals.
    """
    finals = sorted(share, key=lambda final: (-share[final], final))
    values = np.array([share[final] for final in finals])
    weights = np.array([weight[final] for final in finals])

    def groups(cuts: tuple[int, ...]) -> list[slice]:
        return [slice(start, end) for start, end in pairwise((0, *cuts, len(finals)))]

    def factor(group: slice) -> float:
        return float(np.average(values[group], weights=weights[group]))

    def misfit(cuts: tuple[int, ...]) -> float:
        return sum(
            float(weights[group] @ (values[group] - factor(group)) ** 2) for group in groups(cuts)
        )

    best = groups(min(combinations(range(1, len(finals)), NUM_LEVELS - 1), key=misfit))
    level = {final: row for row, group in enumerate(best, start=1) for final in finals[group]}
    factors = [factor(group) for group in best]
    return level, {final: factors[level[final] - 1] for final in finals}


def _means(
    by_phone: Mapping[str, list[float]], phones: Sequence[str], kind: Callable[[str], str]
) -> dict[str, float]:
    """Compute the mean of each phone; rare phones are shrunk toward the mean of their kind."""
    of_kind: dict[str, list[float]] = defaultdict(list)
    for phone in phones:
        of_kind[kind(phone)] += by_phone.get(phone, [])
    everything = [value for values in of_kind.values() for value in values]
    means = {}
    for phone in phones:
        values = by_phone.get(phone, [])
        usual = np.mean(of_kind[kind(phone)] or everything)
        means[phone] = float((sum(values) + _RIDGE * usual) / (len(values) + _RIDGE))
    return means
