"""How alike two curves of a mouth are: pure figures.

*Made* is what a lip model makes, *real* what was tracked. Both are sampled at the same times unless
said otherwise; openings are in FAP units. Counts and sums add up over clips, so that a group's
figures are those of all its frames pooled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

Array = NDArray[np.float64]

DRIFT_HZ = 1.0
CLOSURE_WINDOW_S = 0.04
PAIRING_WINDOW_S = 0.3  # an opening further away is another one
_SHUT, _OPEN = 20.0, 100.0  # FAP units of made opening: 0.6 and 3 mm on a face
NEITHER_SHUT_NOR_OPEN = 60.0
_SHUT_SHARE = 0.1  # of a real mouth's range
_OPEN_SHARE, _OPEN_WINDOW_S = 0.5, 0.2  # which opens so far near a closure: else it is a pause
_NEAR_REST, _RAISED = 10.0, 10.0  # FAP units of the lower and the upper lip
_RISE_FROM, _RISE_THROUGH = 0.1, 0.3  # shares of a mouth's range
_STILL = 25.0  # FAP units per second
_SETTLED_S, _SETTING_OUT_S = 0.3, 0.2  # of a pause: lips still close, and already open
_NO_POWER = 1e-12  # of what filters leave of a curve that stands still
_ROUNDING_S = 1e-6


@dataclass(frozen=True, slots=True)
class Likeness:
    """Sums over the frames of two curves, the means of each clip removed."""

    num_frames: int = 0
    products: float = 0.0
    made_power: float = 0.0
    real_power: float = 0.0

    def __add__(self, other: Likeness) -> Likeness:
        return Likeness(
            self.num_frames + other.num_frames,
            self.products + other.products,
            self.made_power + other.made_power,
            self.real_power + other.real_power,
        )

    @property
    def correlation(self) -> float | None:
        """Pearson's correlation; None where a curve stands still."""
        if min(self.made_power, self.real_power) <= _NO_POWER * self.num_frames:
            return None
        return self.products / float(np.sqrt(self.made_power * self.real_power))

    @property
    def rmse(self) -> float | None:
        """Root mean squared error; None without frames."""
        if not self.num_frames:
            return None
        squares = self.made_power + self.real_power - 2.0 * self.products
        return float(np.sqrt(max(squares, 0.0) / self.num_frames))


@dataclass(frozen=True, slots=True)
class Hits:
    """Real events that are met, and made events that are true."""

    num_real: int = 0
    num_met: int = 0
    num_made: int = 0
    num_true: int = 0

    def __add__(self, other: Hits) -> Hits:
        return Hits(
            self.num_real + other.num_real,
            self.num_met + other.num_met,
            self.num_made + other.num_made,
            self.num_true + other.num_true,
        )

    @property
    def recall(self) -> float | None:
        """Share of the real events that are met."""
        return self.num_met / self.num_real if self.num_real else None

    @property
    def precision(self) -> float | None:
        """Share of the made events that are true."""
        return self.num_true / self.num_made if self.num_made else None

    @property
    def f1(self) -> float | None:
        """Harmonic mean of recall and precision; 0 where nothing real is met."""
        if self.recall is None:
            return None
        precision = self.precision or 0.0
        return 2.0 * self.recall * precision / (self.recall + precision or 1.0)


@dataclass(frozen=True, slots=True)
class Turns:
    """How often a curve changes direction."""

    count: int = 0
    seconds: float = 0.0

    def __add__(self, other: Turns) -> Turns:
        return Turns(self.count + other.count, self.seconds + other.seconds)

    @property
    def per_second(self) -> float | None:
        """Changes of direction a second."""
        return self.count / self.seconds if self.seconds else None


@dataclass(frozen=True, slots=True)
class Speed:
    """How fast a curve moves."""

    num_steps: int = 0
    squares: float = 0.0

    def __add__(self, other: Speed) -> Speed:
        return Speed(self.num_steps + other.num_steps, self.squares + other.squares)

    @property
    def rms(self) -> float | None:
        """Root of the mean squared velocity, units of the curve a second; None without steps."""
        return float(np.sqrt(self.squares / self.num_steps)) if self.num_steps else None


def likeness(made: Array, real: Array) -> Likeness:
    """Compare two curves of a clip, shape (num_frames,) each."""
    if not len(made):
        return Likeness()
    made, real = made - made.mean(), real - real.mean()
    return Likeness(len(made), float(made @ real), float(made @ made), float(real @ real))


def without_drift(values: Array, rate_hz: float) -> Array:
    """Remove all below 1 Hz from a curve, shape (n,), without delaying it."""
    sections = butter(2, DRIFT_HZ, "highpass", fs=rate_hz, output="sos")
    reach = min(len(values) - 1, round(rate_hz / DRIFT_HZ))
    filtered: Array = sosfiltfilt(sections, values, padlen=reach)
    return filtered


