"""Decorrelate the features for diagonal covariances.

Source: Gales 1999, "Semi-tied covariance matrices for hidden Markov models", with one matrix for
all components.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures
from kouxing.services.recognizer.front_end.features import NUM_FEATURES
from kouxing.training.gmm.estimation import variance_floor
from kouxing.training.gmm.frames import FrameSet, Hmm


def decorrelate(
    frames: FrameSet, hmm: Hmm, num_iterations: int = 15
) -> tuple[Hmm, NDArray[np.float32]]:
    """Rotate the features, in place, so that diagonal covariances fit best (Gales 1999, eq. 20-24).

    Returns the rotated model and the rotation, (39, 39), for ``x @ rotation``.
    """
    scatter, counts = _component_covariances(frames, hmm)
    num = NUM_FEATURES
    if not counts.any():  # too little speech
        return hmm, np.eye(num, dtype=np.float32)
    flat = scatter.reshape(-1, num * num)
    transform = np.eye(num)  # rows a_i
    for _ in range(num_iterations):
        covars = np.einsum("ij,gjk,ik->gi", transform, scatter, transform, optimize=True)
        covars = np.maximum(covars, 1e-4)
        moments = ((counts[:, None] / covars).T @ flat).reshape(num, num, num)
        for row in range(num):
            cofactor = np.linalg.inv(transform)[:, row]  # up to the determinant, which cancels
            direction = np.linalg.solve(moments[row], cofactor)
            transform[row] = direction * np.sqrt(counts.sum() / (cofactor @ direction))
    rotation = transform.T.astype(np.float32)
    frames.features = frames.features @ rotation
    floor = variance_floor(frames)
    covars = np.einsum("ij,gjk,ik->gi", transform, scatter, transform, optimize=True)
    shape = hmm.mixtures.covars.shape
    mixtures = GaussianMixtures(
        weights=hmm.mixtures.weights,
        means=(hmm.mixtures.means @ rotation).astype(np.float32),
        covars=np.maximum(covars, floor).reshape(shape).astype(np.float32),
    )
    return replace(hmm, mixtures=mixtures), rotation


def _component_covariances(
    frames: FrameSet, hmm: Hmm
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the covariance, (components, 39, 39), and weight, (components,), of components."""
    mixtures = hmm.mixtures
    num_states, num_mixtures, num = mixtures.means.shape
    matrix = mixtures.score_matrix().reshape(2 * num + 1, num_states, num_mixtures)
    scatter = np.tile(np.eye(num), (num_states * num_mixtures, 1, 1))
    counts = np.zeros(num_states * num_mixtures)
    for state, numbers in enumerate(frames.by_state(num_states)):
        if len(numbers) == 0:
            continue
        x = frames.features[numbers]
        design = np.concatenate([x * x, x, np.ones((len(x), 1), np.float32)], axis=1)
        nearest = (design @ matrix[:, state]).argmax(axis=1)
        for component in range(num_mixtures):
            members = nearest == component
            count = float(frames.weights[numbers][members].sum())
            if members.sum() < 2 * num:
                continue
            at = state * num_mixtures + component
            centered = (x[members] - mixtures.means[state, component]).astype(np.float64)
            scatter[at] = (
                (centered * frames.weights[numbers][members][:, None]).T @ centered / count
            )
            counts[at] = count
    return scatter, counts
