"""Alignment of recognized phones with a reference, and the hypotheses that are counted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from operator import ne

import numpy as np

from kouxing.services.recognizer.live.live_decoder import StreamOutput
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.universal.segments import features


@dataclass(slots=True, kw_only=True)
class ErrorCounts:
    """Errors of recognized phones against the reference."""

    insertions: int = 0
    deletions: int = 0
    substitutions: int = 0
    reference: int = 0

    @property
    def total(self) -> int:
        """Number of errors."""
        return self.insertions + self.deletions + self.substitutions

    @property
    def rate(self) -> float:
        """Errors per reference phone."""
        return self.total / max(1, self.reference)

    def __add__(self, other: ErrorCounts) -> ErrorCounts:
        return ErrorCounts(
            insertions=self.insertions + other.insertions,
            deletions=self.deletions + other.deletions,
            substitutions=self.substitutions + other.substitutions,
            reference=self.reference + other.reference,
        )


def align_symbols(
    reference: Sequence[str], recognized: Sequence[str]
) -> list[tuple[int | None, int | None]]:
    """Align two strings with the fewest errors (Levenshtein 1966).

    Of several best alignments, this one prefers substitutions from the end. rapidfuzz prefers
    deletions, which would change published figures. Returns pairs of indices. The first index is
    None for an insertion, the second for a deletion.
    """
    rows, columns = len(reference) + 1, len(recognized) + 1
    cost = np.zeros((rows, columns), dtype=np.int64)
    cost[:, 0] = np.arange(rows)
    cost[0] = np.arange(columns)
    for i in range(1, rows):
        for j in range(1, columns):
            change = reference[i - 1] != recognized[j - 1]
            cost[i, j] = min(cost[i - 1, j - 1] + change, cost[i - 1, j] + 1, cost[i, j - 1] + 1)
    pairs: list[tuple[int | None, int | None]] = []
    i, j = rows - 1, columns - 1
    while i or j:
        change = bool(i and j and reference[i - 1] != recognized[j - 1])
        if i and j and cost[i, j] == cost[i - 1, j - 1] + change:
            i, j = i - 1, j - 1
            pairs.append((i, j))
        elif i and cost[i, j] == cost[i - 1, j] + 1:
            i -= 1
            pairs.append((i, None))
        else:
            j -= 1
            pairs.append((None, j))
    return pairs[::-1]


def count_errors(reference: Sequence[str], recognized: Sequence[str]) -> ErrorCounts:
    """Count the fewest insertions, deletions and substitutions between two strings."""
    counts = ErrorCounts(reference=len(reference))
    for i, j in align_symbols(reference, recognized):
        if i is None:
            counts.insertions += 1
        elif j is None:
            counts.deletions += 1
        elif reference[i] != recognized[j]:
            counts.substitutions += 1
    return counts


def feature_errors(reference: Sequence[str], recognized: Sequence[str]) -> float:
    """Return the feature edit distance between universal phones.

    A substitution costs the fraction of panphon's features that differ; an insertion or a deletion
    costs 1. Divided by the number of reference phones, it is the phonetic feature error rate.
    Source: Mortensen et al. 2016, "PanPhon: a resource for mapping IPA segments to articulatory
    feature vectors" (Hamming distance).

    >>> round(24 * feature_errors(["b", "a"], ["p", "a"]))
    1
    """
    known = features()
    costs = [
        [sum(map(ne, known[expected], known[found])) / len(known[found]) for found in recognized]
        for expected in reference
    ]
    row = np.arange(len(recognized) + 1.0)
    for i in range(len(reference)):
        before, row = row, row + 1
        for j in range(len(recognized)):
            row[j + 1] = min(before[j] + costs[i][j], before[j + 1] + 1, row[j] + 1)
    return float(row[-1])


def is_emitted(phone: Phone, after: StreamOutput | None) -> bool:
    """Whether the output rule emitted a phone; otherwise it is a correction or a passed-over phone.

    The rule emits a phone after the revisions of all phones before it, so the next event decides.
    """
    return not phone.final and not (isinstance(after, Phone) and after.index > phone.index)


def first_hypothesis(events: Sequence[StreamOutput], known: set[int]) -> list[Phone]:
    """Return each phone as first emitted, by the rule or along with the next one.

    ``known`` are indices of the phones emitted before; the indices of ``events`` are added.
    """
    first = []
    for event, after in zip_longest(events, events[1:]):
        if isinstance(event, Phone):
            if event.index not in known or is_emitted(event, after):
                first.append(event)
            known.add(event.index)
    return first


def final_hypothesis(events: Iterable[StreamOutput]) -> list[Phone]:
    """Return the final phones in the output of a live recognizer."""
    return [event for event in events if isinstance(event, Phone) and event.final]