def turns(time_s: Array, values: Array) -> Turns:
    """Count sign changes of the velocity; slower than 25 FAP units a second is standing still.

    Parameters
    ----------
    time_s, values
        Shape (num_frames,).
    """
    if len(values) < 2:
        return Turns()
    velocity = np.diff(values) / np.diff(time_s)
    direction = np.sign(velocity[np.abs(velocity) > _STILL])
    return Turns(int(np.sum(direction[1:] != direction[:-1])), float(time_s[-1] - time_s[0]))


def rms_jerk(curves: Sequence[Array], rate_hz: float) -> float | None:
    """Root mean square of the third derivative of some curves, units of theirs a second cubed.

    The smoother a motion, the less; None where there are no four frames.

    Parameters
    ----------
    curves
        Shape (num_frames,) each.
    rate_hz
        Of their frames.
    """
    jerks = np.concatenate([np.zeros(0), *(np.diff(curve, n=3) for curve in curves)]) * rate_hz**3
    return float(np.sqrt(np.mean(jerks**2))) if len(jerks) else None


def speed_in(pauses_s: Array, time_s: Array, values: Array) -> Speed:
    """Measure how fast a curve moves within pauses.

    The first 0.3 s and the last 0.2 s of each are left out: there a mouth closes and opens.

    Parameters
    ----------
    pauses_s
        Starts and ends, shape (num_pauses, 2).
    time_s, values
        Shape (num_frames,); nan where not measured.
    """
    start_s, end_s = pauses_s[:, :1] + _SETTLED_S, pauses_s[:, 1:] - _SETTING_OUT_S
    still: NDArray[np.bool_] = np.any((time_s >= start_s) & (time_s <= end_s), axis=0)
    velocity = np.diff(values) / np.diff(time_s)
    velocity = velocity[still[1:] & still[:-1] & ~np.isnan(velocity)]
    return Speed(len(velocity), float(velocity @ velocity))


def shut_after(pauses_s: Array, shut_s: Array) -> Array:
    """Time from the start of each pause to the first moment in which lips are shut, seconds.

    Parameters
    ----------
    pauses_s
        Starts and ends, shape (num_pauses, 2).
    shut_s
        Of ``real_shut`` or ``made_shut``.

    Returns
    -------
    Array
        Shape (num_pauses,); nan where they do not shut before the end.
    """
    after = np.append(shut_s, np.inf)[np.searchsorted(shut_s, pauses_s[:, 0])]
    return np.where(after <= pauses_s[:, 1], after - pauses_s[:, 0], np.nan)


def made_shut(time_s: Array, opening: Array) -> Array:
    """Return the times of all frames in which made lips are shut, seconds."""
    return time_s[opening < _SHUT]


def real_closures(time_s: Array, opening: Array) -> Array:
    """When real lips close, seconds: minima of lips that are shut, near an opening.

    Frames without a face are nan.
    """
    before, here, after = opening[:-2], opening[1:-1], opening[2:]
    minimum = (here <= before) & (here < after) & _is_shut(opening)[1:-1]
    return _near_opening(time_s[1:-1][minimum], time_s, opening)


def real_shut(time_s: Array, opening: Array) -> Array:
    """Return the times of all frames in which real lips are shut, seconds."""
    return time_s[_is_shut(opening)]


def _is_shut(opening: Array) -> NDArray[np.bool_]:
    """Tell where the opening is within the lowest tenth of its range."""
    if np.isnan(opening).all():
        return np.zeros(len(opening), dtype=bool)
    low, high = np.nanpercentile(opening, [1, 99])
    shut: NDArray[np.bool_] = opening < low + _SHUT_SHARE * (high - low)
    return shut


def lip_to_teeth_poses(time_s: Array, upper: Array, lower: Array) -> Array:
    """When a real mouth looks as in f, seconds: peaks of the lower lip, upper lip raised.

    The lower lip (FAP 5) is near its place at rest or above it while the upper lip (FAP 4) is
    raised, near an opening. Of a newsreader's f 12 of 16 look so, but only 12 of the 68 moments
    that look so are an f: a camera does not see whether lip and teeth touch. Shape (num_frames,)
    each, nan without a face.
    """
    contact = _contact(upper, lower)
    before, here, after = contact[:-2], contact[1:-1], contact[2:]
    peak = (here >= before) & (here > after) & (here > 0.0)
    return _near_opening(time_s[1:-1][peak], time_s, -upper - lower)


def _near_opening(moments_s: Array, time_s: Array, opening: Array) -> Array:
    """Moments within 0.2 s of a mouth that is open half its range."""
    if not len(moments_s):
        return moments_s
    low, high = np.nanpercentile(opening, [1, 99])
    opened_s = time_s[opening > low + _OPEN_SHARE * (high - low)]
    near: Array = moments_s[is_near(moments_s, opened_s, _OPEN_WINDOW_S)]
    return near


def _contact(upper: Array, lower: Array) -> Array:
    """How far a face has what lip to teeth needs, FAP units, above 0 where it has both."""
    contact: Array = np.minimum(lower + _NEAR_REST, -upper - _RAISED)
    return contact


