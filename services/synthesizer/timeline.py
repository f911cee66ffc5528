"""From recognised units to visemes on the time axis, with the silences between them.

Source: Li et al. 2011, 2.3.1 (compound finals become several visemes), Wang & Cai 2003, section 3
(where silence models stand).

Deviation: a viseme longer than twice ``EDGE_S`` has a centre interval instead of a centre, so
that a long vowel is held instead of fading from its middle on; the exponent of eq. 5 is measured
from the nearer end of the interval. Shorter visemes have the paper's single centre.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from services.synthesizer.visemes import VISEME_INDEX, shapes_of
from shared.phones import INITIALS, SILENCE, Phone

EDGE_S = 0.08  # a viseme's centre is at most this far from its beginning and its end
_SHORTEST_UNIT_S = 0.01
# A hole this short between two units is a rounding of their times, no pause.
_TOUCHING_S = 0.03
_EXPECTED_FINAL = "ei"


@dataclass(frozen=True, slots=True, kw_only=True)
class Timeline:
    """Visemes in order of time, and the silences before, between and after words."""

    viseme: NDArray[np.intp]  # (num_visemes,) rows of VisemeParameters
    centre_start_s: NDArray[np.float64]  # (num_visemes,) seconds
    centre_end_s: NDArray[np.float64]  # (num_visemes,) seconds, not before centre_start_s
    unit_index: NDArray[np.int64]  # (num_visemes,) Phone.index
    silence_start_s: NDArray[np.float64]  # (num_silences,) end of speech; -inf before all speech
    silence_end_s: NDArray[np.float64]  # (num_silences,) start of speech; inf after all speech

    def select(self, chosen: NDArray[np.bool_] | NDArray[np.intp]) -> Timeline:
        """Timeline with the chosen visemes, by mask or by rows, and all silences."""
        return replace(
            self,
            viseme=self.viseme[chosen],
            centre_start_s=self.centre_start_s[chosen],
            centre_end_s=self.centre_end_s[chosen],
            unit_index=self.unit_index[chosen],
        )


def build_timeline(
    phones: Sequence[Phone], speech_ends_s: Sequence[float] = (), hold_s: float = 0.0
) -> Timeline:
    """Place visemes and silences.

    Parameters
    ----------
    phones : sequence of Phone
        One for each index, in any order; ``sil`` ends the speech before it.
    speech_ends_s : sequence of float
        Further times at which speech is known to have ended, seconds.
    hold_s : float
        How long a unit goes on past its duration when nothing says what follows: live, a duration
        may be an estimate and the next unit not known yet. Seconds.
    """
    in_order = sorted(phones, key=lambda phone: (phone.onset_s, phone.index))
    quiet_s = sorted(
        [*speech_ends_s, *(phone.onset_s for phone in in_order if phone.unit == SILENCE)]
    )
    spoken = [phone for phone in in_order if phone.unit != SILENCE]

    visemes: list[tuple[int, float, float, int]] = []
    silences: list[tuple[float, float]] = []
    if spoken:
        silences.append((-np.inf, spoken[0].onset_s))
    for number, phone in enumerate(spoken):
        following = spoken[number + 1] if number + 1 < len(spoken) else None
        next_onset_s = following.onset_s if following is not None else np.inf
        if not phone.final and next_onset_s - phone.onset_s < _SHORTEST_UNIT_S:
            continue  # the recognizer changed its mind
        bound_s = next((end for end in quiet_s if phone.onset_s < end < next_onset_s), next_onset_s)
        end_s = min(phone.onset_s + max(phone.duration_s, _SHORTEST_UNIT_S), bound_s)
        if bound_s - end_s < (_TOUCHING_S if phone.final else max(hold_s, _TOUCHING_S)):
            end_s = bound_s
        unknown = not phone.final or bound_s == np.inf  # whether the unit has really ended
        held_s = hold_s if unknown and end_s < bound_s else 0.0
        touching = end_s == next_onset_s
        if end_s + held_s < next_onset_s:
            silences.append((end_s + held_s, next_onset_s))
        end_s = max(end_s, phone.onset_s + _SHORTEST_UNIT_S)
        next_unit = following.unit if following is not None and touching else None
        start_s = phone.onset_s
        for shape, share in shapes_of(phone.unit, next_unit):
            length_s = share * (end_s - phone.onset_s)
            edge_s = min(0.5 * length_s, EDGE_S)
            visemes.append(
                (VISEME_INDEX[shape], start_s + edge_s, start_s + length_s - edge_s, phone.index)
            )
            start_s += length_s
        if held_s and phone.unit in INITIALS:
            # a final follows every initial: not knowing which, the mouth sets out for a middle one
            visemes.append(
                (VISEME_INDEX[_EXPECTED_FINAL], end_s + EDGE_S, end_s + held_s, phone.index)
            )
        elif held_s:
            shape_row, first_s, last_s, index = visemes.pop()
            visemes.append((shape_row, first_s, last_s + held_s, index))
    visemes.sort(key=lambda row: row[1:])
    return Timeline(
        viseme=np.array([row[0] for row in visemes], dtype=np.intp),
        centre_start_s=np.array([row[1] for row in visemes], dtype=float),
        centre_end_s=np.array([row[2] for row in visemes], dtype=float),
        unit_index=np.array([row[3] for row in visemes], dtype=np.int64),
        silence_start_s=np.array([row[0] for row in silences], dtype=float),
        silence_end_s=np.array([row[1] for row in silences], dtype=float),
    )
