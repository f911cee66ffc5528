"""Openings R of the phones, from tracked lips.

Source: Zhang et al. 2021, section 4, measured each opening on photographs. Here the tracked opening
is R(t). Between key frames it is linear in the openings of the two phones (eq. 6), so the openings
are the solution of a bounded linear least-squares problem. Rare phones are shrunk toward the values
of their visemes in other phones. Silence and bilabials are closed: R is 0.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from kouxing.corpora.lip_clips import LipClip
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import columns
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST
from kouxing.services.synthesizer.lips.ferguson.key_frames import anchors_of
from kouxing.services.synthesizer.lips.ferguson.table import MAX_OPENING
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

_FULL_PERCENTILE = 98.0  # of a speaker's opening, where R is 5
_RIDGE = 10.0  # weight of the value from a phone's visemes, video frames
_CLOSED = (REST, "b")  # visemes whose lips touch
_DEFAULT_OPENING = 2.0  # of a viseme without data


def relative_openings(clips: Sequence[LipClip]) -> list[Array]:
    """Compute R of the frames of each clip, (num_frames,); NaN if not measured.

    R is 0 for a closed mouth and 5 for the speaker's widest.
    """
    openings = [-clip.faps[:, columns((4, 5))].sum(axis=1) for clip in clips]
    of_speaker: dict[str, list[Array]] = defaultdict(list)
    for clip, opening in zip(clips, openings, strict=True):
        of_speaker[clip.speaker].append(opening)
    widest = {
        speaker: float(np.nanpercentile(np.concatenate(group), _FULL_PERCENTILE))
        for speaker, group in of_speaker.items()
    }
    return [
        np.clip(MAX_OPENING * opening / max(widest[clip.speaker], 1.0), 0.0, MAX_OPENING)
        for clip, opening in zip(clips, openings, strict=True)
    ]


def fit_openings(
    clips: Sequence[LipClip], labels: Sequence[list[Phone]], inventory: PhoneInventory
) -> dict[str, float]:
    """Estimate the opening of each phone from clips and their phones."""
    is_open = np.array(
        [inventory.visemes[phone][0][0] not in _CLOSED for phone in inventory.phones]
    )
    parts, heights = [], []
    for clip, phones, opening in zip(clips, labels, relative_openings(clips), strict=True):
        is_measured = np.isfinite(opening)
        parts.append(_weights(clip.time_s[is_measured], phones, inventory) * is_open)
        heights.append(opening[is_measured])
    weights, height = np.concatenate(parts), np.concatenate(heights)
    shares = _viseme_shares(inventory) * is_open[:, None]
    of_visemes = _least_squares(
        weights @ shares, height, np.full(shares.shape[1], _DEFAULT_OPENING)
    )
    fitted = _least_squares(weights, height, shares @ of_visemes)
    return dict(zip(inventory.phones, (fitted * is_open).tolist(), strict=True))


def travel_of(clips: Sequence[LipClip]) -> Array:
    """Measure the travel of each mouth FAP from a closed to the widest mouth, FAP units.

    These are the coefficients of motion of Zhang et al. 2021, section 3, by least squares through
    the closed mouth, (num_mouth_faps,); 0 for FAPs that were not measured.
    """
    opening = np.concatenate(relative_openings(clips)) / MAX_OPENING
    faps = np.concatenate([clip.faps for clip in clips])
    travel = np.zeros(len(MOUTH_FAPS))
    for column in range(len(MOUTH_FAPS)):
        is_measured = np.isfinite(opening) & np.isfinite(faps[:, column])
        x, y = opening[is_measured], faps[is_measured, column]
        if len(x):
            travel[column] = float(x @ y) / max(float(x @ x), 1.0)
    return travel


def _weights(times_s: Array, phones: Sequence[Phone], inventory: PhoneInventory) -> Array:
    """Compute the weight of each phone's opening in R at some times, (num_times, num_phones)."""
    anchors = anchors_of(phones, inventory.silence)
    weights = np.zeros((len(times_s), len(inventory)))
    anchors_s = [time_s for time_s, _ in anchors]
    for number, (_, symbol) in enumerate(anchors):
        tent = np.zeros(len(anchors))
        tent[number] = 1.0
        weights[:, inventory.index[symbol]] += np.interp(times_s, anchors_s, tent)
    return weights


def _viseme_shares(inventory: PhoneInventory) -> Array:
    """Return the share of each viseme in each phone, (num_phones, num_visemes)."""
    names = sorted({name for shares in inventory.visemes.values() for name, _ in shares})
    shares = np.zeros((len(inventory), len(names)))
    for row, phone in enumerate(inventory.phones):
        for name, share in inventory.visemes[phone]:
            shares[row, names.index(name)] += share
    return shares


def _least_squares(weights: Array, height: Array, start: Array) -> Array:
    ridge = np.sqrt(_RIDGE)
    result = lsq_linear(
        np.vstack([weights, ridge * np.eye(len(start))]),
        np.concatenate([height, ridge * start]),
        (0.0, MAX_OPENING),
    )
    return np.clip(result.x, 0.0, MAX_OPENING)
