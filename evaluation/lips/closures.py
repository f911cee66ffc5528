"""Closures of lips: recall of the real closures, and precision of a mouth's closures.

Lips that touch near an opening are a contact. Lips that touch elsewhere are at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from kouxing.evaluation.lips.curves import is_near
from kouxing.evaluation.lips.mouths import Mouth
from kouxing.shared.arrays import Doubles, Mask

WINDOW_S = 0.04
_MIN_OPEN = 100.0  # opening of predicted lips in FAP units: 3 mm on a face
_OPEN_FRACTION, _OPEN_WINDOW_S = 0.5, 0.2  # fraction of a real mouth's range


@dataclass(frozen=True, slots=True)
class DetectionCounts:
    """Numbers of real, reproduced and predicted events, and of predictions that are true."""

    real: int = 0
    reproduced: int = 0
    predicted: int = 0
    true: int = 0

    def __add__(self, other: DetectionCounts) -> DetectionCounts:
        return DetectionCounts(
            self.real + other.real,
            self.reproduced + other.reproduced,
            self.predicted + other.predicted,
            self.true + other.true,
        )

    @property
    def recall(self) -> float | None:
        """Share of the real events that are reproduced."""
        return self.reproduced / self.real if self.real else None

    @property
    def precision(self) -> float | None:
        """Fraction of the predicted events that are true."""
        return self.true / self.predicted if self.predicted else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of recall and precision; 0 if no real event is reproduced."""
        if self.recall is None:
            return None
        precision = self.precision or 0.0
        return 2.0 * self.recall * precision / (self.recall + precision or 1.0)


@dataclass(frozen=True, slots=True)
class Contact:
    """A closure of predicted lips, from an opening to the next one."""

    time_s: float  # middle of the frames in which the lips touch
    is_true: bool  # real lips are closed within 40 ms of one of these frames


def real_closures(mouth: Mouth) -> Doubles:
    """Return when real lips close, seconds: minima of closed lips near an opening."""
    before, here, after = mouth.opening[:-2], mouth.opening[1:-1], mouth.opening[2:]
    is_minimum = (here <= before) & (here < after) & mouth.is_closed[1:-1]
    events_s: Doubles = mouth.time_s[1:-1][is_minimum]
    if not len(events_s):
        return events_s
    low, high = np.percentile(mouth.opening, [1, 99])
    opening_times_s = mouth.time_s[mouth.opening > low + _OPEN_FRACTION * (high - low)]
    return np.asarray(events_s[is_near(events_s, opening_times_s, _OPEN_WINDOW_S)])


def is_closed_at(events_s: Doubles, mouth: Mouth) -> Mask:
    """Whether lips close within 40 ms of each moment and are open within 0.2 s."""
    near = is_near(events_s, mouth.time_s[mouth.is_closed], WINDOW_S)
    return near & is_near(events_s, mouth.time_s[mouth.opening > _MIN_OPEN], _OPEN_WINDOW_S)


def contacts(predicted: Mouth, real: Mouth) -> list[Contact]:
    """Return the closures of predicted lips. A contact starts when open lips close.

    Closures where the real mouth is unknown, such as after the end of the clip, do not count.
    """
    is_open = predicted.opening > _MIN_OPEN
    opening_times_s = predicted.time_s[is_open]
    touching = (
        predicted.is_closed & ~is_open & is_near(predicted.time_s, opening_times_s, _OPEN_WINDOW_S)
    )
    touching &= is_near(predicted.time_s, real.time_s, WINDOW_S)
    # A contact's number is how often the lips have opened before it. Contact 0 is the initial rest.
    state = np.where(is_open, 1, -1)[is_open | touching]
    number = np.cumsum(np.diff(state, prepend=-1) > 0)[state < 0]
    time_s = predicted.time_s[touching]
    is_true = is_near(time_s, real.time_s[real.is_closed], WINDOW_S)
    return [
        Contact(float(time_s[frames].mean()), bool(is_true[frames].any()))
        for k in np.unique(number[number > 0])
        if len(frames := np.flatnonzero(number == k))
    ]


def closures(predicted: Mouth, real: Mouth) -> DetectionCounts:
    """Compare closures. A real closure is reproduced if the predicted lips also close within 40 ms.

    Adapted from the closure accuracy of Electronic Arts, which measures only recall.

    In the example, there is a frame every 40 ms. The real lips close in the second frame, and the
    predicted lips in the third and the sixth.

    >>> def mouth(*opening: float) -> Mouth:
    ...     curve = np.array(opening)
    ...     return Mouth(np.arange(len(curve)) / 25.0, {"opening": curve}, curve < 20.0)
    >>> predicted = mouth(200, 200, 0, 200, 200, 0, 200)
    >>> detections = closures(predicted, mouth(200, 0, 200, 200, 200, 200, 200))
    >>> detections.recall, detections.precision, round(detections.f1, 2)
    (1.0, 0.5, 0.67)
    """
    real_s, predicted_contacts = real_closures(real), contacts(predicted, real)
    num_reproduced = int(is_closed_at(real_s, predicted).sum())
    num_true = sum(contact.is_true for contact in predicted_contacts)
    return DetectionCounts(len(real_s), num_reproduced, len(predicted_contacts), num_true)
