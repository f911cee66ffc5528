"""Phone durations by position between two pauses, measured on forced alignments.

A live recognizer emits a phone before the phone has ended, with its mean duration in the corpus
(Li et al. 2011). The last vowel before a pause is much longer than the same vowel inside a phrase
(Klatt 1976, "Linguistic uses of segmental duration in English", found it for English; it holds in
Mandarin too), so the statistics are kept per position.

Some phones are rare in a position, such as an initial before a pause. Their statistics are shrunk
toward the phone's mean over all positions:

    mean[p, u] = (sum[p, u] + n0 * mean[u]) / (count[p, u] + n0)

and likewise the second moment. Isolated words and syllables are longer, so they get a low weight.
They matter only for phones that no connected speech contains.
"""

from collections.abc import Sequence

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AFTER_PAUSE,
    BEFORE_PAUSE,
    NUM_PHRASE_POSITIONS,
    WITHIN_PHRASE,
)
from kouxing.services.recognizer.front_end.features import HOP_S
from kouxing.services.recognizer.search.decoder import PathSegment
from kouxing.shared.arrays import Floats
from kouxing.shared.phones.inventory import PhoneInventory

_PRIOR_COUNT = 10.0  # n0
_MIN_CONNECTED_PHONES = 8  # in connected speech
_WORD_WEIGHT = 0.02
_UNSEEN_MEAN_FRAMES, _UNSEEN_SPREAD_FRAMES = 10.0, 5.0  # for a phone without data


def positions_of(phones: Sequence[int], silence: int) -> list[int]:
    """Return each phone's place between two pauses, such as ``AFTER_PAUSE``.

    For a pause (``silence``), the position refers to the whole recording.
    """
    positions = []
    for number, phone in enumerate(phones):
        before = phones[number - 1] if number else None
        after = phones[number + 1] if number + 1 < len(phones) else None
        edges = (None,) if phone == silence else (None, silence)
        positions.append(
            BEFORE_PAUSE if after in edges else AFTER_PAUSE if before in edges else WITHIN_PHRASE
        )
    return positions


class PhoneDurations:
    """Collects weighted durations of aligned phones."""

    def __init__(self, inventory: PhoneInventory) -> None:
        self._silence = inventory.index[inventory.silence]
        # weighted sums of 1, frames and frames^2
        self._sums = np.zeros((3, NUM_PHRASE_POSITIONS, len(inventory)))

    def add(self, aligned: Sequence[PathSegment], weight: float) -> None:
        """Add the phones of one recording in order, including pauses."""
        phones = [segment.phone for segment in aligned]
        if sum(phone != self._silence for phone in phones) < _MIN_CONNECTED_PHONES:
            weight *= _WORD_WEIGHT
        positions = positions_of(phones, self._silence)
        for position, segment in zip(positions, aligned, strict=True):
            frames = segment.end - segment.start
            self._sums[:, position, segment.phone] += (weight, weight * frames, weight * frames**2)

    def mean_and_spread_s(self) -> tuple[Floats, Floats]:
        """Compute mean and standard deviation of the durations, (3, num_phones) each, seconds."""
        second_moment = _UNSEEN_MEAN_FRAMES**2 + _UNSEEN_SPREAD_FRAMES**2
        unseen = np.array((1.0, _UNSEEN_MEAN_FRAMES, second_moment))
        by_phone = self._sums.sum(axis=1) + 1e-6 * unseen[:, None]
        prior = _PRIOR_COUNT * by_phone / by_phone[0]
        count, total, squares = self._sums + prior[:, None, :]
        mean = total / count
        spread = np.sqrt(np.maximum(squares / count - mean**2, 0.0))
        return (HOP_S * mean).astype(np.float32), (HOP_S * spread).astype(np.float32)
