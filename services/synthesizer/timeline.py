"""From recognised units to visemes on the time axis, with the silences between them.

Source: Li et al. 2011, 2.3.1 (compound finals become several visemes), Wang & Cai 2003, section 3
(where silence models stand).

Deviations: a viseme longer than twice ``EDGE_S`` has a centre interval instead of a centre, so
that a long vowel is held instead of fading from its middle on; the exponent of eq. 5 is measured
from the nearer end of the interval. Shorter visemes have the paper's single centre. Live, the last
unit known is followed by an expected one: a final comes after every initial, and an initial after
most finals, so that the mouth sets out in time for what it will be told late.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.visemes import SHAPES, VISEME_INDEX, shapes_of
from shared.phones import FINALS, INITIALS, SILENCE, Phone

EXPECTED = -1
LONGEST_HOLD_S = 1.5  # a unit goes on for so long past its estimate if nothing follows
_GO_ON_SOFTNESS_S = 0.03
_GO_ON_FACTOR = 3.0  # below, a long vowel half closes before it is held
_HELD = frozenset(VISEME_INDEX[SHAPES[unit][-1][0]] for unit in FINALS)
_EXPECTED_AFTER_S = 0.3  # how long the expected viseme lasts before the mouth relaxes
# What usually follows looks like: a middling final; after a final, a mouth less open, which keeps
# its rounding.
_EXPECTED_AFTER_INITIAL, _EXPECTED_AFTER_FINAL, _EXPECTED_AFTER_ROUNDED = "ei", "i", "u"
_ROUNDED_LAST_SHAPES = frozenset({"o", "ou", "u", "v"})
EDGE_S = 0.08  # a viseme's centre is at most this far from its beginning and its end
_SHORTEST_UNIT_S = 0.01
# A hole this short between two units is a rounding of their times, no pause.
_TOUCHING_S = 0.03
_LONGEST_ERROR_S = 0.3  # an estimated end may be so much too early
_EXPECTED_EDGE_S = 0.02


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """Visemes in order of time, and the silences before, between and after words."""

    viseme: NDArray[np.intp]  # (num_visemes,) rows of VisemeParameters
    centre_start_s: NDArray[np.float64]  # (num_visemes,) seconds
    centre_end_s: NDArray[np.float64]  # (num_visemes,) seconds, not before centre_start_s
    unit_index: NDArray[np.int64]  # (num_visemes,) Phone.index, EXPECTED for the expected viseme
    silence_start_s: NDArray[np.float64]  # (num_silences,) end of speech; -inf before all speech
    silence_end_s: NDArray[np.float64]  # (num_silences,) start of speech; inf after all speech
    syllable_s: NDArray[np.float64]  # (num_syllables,) when each syllable's final begins
    # Estimated end of the last unit, where nothing is known of what follows; else None. Then the
    # last two visemes are that unit's last and the expected one, and the last silence follows.
    open_end_s: float | None = None

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Timeline:
        """Timeline with the chosen visemes, by mask or by rows, and all silences and syllables."""
        return replace(
            self,
            viseme=self.viseme[chosen],
            centre_start_s=self.centre_start_s[chosen],
            centre_end_s=self.centre_end_s[chosen],
            unit_index=self.unit_index[chosen],
            open_end_s=None,
        )

    def go_on(self, until_s: float) -> Timeline:
        """Let an open unit last: nothing that follows it had begun at ``until_s``.

        Its end moves from the estimate to ``until_s``, smoothly, and that of a final
        beyond, since what has lasted long is not about to end; as far as ``LONGEST_HOLD_S``.
        """
        if self.open_end_s is None:
            return self
        overdue_s = _GO_ON_SOFTNESS_S * np.logaddexp(
            0.0, (until_s - self.open_end_s) / _GO_ON_SOFTNESS_S
        )
        factor = _GO_ON_FACTOR if self.viseme[-2] in _HELD else 1.0
        later_s = min(factor * float(overdue_s), LONGEST_HOLD_S)
        start_s, end_s = self.centre_start_s.copy(), self.centre_end_s.copy()
        silence_start_s = self.silence_start_s.copy()
        start_s[-1] += later_s
        end_s[-2:] += later_s
        silence_start_s[-1] += later_s
        return replace(
            self,
            centre_start_s=start_s,
            centre_end_s=end_s,
            silence_start_s=silence_start_s,
            open_end_s=None,
        )


def build_timeline(
    phones: Sequence[Phone], speech_ends_s: Sequence[float] = (), live: bool = False
) -> Timeline:
    """Place visemes and silences.

    Parameters
    ----------
    phones : sequence of Phone
        One for each index, in any order; ``sil`` ends the speech before it.
    speech_ends_s : sequence of float
        Further times at which speech is known to have ended, seconds.
    live : bool
        More units may follow: the last one is open unless speech is known to have ended, and the
        durations of units that are not final are estimates.
    """
    in_order = sorted(phones, key=lambda phone: (phone.onset_s, phone.index))
    quiet_s = sorted(
        [*speech_ends_s, *(phone.onset_s for phone in in_order if phone.unit == SILENCE)]
    )
    spoken = [phone for phone in in_order if phone.unit != SILENCE]

    visemes: list[tuple[int, float, float, int]] = []
    silences: list[tuple[float, float]] = []
    open_end_s: float | None = None
    if spoken:
        silences.append((-np.inf, spoken[0].onset_s))
    for number, phone in enumerate(spoken):
        following = spoken[number + 1] if number + 1 < len(spoken) else None
        next_onset_s = following.onset_s if following is not None else np.inf
        if not phone.final and next_onset_s - phone.onset_s < _SHORTEST_UNIT_S:
            continue  # the recognizer changed its mind
        bound_s = next((end for end in quiet_s if phone.onset_s < end < next_onset_s), next_onset_s)
        end_s = min(phone.onset_s + max(phone.duration_s, _SHORTEST_UNIT_S), bound_s)
        estimated = live and not phone.final
        if bound_s - end_s < (_LONGEST_ERROR_S if estimated else _TOUCHING_S):
            end_s = bound_s
        if live and bound_s == np.inf:
            open_end_s = end_s
        touching = end_s == next_onset_s
        if not touching:
            silent_s = end_s if open_end_s is None else end_s + _EXPECTED_AFTER_S
            silences.append((silent_s, next_onset_s))
        end_s = max(end_s, phone.onset_s + _SHORTEST_UNIT_S)
        next_unit = following.unit if following is not None and touching else None
        visemes += _shapes_between(phone, next_unit, end_s)
    visemes.sort(key=lambda row: row[1:])
    if open_end_s is not None:
        if spoken[-1].unit in INITIALS:
            expected = _EXPECTED_AFTER_INITIAL
        elif SHAPES[spoken[-1].unit][-1][0] in _ROUNDED_LAST_SHAPES:
            expected = _EXPECTED_AFTER_ROUNDED
        else:
            expected = _EXPECTED_AFTER_FINAL
        visemes.append(
            (
                VISEME_INDEX[expected],
                open_end_s + _EXPECTED_EDGE_S,
                open_end_s + _EXPECTED_AFTER_S,
                EXPECTED,
            )
        )
    return Timeline(
        viseme=np.array([row[0] for row in visemes], dtype=np.intp),
        centre_start_s=np.array([row[1] for row in visemes], dtype=float),
        centre_end_s=np.array([row[2] for row in visemes], dtype=float),
        unit_index=np.array([row[3] for row in visemes], dtype=np.int64),
        silence_start_s=np.array([row[0] for row in silences], dtype=float),
        silence_end_s=np.array([row[1] for row in silences], dtype=float),
        syllable_s=np.array([each.onset_s for each in spoken if each.unit not in INITIALS]),
        open_end_s=open_end_s,
    )


def _shapes_between(
    phone: Phone, next_unit: str | None, end_s: float
) -> list[tuple[int, float, float, int]]:
    """Visemes of one unit that lasts until ``end_s``: row, centre interval, index of the unit."""
    rows, start_s = [], phone.onset_s
    for shape, share in shapes_of(phone.unit, next_unit):
        length_s = share * (end_s - phone.onset_s)
        edge_s = min(0.5 * length_s, EDGE_S)
        rows.append(
            (VISEME_INDEX[shape], start_s + edge_s, start_s + length_s - edge_s, phone.index)
        )
        start_s += length_s
    return rows
