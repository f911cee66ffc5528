"""Dominance functions of visemes and silence, as log weights.

Source: Li et al. 2011, eq. 5-7; Wang & Cai 2003, eq. 1-4 and 7.

======  ======================================================  =======  =========
symbol  name                                                    unit     shape
======  ======================================================  =======  =========
tau     apex (the papers' center) minus time                    s        (...)
sigma   center of the left silence minus time                   s        (...)
nu      center of the right silence minus time                  s        (...)
alpha   dominance at the apex                                   1        (...)
theta   decay before (minus) and after (plus) the apex          s**-c    (...)
c       exponent, the same for all, above 1 for smooth curves   1        ()
======  ======================================================  =======  =========

Deviations: All values are logarithms, because silences grow without bound away from speech. A
softmax over log weights equals the papers' quotient. A short pause weakens its silence
(`log_pause`); this expresses the rule that the silence between touching phones vanishes. The
closure rule is geometric instead of arithmetic (`log_closure`).
"""

import numpy as np

from kouxing.shared.arrays import Doubles

_PAUSE_SCALE_S = 0.05  # the silence of a pause this long has 63 % of the full dominance


def log_dominance(
    tau_s: Doubles, log_alpha: Doubles, theta_minus: Doubles, theta_plus: Doubles, c: float
) -> Doubles:
    """Return the log dominance of a viseme (Li 2011, eq. 5); all shapes broadcast."""
    theta = np.where(tau_s >= 0.0, theta_minus, theta_plus)
    return log_alpha - theta * np.abs(tau_s) ** c  # Li 2011, eq. 5


def log_silence(inside_s: Doubles, log_alpha: Doubles | float, theta: Doubles, c: float) -> Doubles:
    """Return the log dominance of the silence before or after speech (Li 2011, eq. 6 and 7).

    ``inside_s`` is how far a time is inside the speech: -sigma before it, nu after it.
    """
    return log_alpha - np.copysign(theta * np.abs(inside_s) ** c, inside_s)


def log_pause(log_right: Doubles, log_left: Doubles, pause_s: Doubles) -> Doubles:
    """Return the log dominance of the silence between two words.

    Wang & Cai 2003, section 3, give no formula: the silence is where the models of both neighbors
    intersect, it is stronger in longer pauses, and it vanishes when the neighbors touch. This
    function is half the harmonic mean of both models (a smooth minimum) times ``1 - exp(-pause /
    scale)``. A model at an infinite distance has no effect.
    """
    strength: Doubles = np.log(-np.expm1(-pause_s / _PAUSE_SCALE_S))
    both: Doubles = np.logaddexp(-log_right, -log_left)
    return strength - both


def log_closure(
    log_viseme: Doubles, log_others: Doubles, tau_s: Doubles, reach_s: float, closure_ratio: float
) -> Doubles:
    """Return the log dominance of a closing lip, which outweighs all others at its apex.

    Wang & Cai 2003, eq. 7 interpolates linearly from the viseme's own dominance at ``reach_s`` to
    ``closure_ratio`` times the sum of all others at the apex. Its corners would be visible as
    jerks. This function uses a smooth step in the log domain between the same end points.

    ``log_viseme`` is the dominance by eq. 5, ``log_others`` the sum of all others, ``reach_s`` is T
    and ``closure_ratio`` is C of eq. 7.
    """
    nearness = np.clip(1.0 - np.abs(tau_s) / reach_s, 0.0, 1.0)
    step = nearness * nearness * (3.0 - 2.0 * nearness)
    closed = np.log(closure_ratio) + log_others
    return np.where(step > 0.0, (1.0 - step) * log_viseme + step * closed, log_viseme)
