"""Openings R of the phones, from tracked lips.

Source: Zhang et al. 2021, section 4, measured each opening on photographs. Here the tracked opening
is R(t) itself: between key frames it is linear in the openings of the two phones (eq. 6), so these
are a linear least-squares problem with bounds. A phone that is seldom heard is held near what its
visemes have in other phones. Silence and the bilabials are closed: R is 0.
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
from kouxing.services.synthesizer.lips.ferguson.motion import MAX_OPENING
from kouxing.services.synthesizer.lips.ferguson.openings import anchors_of
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

_FULL_PERCENTILE = 98.0  # of a speaker's opening: R is 5 there
_RIDGE = 10.0  # weight of what a phone's visemes tell, video frames
_CLOSED = (REST, "b")  # visemes whose lips touch
_MIDDLING = 2.0  # opening of a viseme that was never seen


def relative_openings(clips: Sequence[LipClip]) -> list[Array]:
    """Return R of the frames of each clip, (num_frames,), NaN where not measured.

    0 is a closed mouth, 5 the speaker's widest.
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
    """Estimate the opening of each phone; that of silence and of bilabials is 0.

    Parameters
    ----------
    clips
        To learn from.
    labels
        The phones of each clip.
    inventory
        Their language.
    """
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
    of_visemes = _least_squares(weights @ shares, height, np.full(shares.shape[1], _MIDDLING))
    fitted = _least_squares(weights, height, shares @ of_visemes)
    return dict(zip(inventory.phones, (fitted * is_open).tolist(), strict=True))


def travel_of(clips: Sequence[LipClip]) -> Array:
    """Return how far each mouth FAP goes from a closed to the widest mouth, FAP units.

    Zhang et al. 2021, section 3: the coefficients of motion, by least squares through the closed
    mouth, (num_mouth_faps,); 0 where nothing was measured.
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
    """Weight of each phone's opening in R at some times, (num_times, num_phones)."""
    anchors = anchors_of(phones, inventory.silence)
    weights = np.zeros((len(times_s), len(inventory)))
    anchors_s = [time_s for time_s, _ in anchors]
    for number, (_, symbol) in enumerate(anchors):
        tent = np.zeros(len(anchors))
        tent[number] = 1.0
        weights[:, inventory.index[symbol]] += np.interp(times_s, anchors_s, tent)
    return weights


def _viseme_shares(inventory: PhoneInventory) -> Array:
    """Share of each viseme in each phone, (num_phones, num_visemes)."""
    names = sorted({name for shares in inventory.visemes.values() for name, _ in shares})
    shares = np.zeros((len(inventory), len(names)))
    for row, phone in enumerate(inventory.phones):
        for name, share in inventory.visemes[phone]:
            shares[row, names.index(name)] += share
    return shares


def _least_squares(weights: Array, height: Array, start: Array) -> Array:
    ridge = np.sqrt(_RIDGE)
    found = lsq_linear(
        np.vstack([weights, ridge * np.eye(len(start))]),
        np.concatenate([height, ridge * start]),
        (0.0, MAX_OPENING),
    )
    solution: Array = np.clip(found.x, 0.0, MAX_OPENING)
    return solution
