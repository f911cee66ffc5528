"""A speaker's voice from filmed speech: an affine map of the FAPs, and a ridge regression.

Source: Hoerl and Kennard 1970, "Ridge regression: biased estimation for nonorthogonal problems".

======== ============================================================ ===================
symbol   meaning                                                      shape
======== ============================================================ ===================
y        FAPs that the model makes                                    (n, delays, 15)
t        tracked FAPs                                                 (n, delays, 15)
P        inner values [h, u] of the model                             (n, 2 units)
s, b     scale and offset of each FAP, s shrunk to 1                  (15,)
r        residual, shrunk to 0                                        (2 units, delays, 15)
k        strength of the ridge, positions                             1
v        mean variance of the inner values                            1
======== ============================================================ ===================

    r = (P' P + k v I)^-1 P' (t - s y - b)        P and the errors about their means

The less the material tells, the stronger the ridge: k is chosen by the errors on parts of the
material left out; without an end to it there is the affine map alone. A camera may deliver its
pictures late: each recording of some length is moved to where its lips follow the model best.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lip_positions import POSITION_S, lip_positions
from kouxing.services.recognizer.lip_source import delay_for
from kouxing.services.recognizer.lip_tracks import measures_of, values_at
from kouxing.services.recognizer.lips import LIP_FAPS, LipPredictor
from kouxing.services.recognizer.voice import Voice
from kouxing.shared.errors import UserError

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

STRENGTHS = (30.0, 100.0, 300.0, 1000.0, 3000.0, np.inf)  # of the ridge, positions
FACE_DELAY_S = 0.06  # of the face for which the gain is measured
MIN_SPEECH_S = 10.0

_NUM_FAPS = len(LIP_FAPS)
_BLOCK = 250  # positions that are left out together
_MAX_FOLDS = 5
_SCALE_SHRINKAGE = 250.0  # positions that tell a scale of 1
_HELD_BACK = 0.25  # of the material, its end
_LAGS_S = np.arange(-20, 21) / 100  # of a camera
_MIN_LAG_CORRELATION = 0.3  # below it a camera's lag cannot be told


@dataclass(frozen=True, slots=True, kw_only=True)
class FilmedSpeech:
    """A recording of somebody who speaks."""

    samples: Floats  # 16 kHz mono
    frame_s: Array  # (frames,) times of the pictures in the sound
    lips: Array  # (frames, 15) FAP units, NaN where not tracked


@dataclass(frozen=True, slots=True, kw_only=True)
class Material:
    """Positions of speech, with what the model makes and what the speaker's lips do."""

    known_s: Array  # (n,)
    made: Floats  # (n, delays, 15)
    inner: Floats  # (n, 2 units)
    tracked: Array  # (n, delays, 15), NaN where unknown

    def __len__(self) -> int:
        return len(self.known_s)

    def __getitem__(self, rows: slice | NDArray[np.bool_]) -> Self:
        return type(self)(
            known_s=self.known_s[rows],
            made=self.made[rows],
            inner=self.inner[rows],
            tracked=self.tracked[rows],
        )

    @classmethod
    def join(cls, parts: Sequence[Material]) -> Self:
        """Return all positions of some materials, one after the other."""
        return cls(
            known_s=np.concatenate([part.known_s for part in parts]),
            made=np.concatenate([part.made for part in parts]),
            inner=np.concatenate([part.inner for part in parts]),
            tracked=np.concatenate([part.tracked for part in parts]),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class VoiceGain:
    """What a voice is worth, on material that it has not learnt from."""

    speech_s: float
    delay_s: float
    before: Array  # (3,) correlations of ``MEASURES``, NaN where one does not move
    after: Array  # (3,)
    time_s: Array  # (n,)
    curves: Array  # (3, 3, n): measure; tracked, before, after


def material_of(model: NeuralModel, lips: LipPredictor, filmed: FilmedSpeech) -> Material:
    """Return the positions of a recording; none without speech."""
    (positions,) = lip_positions(model, [filmed.samples])
    stream = lips.stream(lips.delays_s)
    made = np.zeros((len(positions.known_s), len(lips.delays_s), _NUM_FAPS), np.float32)
    inner = np.zeros((len(made), len(stream.inner)), np.float32)
    starts = {*positions.starts}
    for position, features in enumerate(positions.features):
        if position in starts:
            stream.reset()
        made[position] = stream.step(features.astype(np.float32))[:, :_NUM_FAPS]
        inner[position] = stream.inner
    known_s = np.array(positions.known_s)
    time_s = known_s[:, None] - np.array(lips.delays_s)
    frame_s = filmed.frame_s - _lag_s(filmed, time_s[:, -1], made[:, -1])
    tracked = np.stack([values_at(frame_s, track, time_s) for track in filmed.lips.T], axis=-1)
    return Material(known_s=known_s, made=made, inner=inner, tracked=tracked)


def _lag_s(filmed: FilmedSpeech, time_s: Array, made: Floats) -> float:
    """By how much the pictures come later than the sound; 0 where too little tells it."""
    if len(time_s) * POSITION_S < MIN_SPEECH_S:
        return 0.0
    opening, opening_made = (measures_of(lips)[:, :1] for lips in (filmed.lips, made))
    figures = np.zeros(len(_LAGS_S))
    for index, lag_s in enumerate(_LAGS_S):
        tracked = values_at(filmed.frame_s, opening[:, 0], time_s + lag_s)
        figures[index] = _correlations([(opening_made, tracked[:, None])])[0]
    figures = np.nan_to_num(figures)
    return float(_LAGS_S[figures.argmax()]) if figures.max() > _MIN_LAG_CORRELATION else 0.0


def learn_voice(material: Material) -> Voice:
    """Learn a voice from material; its amount decides how much may change.

    Raises
    ------
    UserError
        If there is too little speech with tracked lips.
    """
    usable = material[_is_known(material)]
    speech_s = len(usable) * POSITION_S
    if speech_s < MIN_SPEECH_S:
        raise UserError(
            f"there are {speech_s:.0f} s of speech with lips in view; film "
            f"{MIN_SPEECH_S:.0f} s or more, better a minute"
        )
    block = np.arange(len(usable)) // _BLOCK
    fold = block % min(_MAX_FOLDS, block[-1] + 1)
    errors = [
        sum(
            _error(_fit(usable[fold != each], strength), usable[fold == each])
            for each in range(fold.max() + 1)
        )
        for strength in STRENGTHS
    ]
    return _fit(usable, STRENGTHS[int(np.argmin(errors))])


def measure_gain(lips: LipPredictor, material: Material) -> VoiceGain:
    """Learn from all but the last quarter; measure there.

    Raises
    ------
    UserError
        As ``learn_voice``.
    """
    first_kept = round((1 - _HELD_BACK) * len(material))
    voice = learn_voice(material[:first_kept])
    kept = material[first_kept:]
    delay_s = delay_for(lips.delays_s, FACE_DELAY_S)
    delay = lips.delays_s.index(delay_s)
    shown = [each[:, delay] for each in (kept.tracked, kept.made, with_voice(voice, kept))]
    curves = np.stack([measures_of(each) for each in shown], axis=1)  # (n, 3, measure)
    return VoiceGain(
        speech_s=len(kept) * POSITION_S,
        delay_s=delay_s,
        before=correlations([kept], [kept.made], delay),
        after=correlations([kept], [with_voice(voice, kept)], delay),
        time_s=kept.known_s - delay_s,
        curves=curves.transpose(2, 1, 0),
    )


def with_voice(voice: Voice, material: Material) -> Floats:
    """Return the FAPs that the model makes with a voice, (n, delays, 15)."""
    made: Floats = voice.scale * material.made + voice.offset
    return made + np.tensordot(material.inner, voice.residual, axes=1)


def correlations(parts: Sequence[Material], made: Sequence[Floats], delay: int) -> Array:
    """Return the correlations of ``MEASURES`` over some materials, each one's means removed.

    Parameters
    ----------
    parts
        The materials.
    made
        FAPs for each, (n, delays, 15).
    delay
        Which of the delays.
    """
    return _correlations(
        [
            (measures_of(faps[:, delay]), measures_of(part.tracked[:, delay]))
            for part, faps in zip(parts, made, strict=True)
        ]
    )


def _correlations(pairs: Sequence[tuple[Array, Array]]) -> Array:
    """Correlate made and tracked curves, (n, curves) each; NaN where one does not move."""
    figures = []
    for measure in range(pairs[0][0].shape[1]):
        sums = np.zeros((2, 2))
        for pair in pairs:
            both = np.stack([each[:, measure] for each in pair])
            both = both[:, ~np.isnan(both).any(axis=0)]
            if both.size:
                centred = both - both.mean(axis=1, keepdims=True)
                sums += centred @ centred.T
        size = np.sqrt(sums[0, 0] * sums[1, 1])
        figures.append(sums[0, 1] / size if size > 0 else np.nan)
    return np.array(figures)


def _tracked_faps(material: Material) -> NDArray[np.bool_]:
    return np.logical_not(np.isnan(material.tracked).all(axis=(0, 1)))


def _is_known(material: Material) -> NDArray[np.bool_]:
    """Which positions have all FAPs that are tracked anywhere, for all delays."""
    unknown = np.isnan(material.tracked[..., _tracked_faps(material)])
    known: NDArray[np.bool_] = ~unknown.any(axis=(1, 2)) & (unknown.shape[2] > 0)
    return known


def _fit(material: Material, strength: float) -> Voice:
    """Fit a voice to positions that are known."""
    faps = _tracked_faps(material)
    made, tracked = material.made[..., faps].astype(np.float64), material.tracked[..., faps]
    made_mean, tracked_mean = made.mean(axis=(0, 1)), tracked.mean(axis=(0, 1))
    variance = ((made - made_mean) ** 2).mean(axis=(0, 1))
    covariance = ((made - made_mean) * (tracked - tracked_mean)).mean(axis=(0, 1))
    prior = _SCALE_SHRINKAGE / len(material) * variance
    scale = (covariance + prior) / np.maximum(variance + prior, 1e-9)
    offset = tracked_mean - scale * made_mean
    voice = Voice(
        scale=np.ones(_NUM_FAPS, np.float32),
        offset=np.zeros(_NUM_FAPS, np.float32),
        residual=np.zeros((material.inner.shape[1], *material.made.shape[1:]), np.float32),
    )
    if np.isfinite(strength):
        mean = material.inner.mean(axis=0, dtype=np.float64)
        centred = material.inner - mean
        products = centred.T @ centred
        ridge = strength * np.trace(products) / (len(material) * len(products))
        errors = tracked - scale * made - offset
        fitted = np.linalg.solve(
            products + ridge * np.eye(len(products)), centred.T @ errors.reshape(len(errors), -1)
        ).reshape(-1, *errors.shape[1:])
        voice.residual[..., faps] = fitted
        offset = offset - np.tensordot(mean, fitted, axes=1).mean(axis=0)
    voice.scale[faps], voice.offset[faps] = scale, offset
    return voice


def _error(voice: Voice, material: Material) -> float:
    """Return the mean squared error, each FAP in units of its extent."""
    faps = _tracked_faps(material)
    tracked = material.tracked[..., faps]
    squares = (with_voice(voice, material)[..., faps] - tracked) ** 2
    return float((squares / np.maximum(tracked.var(axis=(0, 1)), 1e-9)).mean()) * len(material)
