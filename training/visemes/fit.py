"""Fits the dynamic visemes' parameters to tracked lips by least squares.

Source: Wang & Cai 2003, section 4. Two stages of gradient descent minimize the squared error
between the model's curves and the measured curves: first the vowels, with the silences and the
exponent, then the consonants with those fixed. The stages are repeated.

======  =============================================  =========  ================
symbol  name                                           unit       shape
======  =============================================  =========  ================
F       measured FAP of a frame                        FAP units  (num_frames,)
w       weight of a viseme or silence in a frame       1          (num_frames, near)
T       static target                                  FAP units  (num_visemes,)
tau     apex minus time                                s          (num_frames, near)
======  =============================================  =========  ================

Deviations from the paper:

- The speech consists of words and sentences instead of single finals and syllables. A stage
  therefore changes only its own visemes.
- Each FAP is fitted separately. Ridge regularization keeps parameters with little data close to
  their initial values.
- The closure rule is not fitted, nor the lips of labials, which are closed by definition, nor the
  tongue, which is not visible.
- Least squares flattens motion that the model does not explain. The fitted targets are therefore
  scaled to the measured extent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.optimize import minimize

from kouxing.corpora.lip_clips import LipClip
from kouxing.services.recognizer.lips.lip_predictor import OTHER_SIDE
from kouxing.services.synthesizer.lips.dynamic_visemes.blending import softmax
from kouxing.services.synthesizer.lips.dynamic_visemes.dominance import log_pause, log_silence
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import (
    CONSONANTS,
    initial_parameters,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    VisemeParameters,
    fap_columns,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline, build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import (
    CLOSURE_FAPS,
    REST,
    TRAINED_VISEMES,
    VISEME_INDEX,
    VISEMES,
)
from kouxing.shared import fast_record
from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import LIP_HEIGHT_FAPS, MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

_NEAR = 8  # visemes of a frame that can have weight
_FAR_S = 60.0  # a viseme this far away has no weight


@dataclass(frozen=True, slots=True)
class FrameTable:
    """Frames of all clips, with the nearest visemes and silences of each."""

    viseme: NDArray[np.intp]  # (num_frames, near)
    before_s: Doubles  # (num_frames, near) start of the apex minus time
    after_s: Doubles  # (num_frames, near) its end minus time
    silence_start_s: Doubles  # (num_frames, 2) minus time
    silence_end_s: Doubles  # (num_frames, 2) minus time
    faps: Doubles  # (num_frames, num_mouth_faps)


def collect_frames(
    clips: Sequence[LipClip], labels: Sequence[list[Phone]], inventory: PhoneInventory
) -> FrameTable:
    """Find the nearest visemes and silences of each frame; UserError if no clip contains speech."""
    parts = []
    for clip, phones in zip(clips, labels, strict=True):
        timeline = _padded(build_timeline(phones, inventory))
        if not len(timeline.silence_start_s):
            continue
        time = clip.time_s[:, None]

        def nearest(
            starts: Doubles, ends: Doubles, count: int, time: Doubles = time
        ) -> NDArray[np.intp]:
            distance = np.maximum(np.maximum(starts - time, time - ends), 0.0)
            return np.argsort(distance, axis=1, kind="stable")[:, :count]

        near = nearest(timeline.apex_start_s, timeline.apex_end_s, _NEAR)
        quiet = nearest(timeline.silence_start_s, timeline.silence_end_s, 2)
        parts.append(
            (
                timeline.viseme[near],
                timeline.apex_start_s[near] - time,
                timeline.apex_end_s[near] - time,
                timeline.silence_start_s[quiet] - time,
                timeline.silence_end_s[quiet] - time,
                clip.faps,
            )
        )
    if not parts:
        raise UserError("the training clips contain no speech")
    return FrameTable(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _padded(timeline: Timeline) -> Timeline:
    """Add distant visemes, so that even a short clip has ``_NEAR`` of them."""
    far_s = np.full(max(_NEAR - len(timeline.viseme), 0), np.append(timeline.apex_end_s, 0.0).max())
    far_s += _FAR_S
    return fast_record.replace(
        timeline,
        viseme=np.append(timeline.viseme, np.full(len(far_s), VISEME_INDEX[REST])),
        apex_start_s=np.append(timeline.apex_start_s, far_s),
        apex_end_s=np.append(timeline.apex_end_s, far_s),
    )


_RIDGE = 10.0  # weight of the initial values, frames; adjacent frames are not independent
_SPREAD = {"alpha": 0.7, "theta": 0.5, "offset": 0.04, "target": 1.0}
# largest distance from the initial values, in spreads
_ALPHA_RANGE, _THETA_RANGE, _OFFSET_RANGE = 4.0, 2.0, 2.0
_MAX_GAIN = 2.0
_EXPONENTS = (1.3, 1.5, 1.8)  # lower exponents give visible corners at the apexes
_ROUNDS = 2
_SILENCE_STEP = 1e-4  # step of the finite differences, in spreads
_UNKNOWNS = ("alpha", "theta_minus", "theta_plus", "offset_s", "target")
_SILENCE_UNKNOWNS = ("theta_left", "theta_right", "offset_left_s", "offset_right_s")


class _FapFit:
    """The fit of one FAP: unknowns of all visemes (5, num_visemes) and of the silences (4,).

    Decays and dominances are logarithms, so that they stay positive.
    """

    def __init__(self, start: VisemeParameters, frames: FrameTable, column: int) -> None:
        known = ~np.isnan(frames.faps[:, column])
        self.c = start.c
        self._viseme = frames.viseme[known]
        self._before, self._after = frames.before_s[known], frames.after_s[known]
        self._silence = frames.silence_start_s[known], frames.silence_end_s[known]
        self._measured = frames.faps[known, column]
        self._scale = max(float(np.std(self._measured)), 1.0)
        spread = [_SPREAD["alpha"], _SPREAD["theta"], _SPREAD["theta"], _SPREAD["offset"]]
        self._spread = np.array([*spread, _SPREAD["target"] * self._scale])[:, None]
        self._silence_spread = np.array([spread[1], spread[1], spread[3], spread[3]])
        self._start = np.array(
            [
                np.log(start.alpha[:, column]),
                np.log(start.theta_minus[:, column]),
                np.log(start.theta_plus[:, column]),
                start.offset_s[:, column],
                start.target[:, column],
            ]
        )
        self._silence_start = np.array(
            [
                np.log(start.theta_left[column]),
                np.log(start.theta_right[column]),
                start.offset_left_s[column],
                start.offset_right_s[column],
            ]
        )
        self.visemes, self.silences = self._start.copy(), self._silence_start.copy()
        # Closed lips and lip to teeth are defined, and so is their timing.
        self.fixed = np.zeros(len(VISEMES), dtype=bool)
        labials = [*CLOSURE_FAPS] if MOUTH_FAPS[column] in LIP_HEIGHT_FAPS else []
        self.fixed[[VISEME_INDEX[viseme] for viseme in [REST, *labials]]] = True
        self.fixed[len(TRAINED_VISEMES) :] = True
        # The initial shapes are from another speaker, so they are scaled to this one.
        curve = self.curve()[0]
        gain = max(float(curve @ self._measured) / max(float(curve @ curve), 1e-9), 0.0)
        self._start[4, ~self.fixed] *= gain
        self.visemes[4, ~self.fixed] *= gain

    def curve(self) -> tuple[Doubles, Doubles]:
        """Return modeled and measured values of all frames."""
        silent = self._log_silences(self.silences)
        return self._blend(self.visemes, silent)[0], self._measured

    def descend(self, rows: NDArray[np.intp], with_silences: bool) -> float:
        """Minimize the loss over the unknowns of some visemes and of the silences; return it."""
        num = 5 * len(rows)

        def unpack(z: Doubles) -> tuple[Doubles, Doubles]:
            visemes, silences = self.visemes.copy(), self.silences.copy()
            visemes[:, rows] = self._start[:, rows] + self._spread * z[:num].reshape(5, -1)
            if with_silences:
                silences = self._silence_start + self._silence_spread * z[num:]
            return visemes, silences

        def loss(z: Doubles) -> tuple[float, Doubles]:
            visemes, silences = unpack(z)
            silent = self._log_silences(silences)
            curve, slopes = self._blend(visemes, silent)
            error = (curve - self._measured) / self._scale
            gradient = np.zeros_like(z)
            for unknown, slope in enumerate(slopes):
                part = 2.0 * error[:, None] / self._scale * slope
                summed = np.bincount(
                    self._viseme.ravel(), weights=part.ravel(), minlength=len(VISEMES)
                )
                gradient[:num].reshape(5, -1)[unknown] = summed[rows]
            gradient[:num] *= np.broadcast_to(self._spread, (5, len(rows))).ravel()
            for unknown in range(len(silences) if with_silences else 0):
                moved = silences.copy()
                moved[unknown] += _SILENCE_STEP * self._silence_spread[unknown]
                moved_curve = self._blend(visemes, self._log_silences(moved))[0]
                gradient[num + unknown] = (
                    np.sum(2.0 * error * (moved_curve - curve)) / self._scale / _SILENCE_STEP
                )
            gradient += 2.0 * _RIDGE * z
            return float(error @ error + _RIDGE * (z @ z)), gradient

        z = ((self.visemes - self._start) / self._spread)[:, rows].ravel()
        bounds = [
            *[(-_ALPHA_RANGE, _ALPHA_RANGE)] * len(rows),
            *[(-_THETA_RANGE, _THETA_RANGE)] * (2 * len(rows)),
            *[
                (0.0, 0.0) if fixed else (-_OFFSET_RANGE, _OFFSET_RANGE)
                for fixed in self.fixed[rows]
            ],
            *[(0.0, 0.0) if fixed else (None, None) for fixed in self.fixed[rows]],
        ]
        if with_silences:
            z = np.append(z, (self.silences - self._silence_start) / self._silence_spread)
            bounds += [(-2.0, 2.0)] * len(self.silences)
        result = minimize(loss, z, jac=True, method="L-BFGS-B", bounds=bounds)
        self.visemes, self.silences = unpack(result.x)
        return float(result.fun)

    def _log_silences(self, silences: Doubles) -> Doubles:
        """Compute the log weights of the silences, (num_frames, 2)."""
        theta_left, theta_right = np.exp(silences[:2])
        start, end = self._silence
        return log_pause(
            log_silence(start + silences[3], 0.0, theta_right, self.c),
            log_silence(-(end + silences[2]), 0.0, theta_left, self.c),
            end - start,
        )

    def _blend(self, visemes: Doubles, silent: Doubles) -> tuple[Doubles, list[Doubles]]:
        """Compute the curve, (num_frames,), and its five slopes, (num_frames, near)."""
        viseme, c = self._viseme, self.c
        log_alpha, log_minus, log_plus, offset, target = visemes[:, viseme]
        tau = np.maximum(self._before + offset, 0.0) + np.minimum(self._after + offset, 0.0)
        ahead = tau >= 0.0
        theta = np.exp(np.where(ahead, log_minus, log_plus))
        distance = np.abs(tau)
        decay = theta * distance**c
        weights = softmax(np.concatenate([log_alpha - decay, silent], axis=1).T).T
        weight = weights[:, : viseme.shape[1]]
        curve = np.sum(weight * target, axis=1)  # the silences' target is 0
        by_log = weight * (target - curve[:, None])
        by_theta = -by_log * decay
        by_offset = -by_log * theta * c * distance ** (c - 1.0) * np.sign(tau)
        return curve, [
            by_log,
            np.where(ahead, by_theta, 0.0),
            np.where(ahead, 0.0, by_theta),
            by_offset,
            weight,
        ]


_CONSONANT_ROWS = np.array(
    [row for viseme, row in VISEME_INDEX.items() if viseme.partition("_")[0] in CONSONANTS]
)
_VOWEL_ROWS = np.array(
    [
        row
        for row in VISEME_INDEX.values()
        if row not in _CONSONANT_ROWS and row != VISEME_INDEX[REST]
    ]
)


def fit_parameters(frames: FrameTable) -> VisemeParameters:
    """Fit all measured FAPs in the two stages of Wang & Cai 2003."""
    measured = [
        column
        for column, fap in enumerate(MOUTH_FAPS)
        if not np.isnan(frames.faps[:, column]).all() and fap not in OTHER_SIDE.values()
    ]
    informative = [column for column in fap_columns((3, 5, 6)) if column in measured]

    def first_stage_loss(c: float) -> float:
        start = initial_parameters(c)
        return sum(
            _FapFit(start, frames, column).descend(_VOWEL_ROWS, with_silences=True)
            for column in informative or measured[:1]
        )

    c = min(_EXPONENTS, key=first_stage_loss)
    start = initial_parameters(c)
    arrays = {name: getattr(start, name).copy() for name in (*_UNKNOWNS, *_SILENCE_UNKNOWNS)}
    for column in track(measured, description="FAPs"):
        fit = _FapFit(start, frames, column)
        for _ in range(_ROUNDS):
            fit.descend(_VOWEL_ROWS, with_silences=True)
            fit.descend(_CONSONANT_ROWS, with_silences=False)
        visemes, silences = fit.visemes.copy(), fit.silences.copy()
        # restore the extent that least squares flattens
        modeled, measured_fap = fit.curve()
        gain = min(max(float(np.std(measured_fap) / np.std(modeled)), 1.0), _MAX_GAIN)
        visemes[4, ~fit.fixed] *= gain
        visemes[:3], silences[:2] = np.exp(visemes[:3]), np.exp(silences[:2])
        fap = MOUTH_FAPS[column]
        sides = fap_columns((fap, OTHER_SIDE.get(fap, fap)))
        for name, values in zip(_UNKNOWNS, visemes, strict=True):
            arrays[name][:, sides] = values[:, None]
        for name, value in zip(_SILENCE_UNKNOWNS, silences, strict=True):
            arrays[name][sides] = value
    return replace(start, **arrays)
