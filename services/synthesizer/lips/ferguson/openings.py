"""From timed phones to key frames of the mouth's opening.

Source: Zhang et al. 2021, sections 4 and 5. The mouth has a phone's opening when the phone begins.
Before and after speech it is closed; it sets out a little before the first sound.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from kouxing.services.synthesizer.lips.ferguson.motion import KeyFrames
from kouxing.services.synthesizer.lips.ferguson.table import PhoneTable
from kouxing.shared.phones.events import Phone

SETTING_OUT_S = 0.12  # from a closed mouth to the first phone
PAUSE_S = 0.2  # a shorter hole between two phones does not close the mouth
_MIN_STEP_S = 1e-3  # between key frames


def anchors_of(phones: Sequence[Phone], silence: str) -> list[tuple[float, str]]:
    """Return the times at which the mouth has the opening of a phone, rising.

    Parameters
    ----------
    phones
        In order of time; holes between them, and ``silence``, are pauses.
    silence
        The phone that stands for a closed mouth.
    """
    spoken = [phone for phone in phones if phone.symbol != silence]
    anchors: list[tuple[float, str]] = []
    end_s = -np.inf
    for phone in spoken:
        if phone.onset_s - end_s > PAUSE_S:
            if anchors:
                anchors.append((end_s, silence))
            anchors.append((phone.onset_s - SETTING_OUT_S, silence))
        anchors.append((phone.onset_s, phone.symbol))
        end_s = phone.onset_s + phone.duration_s
    if spoken:
        anchors.append((end_s, silence))
    rising: list[tuple[float, str]] = []
    for time_s, symbol in anchors:
        if not rising or time_s >= rising[-1][0] + _MIN_STEP_S:
            rising.append((time_s, symbol))
    return rising


def key_frames_of(phones: Sequence[Phone], table: PhoneTable, silence: str) -> KeyFrames:
    """Return the openings of a mouth that says some phones, as ``anchors_of``; closed if none."""
    anchors = anchors_of(phones, silence) or [(0.0, silence)]
    return KeyFrames(
        np.array([time_s for time_s, _ in anchors]),
        np.array([table.opening[symbol] for _, symbol in anchors]),
    )
