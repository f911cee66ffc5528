"""Gaussian mixture acoustic model: log-likelihoods of HMM states.

Source: Li et al. 2011, section 3.1 (one mixture per state, diagonal covariances); the density is
the HTK book's eq. 7.2 (Young et al. 2009).

======== ========================================= =====================
symbol   meaning                                   shape
======== ========================================= =====================
x        normalized, rotated feature frame         (39,)
A        rotation that decorrelates (STC)          (39, 39)
w        mixture weights                           (states, mixtures)
means    component means                           (states, mixtures, 39)
covars   component variances                       (states, mixtures, 39)
======== ========================================= =====================

log b(x) = logsumexp_m [ log w_m - 1/2 sum_k (log 2 pi covars_mk + (x_k - means_mk)^2 / covars_mk) ]

computed as a product of [x^2, x, 1] with a precomputed matrix. All states share one rotation
(Gales 1999, "Semi-tied covariance matrices").

Vocal-tract-length normalization raises the formants of low voices
(:mod:`kouxing.services.recognizer.front_end.vtln`). The front end measures the pitch of every
frame. The stream gets only speech frames, so only their pitch counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import cast

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    AcousticStream,
    ScoreRequest,
)
from kouxing.services.recognizer.acoustic.model_file import Archive, parse_topology
from kouxing.services.recognizer.front_end.features import (
    NUM_FEATURES,
    NUM_STATIC,
    DeltaFeatures,
    RunningMean,
    compute_cepstra,
)
from kouxing.services.recognizer.front_end.vtln import PitchedLogMel, VocalTractNormalizer
from kouxing.shared.arrays import Floats

FORMAT = "gmm 3"
_MAX_MIXTURES = 1024
_MAX_HALF_WIDTH = 4  # limit for the half width of the deltas, feature frames

_MIN_LOG_WEIGHT = -1e30  # log weight of an absent component; finite, so that no NaN arises


@dataclass(frozen=True, slots=True, kw_only=True)
class GaussianMixtures:
    """The densities of all states."""

    weights: Floats  # (states, mixtures), rows sum to 1
    means: Floats  # (states, mixtures, 39)
    covars: Floats  # (states, mixtures, 39)

    def score_matrix(self) -> Floats:
        """Return the matrix from [x^2, x, 1] to log densities, (79, states * mixtures)."""
        num_states, num_mixtures, num_features = self.means.shape
        covars = self.covars.astype(np.float64)
        means = self.means.astype(np.float64)
        with np.errstate(divide="ignore"):
            log_weights = np.maximum(np.log(self.weights.astype(np.float64)), _MIN_LOG_WEIGHT)
        constant = log_weights - 0.5 * (np.log(2 * np.pi * covars) + means**2 / covars).sum(-1)
        matrix = np.concatenate([-0.5 / covars, means / covars, constant[..., None]], axis=-1)
        shape = (num_states * num_mixtures, 2 * num_features + 1)
        return np.ascontiguousarray(matrix.reshape(shape).T, dtype=np.float32)


def mixture_scores(frames: Floats, matrix: Floats, num_mixtures: int) -> Floats:
    """Compute the log densities of the states, (n, 39) to (n, states).

    ``matrix`` comes from :meth:`GaussianMixtures.score_matrix`.
    """
    ones = np.ones((len(frames), 1), dtype=np.float32)
    components = np.concatenate([frames * frames, frames, ones], axis=1) @ matrix
    components = components.reshape(len(frames), -1, num_mixtures)
    peak = components.max(axis=2)
    components -= peak[..., None]
    np.exp(components, out=components)
    log_density: Floats = peak + np.log(components.sum(axis=2))
    return log_density


@dataclass(frozen=True, kw_only=True)
class GmmModel(AcousticModel):
    """A Gaussian mixture HMM with its front end."""

    mixtures: GaussianMixtures
    rotation: Floats  # (39, 39)
    prior_mean: Floats  # (13,) cepstral mean of the training corpus
    half_width: int  # half of the window of the deltas, frames
    acoustic_scale: float = 1.0  # weight of the log scores: neighboring frames are correlated

    @cached_property
    def matrix(self) -> Floats:
        """Matrix of the component densities, computed once for all streams."""
        return self.mixtures.score_matrix()

    def create_front_end(self) -> PitchedLogMel:
        """Create the front end of one session."""
        return PitchedLogMel()

    def create_stream(self) -> GmmStream:
        """Create the stream of one speaker; it has no encoder frames."""
        return GmmStream(self)

    def score(self, requests: Sequence[ScoreRequest]) -> list[Floats]:
        """Score the frames of several streams, one stream at a time."""
        return [cast(GmmStream, stream).score_frames(frames) for stream, frames in requests]


class GmmStream(AcousticStream):
    """Scores of one speaker's speech, segment by segment."""

    model: GmmModel

    def __init__(self, model: GmmModel) -> None:
        super().__init__(model)
        self._vtln = VocalTractNormalizer()
        self._mean = RunningMean(model.prior_mean)
        self._deltas = DeltaFeatures(model.half_width)
        self.look_ahead_frames = self._deltas.look_ahead_frames

    def score_frames(self, frames: Floats | None) -> Floats:
        """Score log-mel frames with their pitch, (n, 43); None ends the segment.

        The next segment continues with the speaker's mean and pitch.
        """
        if frames is None:
            features = self._deltas.finish()
            self._deltas = DeltaFeatures(self.model.half_width)
        else:
            log_mel = self._vtln.warp(frames[:, :-2], frames[:, -2], frames[:, -1])
            features = self._deltas.append(compute_cepstra(log_mel))
        normalized = self._mean.normalize(features)
        scores = np.empty((len(features), self.model.topology.num_states), dtype=np.float32)
        num_mixtures = self.model.mixtures.weights.shape[1]
        for row in range(len(features)):  # row by row: a product's rounding depends on its height
            frame = normalized[row : row + 1] @ self.model.rotation
            scores[row] = mixture_scores(frame, self.model.matrix, num_mixtures)[0]
        return scores * np.float32(self.model.acoustic_scale)

    def reset(self) -> None:
        """Reset the state of the segment and the speaker."""
        self._deltas = DeltaFeatures(self.model.half_width)
        self._vtln.reset()
        self._mean.reset()


def parse_gmm_model(archive: Archive) -> GmmModel:
    """Build the model after checking every size; raises ``ValueError`` if an array does not fit."""
    topology = parse_topology(archive)
    num_mixtures = archive.array("weights", None).shape[-1]
    if not 1 <= num_mixtures <= _MAX_MIXTURES:
        raise ValueError(f"it has {num_mixtures} mixture components")
    half_width = int(archive.array("half_width", ()))
    if not 1 <= half_width <= _MAX_HALF_WIDTH:
        raise ValueError(f"the half width of its deltas is {half_width}")
    shape = (topology.num_states, num_mixtures)
    mixtures = GaussianMixtures(
        weights=archive.floats("weights", *shape),
        means=archive.floats("means", *shape, NUM_FEATURES),
        covars=archive.floats("covars", *shape, NUM_FEATURES),
    )
    if (mixtures.covars <= 0).any() or (mixtures.weights < 0).any():
        raise ValueError("weights or variances are negative")
    return GmmModel(
        topology=topology,
        mixtures=mixtures,
        rotation=archive.floats("rotation", NUM_FEATURES, NUM_FEATURES),
        prior_mean=archive.floats("prior_mean", NUM_STATIC),
        half_width=half_width,
        acoustic_scale=float(archive.floats("acoustic_scale")),
    )
