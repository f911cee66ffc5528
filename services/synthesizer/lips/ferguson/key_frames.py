"""The opening of the mouth over time, and its key frames from timed phones.

Source: Zhang et al. 2021, sections 4 and 5, eq. 6. Each initial and final has an opening R, 0
(closed) to 5. The mouth has this opening when the phone starts; in between, R is linear. The mouth
is closed before and after speech. It starts moving shortly before the first sound.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from kouxing.services.synthesizer.lips.ferguson.phone_table import PhoneTable
from kouxing.shared.arrays import Doubles
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import SILENCE

OPENING_TIME_S = 0.12  # time from a closed mouth to the first phone
PAUSE_S = 0.2  # the mouth stays open in shorter gaps between phones
_MIN_STEP_S = 1e-3  # minimum time between key frames


@dataclass(frozen=True, slots=True, eq=False)
class KeyFrames:
    """The opening R(t) of a mouth; constant before the first and after the last key frame."""

    times_s: Doubles  # (num_key_frames,) strictly ascending, at least one
    openings: Doubles  # (num_key_frames,) R at these times, 0 to MAX_OPENING

    def openings_at(self, times_s: ArrayLike) -> Doubles:
        """Return R (n,) at times (n,)."""
        times = np.asarray(times_s)
        openings: Doubles = np.interp(times, self.times_s, self.openings)  # Zhang 2021, eq. 6
        return openings


def build_anchors(phones: Sequence[Phone]) -> list[tuple[float, str]]:
    """Return ascending times at which the mouth has the opening of a phone.

    ``phones`` are sorted by time. Gaps and silence are pauses, with a closed mouth.
    """
    spoken = [phone for phone in phones if phone.symbol != SILENCE]
    anchors: list[tuple[float, str]] = []
    end_s = -np.inf
    for phone in spoken:
        if phone.onset_s - end_s > PAUSE_S:
            if anchors:
                anchors.append((end_s, SILENCE))
            anchors.append((phone.onset_s - OPENING_TIME_S, SILENCE))
        anchors.append((phone.onset_s, phone.symbol))
        end_s = phone.end_s
    if spoken:
        anchors.append((end_s, SILENCE))
    rising: list[tuple[float, str]] = []
    for time_s, symbol in anchors:
        if not rising or time_s >= rising[-1][0] + _MIN_STEP_S:
            rising.append((time_s, symbol))
    return rising


def build_key_frames(phones: Sequence[Phone], table: PhoneTable) -> KeyFrames:
    """Build key frames from ``build_anchors``; without phones, the mouth is closed."""
    anchors = build_anchors(phones) or [(0.0, SILENCE)]
    return KeyFrames(
        np.array([time_s for time_s, _ in anchors]),
        np.array([table.opening[symbol] for _, symbol in anchors]),
    )
