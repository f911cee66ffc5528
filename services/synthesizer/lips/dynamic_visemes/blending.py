"""Blends visemes by their dominance.

Source: Wang & Cai 2003, eq. 6 (all visemes and silences); Li et al. 2011, eq. 9-11 (the pair of
visemes around a time, which suffices for a live synthesizer).

Both are the same quotient over different sets of visemes, so one function blends and another
selects. A softmax over log weights replaces the quotient, because the silences' weights would
overflow.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.dominance import (
    log_closure,
    log_dominance,
    log_pause,
    log_silence,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import VisemeParameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline
from kouxing.services.synthesizer.lips.trajectory import FapState
from kouxing.shared.arrays import Doubles, Mask
from kouxing.shared.fast_record import Record

_STEP_S = 1e-3  # step of the numerical derivative


class SequenceParameters(Record, frozen=True, kw_only=True):
    """The parameters of a sequence of visemes, followed by silences.

    Viseme arrays have shape (num_visemes, 1, num_mouth_faps).
    """

    offset_s: Doubles
    log_alpha: Doubles
    theta_minus: Doubles
    theta_plus: Doubles
    target: Doubles  # (num_visemes + num_silences, num_mouth_faps)
    closing: list[tuple[int, NDArray[np.intp]]]  # closing visemes, and the FAPs that close


def build_sequence_parameters(
    parameters: VisemeParameters, timeline: Timeline
) -> SequenceParameters:
    """Return the parameters of a timeline's visemes and silences. They do not depend on times."""
    viseme = timeline.viseme
    offset_s, log_alpha, theta_minus, theta_plus = parameters.dominance[viseme, :, None].swapaxes(
        0, 1
    )
    neutral = parameters.neutral[None].repeat(len(timeline.silence_start_s), axis=0)
    return SequenceParameters(
        offset_s=offset_s,
        log_alpha=log_alpha,
        theta_minus=theta_minus,
        theta_plus=theta_plus,
        target=np.concatenate([parameters.target[viseme], neutral]),
        closing=[
            (row, np.flatnonzero(parameters.closes[viseme[row]]))
            for row in parameters.any_closes[viseme].nonzero()[0].tolist()
        ],
    )


def softmax(log_weights: Doubles) -> Doubles:
    """Return weights that sum to one along the first axis."""
    weights: Doubles = np.exp(log_weights - np.maximum.reduce(log_weights))
    weights /= np.add.reduce(weights)
    return weights


def log_weights(
    parameters: VisemeParameters, sequence: SequenceParameters, timeline: Timeline, time_s: Doubles
) -> Doubles:
    """Return the log weights (num_visemes + num_silences, num_times, num_mouth_faps).

    ``time_s`` has shape (num_times,).
    """
    p, c = parameters, parameters.c
    time = time_s[:, None]  # (F, 1)
    # signed distance to the apex: positive before it, negative after it, 0 inside
    before = timeline.apex_start_s[:, None, None] + sequence.offset_s - time
    after = timeline.apex_end_s[:, None, None] + sequence.offset_s - time
    tau = np.maximum(before, 0.0) + np.minimum(after, 0.0)  # (E, F, P)
    spoken = log_dominance(tau, sequence.log_alpha, sequence.theta_minus, sequence.theta_plus, c)
    edges_s = np.array([timeline.silence_start_s, timeline.silence_end_s])[..., None, None]
    inside_s = edges_s + p.silence_offset_s - time  # (2, S, F, P)
    inside_s[1] *= -1.0  # speech follows this edge
    # before and after all speech, one of the two is infinite and only the other remains
    right, left = log_silence(inside_s, p.silence_log_alpha, p.silence_theta, c)
    silent = log_pause(right, left, edges_s[1] - edges_s[0])
    weights = np.concatenate([spoken, silent])
    return _close_lips(parameters, sequence, tau, weights) if sequence.closing else weights


def _close_lips(
    parameters: VisemeParameters, sequence: SequenceParameters, tau: Doubles, weights: Doubles
) -> Doubles:
    """Apply the closure rule (Wang & Cai 2003, eq. 7) to closing visemes."""
    closed = weights
    for row, faps in sequence.closing:
        near = np.flatnonzero((np.abs(tau[row][:, faps]) < parameters.closure_reach_s).any(axis=1))
        if not near.size:
            continue
        if closed is weights:
            closed = weights.copy()
        selected = np.ix_(near, faps)
        others = np.delete(weights, row, axis=0)[:, near[:, None], faps]
        log_others = np.logaddexp.reduce(others, axis=0, initial=-np.inf)
        closed[row][selected] = log_closure(
            weights[row][selected],
            np.maximum(log_others, weights[row][selected] - 50.0),
            tau[row][selected],
            parameters.closure_reach_s,
            parameters.closure_ratio,
        )
    return closed


def blend(
    parameters: VisemeParameters,
    timeline: Timeline,
    time_s: Doubles,
    sequence: SequenceParameters | None = None,
) -> Doubles:
    """Return the mouth FAPs (num_times, num_mouth_faps) of a timeline at times (num_times,).

    ``sequence`` is ``build_sequence_parameters`` of the timeline, if known.
    With all visemes this is Wang & Cai 2003, eq. 6; with the pair around a time, Li 2011, eq. 11.
    """
    if not len(timeline.viseme) + len(timeline.silence_start_s):
        return np.tile(parameters.neutral, (len(time_s), 1))
    sequence = sequence or build_sequence_parameters(parameters, timeline)
    weights = softmax(log_weights(parameters, sequence, timeline, time_s))  # (E + S, F, P)
    weights *= sequence.target[:, None]
    curves: Doubles = np.add.reduce(weights)  # Wang & Cai 2003, eq. 6
    return curves


def active_visemes(timeline: Timeline, time_s: float, reach_s: float) -> Mask:
    """Return a mask of the visemes that act at a time: the pair around it, and within ``reach_s``.

    With ``reach_s`` 0 this is the pair of Li 2011, eq. 11, from apex to apex. A longer reach is
    closer to the full model.
    """
    active = (timeline.apex_start_s < time_s + reach_s) & (timeline.apex_end_s > time_s - reach_s)
    following = int(timeline.apex_start_s.searchsorted(time_s, side="right"))
    active[max(following - 1, 0) : following + 1] = True
    return active


def states_at(
    parameters: VisemeParameters,
    timeline: Timeline,
    times_s: Sequence[float],
    sequence: SequenceParameters,
) -> list[FapState]:
    """Return position and velocity of the mouth FAPs at media times; parameters as in `blend`."""
    times = np.array(times_s)[:, None] + np.array([-_STEP_S, 0.0, _STEP_S])
    curves = blend(parameters, timeline, times.reshape(-1), sequence)
    return [
        FapState(here, (after - before) / (2.0 * _STEP_S))
        for before, here, after in curves.reshape(*times.shape, -1)
    ]
