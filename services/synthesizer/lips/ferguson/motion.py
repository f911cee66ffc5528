"""The opening of the mouth over time, from key frames.

Source: Zhang et al. 2021, section 5, eq. 6. Each initial and final has an opening R, 0 (closed) to
5, which the mouth has when the sound begins; between two of them R is linear. As an option, R
follows a smooth curve instead: a piecewise cubic without overshoot (PCHIP, Fritsch and Butland,
"A method for constructing local monotone piecewise cubic interpolants", 1984).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator

Array = NDArray[np.float64]

MAX_OPENING = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class KeyFrames:
    """The openings R(t) of a mouth.

    Before the first key frame and after the last one, R stays what it is there.

    Parameters
    ----------
    times_s : array (num_key_frames,)
        Seconds, strictly rising; at least one.
    openings : array (num_key_frames,)
        R at these times, 0 to ``MAX_OPENING``.

    Raises
    ------
    ValueError
        If there are no key frames, their times do not rise, or an opening is out of range.
    """

    times_s: Array
    openings: Array

    def __post_init__(self) -> None:
        if self.times_s.ndim != 1 or self.times_s.shape != self.openings.shape:
            raise ValueError(
                f"expected times_s and openings of one shape (num_key_frames,), got "
                f"{self.times_s.shape} and {self.openings.shape}"
            )
        if not len(self.times_s) or not (np.diff(self.times_s) > 0.0).all():
            raise ValueError("times_s must rise strictly, with at least one key frame")
        if not ((self.openings >= 0.0) & (self.openings <= MAX_OPENING)).all():
            raise ValueError(f"an opening is between 0 and {MAX_OPENING:g}")

    def openings_at(self, times_s: ArrayLike, *, smooth: bool = False) -> Array:
        """Return R at some times, shape (n,) for times (n,).

        Parameters
        ----------
        times_s
            Seconds, in any order, shape (n,).
        smooth
            Whether R has a continuous velocity, instead of being linear between key frames.
        """
        times = np.asarray(times_s, dtype=np.float64)
        if not smooth or len(self.times_s) == 1:
            linear: Array = np.interp(times, self.times_s, self.openings)  # Zhang 2021, eq. 6
            return linear
        within = np.clip(times, self.times_s[0], self.times_s[-1])
        curve: Array = PchipInterpolator(self.times_s, self.openings)(within)
        return np.clip(curve, 0.0, MAX_OPENING)
