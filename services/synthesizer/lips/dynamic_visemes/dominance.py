"""Dominance functions of visemes and silence, as log weights.

Source: Li et al. 2011, eq. 5-7; Wang & Cai 2003, eq. 1-4 and 7.

======  ======================================================  =======  =========
symbol  name                                                    unit     shape
======  ======================================================  =======  =========
tau     centre (apex) minus time, positive before it            s        (...)
sigma   centre of the left silence minus time                   s        (...)
nu      centre of the right silence minus time                  s        (...)
alpha   dominance at the centre                                 1        (...)
theta   decay before (minus) and after (plus) the centre        s**-c    (...)
c       exponent, the same for all, above 1 for smooth curves   1        ()
======  ======================================================  =======  =========

Deviations: everything is a logarithm, since the silences grow without bound away from speech; a
softmax over the log weights gives what the papers' quotients give. The silence in a pause is
weakened by how short it is (`log_pause`), which makes "when two phones touch, the silence between
them vanishes" an equation. The closure rule is geometric where eq. 7 is arithmetic
(`log_closure`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# A pause this long gives its silence 63 % of the full dominance.
_PAUSE_SCALE_S = 0.05


def log_dominance(
    tau_s: Array, alpha: Array, theta_minus: Array, theta_plus: Array, c: float
) -> Array:
    """Log dominance of a viseme (Li 2011, eq. 5); all shapes broadcast."""
    theta = np.where(tau_s >= 0.0, theta_minus, theta_plus)
    return np.log(alpha) - theta * np.abs(tau_s) ** c  # Li 2011, eq. 5


def log_left_silence(sigma_s: Array, alpha: Array, theta: Array, c: float) -> Array:
    """Log dominance of the silence before speech (Li 2011, eq. 6); all shapes broadcast."""
    return np.log(alpha) + np.sign(sigma_s) * theta * np.abs(sigma_s) ** c  # Li 2011, eq. 6


def log_right_silence(nu_s: Array, alpha: Array, theta: Array, c: float) -> Array:
    """Log dominance of the silence after speech (Li 2011, eq. 7); all shapes broadcast."""
    weights: Array = np.log(alpha) - np.sign(nu_s) * theta * np.abs(nu_s) ** c  # Li 2011, eq. 7
    return weights


def log_pause(log_right: Array, log_left: Array, pause_s: Array) -> Array:
    """Log dominance of the silence between two words, the right and the left one meeting.

    Wang & Cai 2003, section 3, in words: the silence between neighbours is where the two models
    intersect, it acts the longer and the stronger the longer the pause, and it vanishes of itself
    when they touch. Here: half the harmonic mean of both (their minimum, without its corner),
    times ``1 - exp(-pause / scale)``. A model at an infinite distance leaves the other alone.
    """
    strength: Array = np.log(-np.expm1(-pause_s / _PAUSE_SCALE_S))
    both: Array = np.logaddexp(-log_right, -log_left)
    return strength - both


def log_closure(
    log_viseme: Array, log_others: Array, tau_s: Array, reach_s: float, closure_ratio: float
) -> Array:
    """Log dominance of a closing lip, which outweighs everything else at its apex.

    Wang & Cai 2003, eq. 7 goes from the viseme's own dominance at ``reach_s`` to ``closure_ratio``
    times the sum of all others at the apex along a straight line, whose corners would show as
    jerks. This goes between the same two ends in the log domain along a smooth step.

    Parameters
    ----------
    log_viseme : array (...)
        Log dominance by eq. 5.
    log_others : array (...)
        Log of the sum of all other dominances.
    tau_s : array (...)
        Apex minus time, seconds.
    reach_s : float
        T of eq. 7, seconds.
    closure_ratio : float
        C of eq. 7, above 20.
    """
    nearness = np.clip(1.0 - np.abs(tau_s) / reach_s, 0.0, 1.0)
    step = nearness * nearness * (3.0 - 2.0 * nearness)
    closed = np.log(closure_ratio) + log_others
    return np.where(step > 0.0, (1.0 - step) * log_viseme + step * closed, log_viseme)
