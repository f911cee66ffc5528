"""The linear part of the lip model.

It depends less on its few speakers than the recurrent part. Source: Hoerl and Kennard 1970, "Ridge
regression: biased estimation for nonorthogonal problems".

======== ============================================================ ==================
symbol   meaning                                                      shape
======== ============================================================ ==================
x        features of a position, standardized                         (features,)
y        tracked FAPs; each speaker's have mean 0 and variance 1      (delays, 15)
t        closure, 0 or 1                                              (delays,)
W, C     weights                                                      (features, ...)
======== ============================================================ ==================

    W minimizes  mean |y - W' x|^2 + 0.1 |W|^2          x less its mean over the speaker
    C minimizes  mean -log p(t | C' x + b) + 0.01 |C|^2
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import binary_cross_entropy_with_logits

from kouxing.services.recognizer.lips.lip_predictor import CLOSURE, NUM_LIP_FAPS
from kouxing.shared.arrays import Doubles, Floats, Mask
from kouxing.training.lips.positions import SpeechStretch, features_of

_RIDGE, _CLOSURE_RIDGE = 0.1, 0.01
_MIN_DEVIATION = 1e-2
_MIN_POSITIONS = 20  # minimum for a speaker
_MAX_ITERATIONS = 40


def fit_linear(
    speech: Sequence[SpeechStretch], targets: Sequence[Floats], counts: Sequence[float]
) -> tuple[Doubles, Doubles]:
    """Fit the linear part to stretches of speech, each of which counts ``counts`` times.

    ``targets`` are FAPs and probabilities, NaN if unknown, (positions, delays, 17). Returns weights
    of the features, (features, delays, 17), and the bias, (delays, 17): standardized FAPs and the
    log odds of a closure. Those of lip to teeth are 0.
    """
    features, known_targets = features_of(speech), np.concatenate(targets)
    mean, deviation = features.mean(axis=0), features.std(axis=0) + np.float32(_MIN_DEVIATION)
    standard = (features - mean) / deviation
    lengths = [len(stretch.known_s) for stretch in speech]
    count = np.repeat(np.array(counts, dtype=np.float32), lengths)
    speaker = np.repeat([stretch.clip.speaker for stretch in speech], lengths)
    weights = np.zeros((len(mean), *known_targets.shape[1:]))
    bias = np.zeros(known_targets.shape[1:])
    unknown = np.isnan(known_targets[..., :NUM_LIP_FAPS])
    known: Mask = np.logical_not(unknown.any(axis=1))  # (positions, 15)
    for columns in _equal_columns(known):
        rows = known[:, columns[0]]
        weights[..., columns] = _fit_faps(
            standard[rows], known_targets[rows][..., columns], count[rows], speaker[rows]
        )
    weights[..., CLOSURE], bias[:, CLOSURE] = _fit_closures(
        standard, known_targets[..., CLOSURE], count
    )
    weights /= deviation[:, None, None]
    return weights, bias - np.tensordot(mean, weights, axes=1)


def _equal_columns(known: Mask) -> list[list[int]]:
    """Group the FAPs that are known at the same positions."""
    groups: dict[bytes, list[int]] = {}
    for column in range(known.shape[1]):
        if known[:, column].any():
            groups.setdefault(known[:, column].tobytes(), []).append(column)
    return list(groups.values())


def _fit_faps(features: Floats, faps: Floats, count: Floats, speaker: NDArray[np.str_]) -> Doubles:
    """Return the weights of a ridge regression, (features, delays, FAPs)."""
    size = features.shape[1]
    squares, products, total = np.zeros((size, size)), np.zeros((size, faps[0].size)), 0.0
    for name in np.unique(speaker):
        rows = speaker == name
        if rows.sum() < _MIN_POSITIONS:
            continue
        centered = features[rows] - features[rows].mean(axis=0)
        speaker_faps = faps[rows] - faps[rows].mean(axis=(0, 1))
        speaker_faps /= np.maximum(speaker_faps.std(axis=(0, 1)), _MIN_DEVIATION)
        counted = centered * count[rows, None]
        squares += counted.T @ centered
        products += counted.T @ speaker_faps.reshape(len(speaker_faps), -1)
        total += float(count[rows].sum())
    ridge = _RIDGE * max(total, 1.0) * np.eye(size)
    weights = np.linalg.solve(squares + ridge, products).reshape(size, *faps.shape[1:])
    return np.asarray(weights, dtype=np.float64)


def _fit_closures(features: Floats, closure: Floats, count: Floats) -> tuple[Doubles, Doubles]:
    """Return weights and bias of a logistic regression, (features, delays), (delays,)."""
    torch.set_num_threads(1)
    known = ~np.isnan(closure)
    weight = torch.from_numpy(known * count[:, None] / max(float(count.mean()), 1e-9))
    inputs, known_targets = torch.from_numpy(features), torch.from_numpy(np.nan_to_num(closure))
    weights = torch.zeros(features.shape[1], closure.shape[1], requires_grad=True)
    bias = torch.zeros(closure.shape[1], requires_grad=True)
    optimizer = torch.optim.LBFGS(
        [weights, bias], max_iter=_MAX_ITERATIONS, line_search_fn="strong_wolfe"
    )

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        entropy = binary_cross_entropy_with_logits(
            inputs @ weights + bias, known_targets, reduction="none"
        )
        total = (weight * entropy).mean(dim=0).sum() + _CLOSURE_RIDGE * (weights**2).sum()
        total.backward()  # type: ignore[no-untyped-call]
        return total

    optimizer.step(loss)  # type: ignore[no-untyped-call]
    return weights.detach().double().numpy(), bias.detach().double().numpy()
