"""Converts FAPs to mouth cues: nine drawn mouths (A to H and X), or Oculus visemes.

The letters follow Rhubarb Lip Sync (D. S. Wolf, README, "Mouth shapes") and the studio
Hanna-Barbera: A closed, B slightly open, C open, D wide open, E slightly rounded, F puckered, G
lower lip at the upper teeth, H tongue behind the upper teeth, X rest. They are computed from the
FAPs of the face, so they match its lips in any language. Thresholds are in FAP units, chosen for
the openings of filmed speakers: 60, 370 and 500 separate A to D.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias

import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.face.shapes import OCULUS

Cue: TypeAlias = tuple[float, str]  # start in seconds, and the mouth

CLOSED, REST = "A", "X"
SILENCE = "sil"  # the Oculus viseme of silence
_MAX_CLOSED, _MAX_SLIGHTLY_OPEN, _MAX_OPEN = 60.0, 370.0, 500.0  # largest opening of A, B and C
_ROUNDED = 90.0  # smallest rounding of E and F
_PUCKERED = 200.0  # largest opening of F
_TEETH_GAP, _TEETH_LIFT = 50.0, 80.0  # G: the lower lip is up, the upper lip is raised
_TONGUE_TIP = 200.0  # smallest height of the tongue tip in H
_WEAK = 0.12  # weight below which an Oculus viseme is not shown
_REST_S = 0.2  # lips that stay closed for longer are at rest


def mouth_shape(faps: Floats) -> str:
    """Return the letter, A to H, of a face with FAPs (68,)."""
    upper, lower = -float(faps[3]), -float(faps[4])  # how far each lip is from closed lips
    opening = upper + lower
    rounding = float(np.mean([faps[15], faps[16], -faps[5], -faps[6]]))  # protrusion, narrowness
    if lower < _TEETH_GAP and upper > _TEETH_LIFT:
        return "G"
    if opening < _MAX_CLOSED:
        return CLOSED
    if rounding > _ROUNDED:
        return "F" if opening < _PUCKERED else "E"
    if opening < _MAX_SLIGHTLY_OPEN:
        return "B"
    if faps[43] > _TONGUE_TIP:
        return "H"
    return "C" if opening < _MAX_OPEN else "D"


def oculus_viseme(faps: Floats) -> str:
    """Return the strongest of the 15 Oculus visemes of a face with FAPs (68,).

    ``sil`` is 1 minus the other weights, so it counts only if all others are weak. ``PP`` needs
    closed lips, because in a blend it only narrows an opening.
    """
    weights = OCULUS.weights(faps)
    weights[0] = _WEAK
    if -faps[3] - faps[4] >= _MAX_CLOSED:
        weights[OCULUS.names.index("PP")] = 0.0
    return OCULUS.names[int(weights.argmax())]


def mouth_cues(frames: Iterable[tuple[float, Floats]]) -> Iterator[Cue]:
    """Yield a cue for each change of the drawn mouth, as soon as the change is certain.

    ``frames`` are times in seconds and FAPs (68,). The first cue starts at the first frame. Closed
    lips are A, and after 0.2 s X.
    """
    closed_since_s = -np.inf

    def mouth_of(time_s: float, faps: Floats) -> str:
        nonlocal closed_since_s
        shape = mouth_shape(faps)
        if shape != CLOSED:
            closed_since_s = np.inf
        elif closed_since_s == np.inf:
            closed_since_s = time_s
        return REST if time_s - closed_since_s > _REST_S - 1e-6 else shape

    return _cues(frames, mouth_of, frozenset({CLOSED, "G"}))


def oculus_cues(frames: Iterable[tuple[float, Floats]]) -> Iterator[Cue]:
    """Yield a cue for each change of the strongest Oculus viseme, like :func:`mouth_cues`."""
    return _cues(frames, lambda _, faps: oculus_viseme(faps), frozenset({"PP", "FF"}))


def _cues(
    frames: Iterable[tuple[float, Floats]],
    mouth_of: Callable[[float, Floats], str],
    at_once: frozenset[str],
) -> Iterator[Cue]:
    """Yield the mouths that last two frames. Mouths in ``at_once`` may last one frame."""
    shown = candidate = ""
    since_s = 0.0
    for time_s, faps in frames:
        mouth = mouth_of(time_s, faps)
        if mouth != shown and (mouth == candidate or mouth in at_once or not shown):
            yield (since_s if mouth == candidate else time_s), mouth
            shown = candidate = mouth
        elif mouth != candidate:
            candidate, since_s = mouth, time_s