def shut_at(moments_s: Array, time_s: Array, opening: Array) -> NDArray[np.bool_]:
    """Tell of some moments whether lips meet within 40 ms of them and are open within 0.2 s.

    Parameters
    ----------
    moments_s
        Shape (num_moments,).
    time_s, opening
        Of made lips, shape (num_frames,).
    """
    return _touches_at(moments_s, time_s, opening < _SHUT, opening > _OPEN)


def closures(real_s: Array, shut_s: Array, time_s: Array, opening: Array) -> Hits:
    """Compare real closures with those of made lips.

    Real closures are met where the made lips meet within 40 ms. A made closure, lips that meet
    after having been open, is true where real lips are shut within 40 ms of it: at a minimum or in
    a pause that lasts. Only within 0.2 s of open lips does a mouth close anything: else it rests.

    Parameters
    ----------
    real_s, shut_s
        Of ``real_closures`` and ``real_shut``.
    time_s, opening
        Of made lips, shape (num_frames,).
    """
    return _hits(real_s, shut_s, time_s, opening < _SHUT, opening > _OPEN)


def lip_to_teeth(real_s: Array, poses_s: Array, time_s: Array, upper: Array, lower: Array) -> Hits:
    """Compare contacts of lower lip and upper teeth, as closures are.

    Parameters
    ----------
    real_s
        When real lips touch the teeth, seconds: these can be met.
    poses_s
        When real lips look as if: near these a made contact is true.
    time_s, upper, lower
        Of made lips, shape (num_frames,): FAP 4 and 5.
    """
    touching = _contact(upper, lower) > 0.0
    return _hits(real_s, poses_s, time_s, touching, (-upper - lower > _OPEN) & ~touching)


def _touches_at(
    moments_s: Array, time_s: Array, touching: NDArray[np.bool_], is_open: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    return is_near(moments_s, time_s[touching], CLOSURE_WINDOW_S) & is_near(
        moments_s, time_s[is_open], _OPEN_WINDOW_S
    )


def _hits(
    real_s: Array,
    true_s: Array,
    time_s: Array,
    touching: NDArray[np.bool_],
    is_open: NDArray[np.bool_],
) -> Hits:
    """Count real contacts that are met, and made ones, after having been open, that are true."""
    met = _touches_at(real_s, time_s, touching, is_open)
    touching = touching & is_near(time_s, time_s[is_open], _OPEN_WINDOW_S)
    # How often the lips have opened so far numbers the contacts; 0 is the rest at the start.
    state = np.where(is_open, 1, -1)[is_open | touching]
    number = np.cumsum(np.diff(state, prepend=-1) > 0)[state < 0]
    is_true = is_near(time_s[touching], true_s, CLOSURE_WINDOW_S)
    return Hits(
        len(real_s),
        int(met.sum()),
        len(np.unique(number[number > 0])),
        len(np.unique(number[(number > 0) & is_true])),
    )


def openings(time_s: Array, opening: Array) -> Array:
    """When a mouth opens, seconds: the opening rises from a tenth to three tenths of its range."""
    known = ~np.isnan(opening)
    time_s, opening = time_s[known], opening[known]
    if not len(opening) or np.ptp(opening) == 0.0:
        return np.zeros(0)
    low, high = np.percentile(opening, [1, 99])
    level = (opening - low) / max(high - low, 1e-9)
    moments, is_ready = [], False
    for k, value in enumerate(level):
        if value < _RISE_FROM:
            is_ready = True
        elif value >= _RISE_THROUGH and is_ready:
            share = (_RISE_THROUGH - level[k - 1]) / (value - level[k - 1])
            moments.append(time_s[k - 1] + share * (time_s[k] - time_s[k - 1]))
            is_ready = False
    return np.array(moments)


def offsets(moments_s: Array, others_s: Array, window_s: float) -> Array:
    """Time from each moment to the nearest of some others, shape (n,); nan beyond a window."""
    if not len(others_s):
        return np.full(len(moments_s), np.nan)
    nearest = np.abs(others_s - moments_s[:, None]).argmin(axis=1)
    found = others_s[nearest] - moments_s
    return np.where(np.abs(found) <= window_s, found, np.nan)


def is_near(moments_s: Array, others_s: Array, window_s: float) -> NDArray[np.bool_]:
    """Tell of each moment whether one of some others, in order, is within a window around it."""
    if not len(others_s):
        return np.zeros(len(moments_s), dtype=bool)
    after = np.searchsorted(others_s, moments_s)
    gaps = [
        np.abs(others_s[np.clip(index, 0, len(others_s) - 1)] - moments_s)
        for index in (after - 1, after)
    ]
    near: NDArray[np.bool_] = np.minimum(*gaps) <= window_s + _ROUNDING_S
    return near


def best_lag(likenesses: Sequence[Likeness], lags_s: Array) -> tuple[float, float] | None:
    """Return the highest correlation of a curve at several lags, and its lag in seconds.

    None where it stands still or nothing was compared, and at either end of the lags: the
    correlation is no maximum there.
    """
    found = [
        (each.correlation, float(lag_s))
        for each, lag_s in zip(likenesses, lags_s, strict=False)
        if each.correlation is not None
    ]
    best = max(found, default=None)
    return best if best in found[1:-1] else None
