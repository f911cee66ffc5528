"""Fits a mouth profile to filmed speech: an affine map of the FAPs and a ridge regression.

Source: Hoerl and Kennard 1970, "Ridge regression: biased estimation for nonorthogonal problems".

======== ============================================================ ===================
symbol   meaning                                                      shape
======== ============================================================ ===================
y        FAPs that the lip model predicts                             (n, delays, 15)
t        tracked FAPs                                                 (n, delays, 15)
P        hidden values [h, u] of the lip model                        (n, 2 units)
s, b     scale and offset of each FAP, s shrunk toward 1              (15,)
r        residual, shrunk toward 0                                    (2 units, delays, 15)
k        strength of the ridge, encoder frames                        1
v        mean variance of the hidden values                           1
======== ============================================================ ===================

    r = (P' P + k v I)^-1 P' (t - s y - b)        P and the errors about their means

Cross-validation chooses k, so little speech gives a strong ridge. An infinite k leaves only the
affine map. Some cameras deliver their images late. Each recording of sufficient length is
therefore shifted to the best correlation of tracked and predicted lips.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from kouxing.services.mouth_profiles.lip_inputs import ENCODER_FRAME_S, record_lip_inputs
from kouxing.services.mouth_profiles.lip_tracks import (
    MEASURES,
    correlate_curves,
    interpolate_track,
    lip_measures,
)
from kouxing.services.recognizer.lips.lip_prediction import choose_delay
from kouxing.services.recognizer.lips.lip_predictor import (
    NUM_LIP_FAPS,
    GruLipPredictor,
    load_lip_predictor,
)
from kouxing.services.recognizer.lips.mouth_profile import MouthProfile
from kouxing.shared.arrays import Doubles, Floats, Mask
from kouxing.shared.errors import UserError

STRENGTHS = (30.0, 100.0, 300.0, 1000.0, 3000.0, np.inf)  # ridge strengths to try, encoder frames
FACE_DELAY_S = 0.06  # delay of the face for which the gain is measured
MIN_SPEECH_S = 10.0

_BLOCK = 250  # adjacent encoder frames that stay in one fold
_MAX_FOLDS = 5
_SCALE_SHRINKAGE = 250.0  # weight of a scale of 1, encoder frames
_HELD_OUT = 0.25  # fraction at the end of the speech
_LAGS_S = np.arange(-20, 21) / 100  # possible lags of a camera
_MIN_LAG_CORRELATION = 0.3  # below this correlation, the lag of a camera is not estimated


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmedSpeech:
    """A recording of a speaker with tracked lips."""

    samples: Floats  # 16 kHz mono
    frame_s: Doubles  # (frames,) times of the images in the audio
    lip_track: Doubles  # (frames, 15) FAP units, NaN where not tracked


@dataclass(frozen=True, slots=True, kw_only=True)
class Observations:
    """Predicted and tracked lips at the encoder frames of speech."""

    known_s: Doubles  # (n,)
    predicted: Floats  # (n, delays, 15)
    hidden: Floats  # (n, 2 units)
    tracked: Doubles  # (n, delays, 15), NaN where unknown

    def __len__(self) -> int:
        return len(self.known_s)

    def __getitem__(self, rows: slice | Mask) -> Self:
        return type(self)(**{name: values[rows] for name, values in self._arrays().items()})

    def _arrays(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def join(cls, parts: Sequence[Observations]) -> Self:
        """Concatenate observations."""
        arrays = [part._arrays() for part in parts]
        return cls(**{name: np.concatenate([part[name] for part in arrays]) for name in arrays[0]})


@dataclass(frozen=True, slots=True, kw_only=True)
class ProfileGain:
    """Improvement by a profile on held-out speech."""

    speech_s: float
    delay_s: float
    before: Doubles  # (3,) correlation for each of ``MEASURES``; NaN without movement
    after: Doubles  # (3,)
    time_s: Doubles  # (n,)
    curves: Doubles  # (3, 3, n): measure; tracked, before, after


def observe(lip_predictor: GruLipPredictor, filmed: FilmedSpeech) -> Observations:
    """Run the lip predictor over a recording. The result is empty if there is no speech."""
    inputs = record_lip_inputs(filmed.samples)
    stream = lip_predictor.create_stream(lip_predictor.delays_s)
    predicted = np.zeros(
        (len(inputs.known_s), len(lip_predictor.delays_s), NUM_LIP_FAPS), np.float32
    )
    hidden = np.zeros((len(predicted), len(stream.inner)), np.float32)
    starts = {*inputs.starts}
    for number, features in enumerate(inputs.features):
        if number in starts:
            stream.reset()
        predicted[number] = stream.step(features.astype(np.float32))[:, :NUM_LIP_FAPS]
        hidden[number] = stream.inner
    known_s = np.array(inputs.known_s)
    time_s = known_s[:, None] - np.array(lip_predictor.delays_s)
    frame_s = filmed.frame_s - _camera_lag_s(filmed, time_s[:, -1], predicted[:, -1])
    tracks = [interpolate_track(frame_s, track, time_s) for track in filmed.lip_track.T]
    return Observations(
        known_s=known_s, predicted=predicted, hidden=hidden, tracked=np.stack(tracks, axis=-1)
    )


def _camera_lag_s(filmed: FilmedSpeech, time_s: Doubles, predicted: Floats) -> float:
    """Estimate how much later than the audio the images arrive; 0 if there is too little speech."""
    if len(time_s) * ENCODER_FRAME_S < MIN_SPEECH_S:
        return 0.0
    tracked, opening = (lip_measures(track)[:, :1] for track in (filmed.lip_track, predicted))
    figures = np.zeros(len(_LAGS_S))
    for index, lag_s in enumerate(_LAGS_S):
        shifted = interpolate_track(filmed.frame_s, tracked[:, 0], time_s + lag_s)
        figures[index] = correlate_curves([(opening, shifted[:, None])])[0]
    figures = np.nan_to_num(figures)
    return float(_LAGS_S[figures.argmax()]) if figures.max() > _MIN_LAG_CORRELATION else 0.0


def fit_profile(observations: Observations, fraction: float = 1.0) -> MouthProfile:
    """Fit a profile; cross-validation chooses the strength of the ridge.

    Raises ``UserError`` if there is too little speech with tracked lips: less than a ``fraction``
    of the minimum.
    """
    usable = observations[_is_known(observations)]
    speech_s = len(usable) * ENCODER_FRAME_S
    if speech_s < fraction * MIN_SPEECH_S:
        raise UserError(
            f"only {speech_s:.0f} s of speech show the lips; film "
            f"{MIN_SPEECH_S:.0f} s or more, preferably a minute"
        )
    block = np.arange(len(usable)) // _BLOCK
    fold_of = block % min(_MAX_FOLDS, block[-1] + 1)
    errors = [
        sum(
            _error(_fit(usable[fold_of != fold], strength), usable[fold_of == fold])
            for fold in range(fold_of.max() + 1)
        )
        for strength in STRENGTHS
    ]
    return _fit(usable, STRENGTHS[int(np.argmin(errors))])


def measure_gain(lip_predictor: GruLipPredictor, observations: Observations) -> ProfileGain:
    """Fit a profile to the first three quarters of the tracked speech, and measure it on the rest.

    Raises like ``fit_profile``.
    """
    num_known = np.cumsum(_is_known(observations))
    num_learned = round((1 - _HELD_OUT) * num_known[-1]) if len(num_known) else 0
    first_held_out = int(np.searchsorted(num_known, num_learned, side="right"))
    profile = fit_profile(observations[:first_held_out], 1 - _HELD_OUT)
    held_out = observations[first_held_out:]
    delay_s = choose_delay(lip_predictor.delays_s, FACE_DELAY_S)
    delay = lip_predictor.delays_s.index(delay_s)
    versions = (held_out.tracked, held_out.predicted, apply_profile(profile, held_out))
    tracked, before, after = (lip_measures(faps[:, delay]) for faps in versions)
    return ProfileGain(
        speech_s=_tracked_speech_s(held_out),
        delay_s=delay_s,
        before=correlate_curves([(before, tracked)]),
        after=correlate_curves([(after, tracked)]),
        time_s=held_out.known_s - delay_s,
        curves=np.stack([tracked, before, after]).transpose(2, 0, 1),
    )


def apply_profile(profile: MouthProfile, observations: Observations) -> Floats:
    """Predict the FAPs with a profile, (n, delays, 15)."""
    scaled: Floats = profile.scale * observations.predicted + profile.offset
    return scaled + np.tensordot(observations.hidden, profile.residual, axes=1)


def _is_tracked(observations: Observations) -> Mask:
    """Mask of the FAPs that are tracked anywhere, (15,)."""
    return np.logical_not(np.isnan(observations.tracked).all(axis=(0, 1)))


def _is_known(observations: Observations) -> Mask:
    """Mask of the encoder frames where these FAPs are known for all delays, (n,)."""
    unknown = np.isnan(observations.tracked[..., _is_tracked(observations)])
    known: Mask = ~unknown.any(axis=(1, 2)) & (unknown.shape[2] > 0)
    return known


def _tracked_speech_s(observations: Observations) -> float:
    """Return the duration of the speech with tracked lips."""
    return int(_is_known(observations).sum()) * ENCODER_FRAME_S


def _fit(observations: Observations, strength: float) -> MouthProfile:
    faps = _is_tracked(observations)
    predicted = observations.predicted[..., faps].astype(np.float64)
    tracked = observations.tracked[..., faps]
    predicted_mean, tracked_mean = predicted.mean(axis=(0, 1)), tracked.mean(axis=(0, 1))
    deviations = predicted - predicted_mean
    variance = (deviations**2).mean(axis=(0, 1))
    covariance = (deviations * (tracked - tracked_mean)).mean(axis=(0, 1))
    prior = _SCALE_SHRINKAGE / len(observations) * variance
    scale = (covariance + prior) / np.maximum(variance + prior, 1e-9)
    offset = tracked_mean - scale * predicted_mean
    num_hidden, num_delays = observations.hidden.shape[1], observations.predicted.shape[1]
    profile = MouthProfile(
        scale=np.ones(NUM_LIP_FAPS, np.float32),
        offset=np.zeros(NUM_LIP_FAPS, np.float32),
        residual=np.zeros((num_hidden, num_delays, NUM_LIP_FAPS), np.float32),
    )
    if np.isfinite(strength):
        mean = observations.hidden.mean(axis=0, dtype=np.float64)
        centered = observations.hidden - mean
        products = centered.T @ centered
        ridge = strength * np.trace(products) / (len(observations) * len(products))
        errors = tracked - scale * predicted - offset
        fitted = np.linalg.solve(
            products + ridge * np.eye(len(products)), centered.T @ errors.reshape(len(errors), -1)
        ).reshape(-1, *errors.shape[1:])
        profile.residual[..., faps] = fitted
        offset = offset - np.tensordot(mean, fitted, axes=1).mean(axis=0)
    profile.scale[faps], profile.offset[faps] = scale, offset
    return profile


def _error(profile: MouthProfile, observations: Observations) -> float:
    faps = _is_tracked(observations)
    tracked = observations.tracked[..., faps]
    squares = (apply_profile(profile, observations)[..., faps] - tracked) ** 2
    relative = squares / np.maximum(tracked.var(axis=(0, 1)), 1e-9)
    return float(relative.mean()) * len(observations)


@dataclass(frozen=True, slots=True, kw_only=True)
class LearnedProfile:
    """A mouth profile and its measured gain."""

    content: bytes
    speech_s: float  # duration of the speech with tracked lips
    gain: ProfileGain  # gain of a profile that was learned from the first three quarters

    def figures(self) -> dict[str, object]:
        """Return the figures that ``kouxing adapt --json`` writes, see ``docs/my_mouth.md``."""
        gain = self.gain
        curves = {
            measure: dict(zip(("tracked", "before", "after"), map(_to_json, curve), strict=True))
            for measure, curve in zip(MEASURES, gain.curves, strict=True)
        }
        return {
            "speech_s": self.speech_s,
            "held_out_s": gain.speech_s,
            "delay_ms": 1e3 * gain.delay_s,
            "before": dict(zip(MEASURES, _to_json(gain.before), strict=True)),
            "after": dict(zip(MEASURES, _to_json(gain.after), strict=True)),
            "curves": {"time_s": _to_json(gain.time_s), **curves},
        }


def learn_mouth_profile(recordings: Sequence[FilmedSpeech]) -> LearnedProfile:
    """Learn a mouth profile; raises ``UserError`` if too little speech shows the lips."""
    lip_predictor = load_lip_predictor()
    observations = Observations.join([observe(lip_predictor, filmed) for filmed in recordings])
    return LearnedProfile(
        content=fit_profile(observations).to_bytes(lip_predictor.digest),
        speech_s=_tracked_speech_s(observations),
        gain=measure_gain(lip_predictor, observations),
    )


def _to_json(values: Doubles) -> list[float | None]:
    """Convert numbers to JSON values; NaN becomes None."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in values]
