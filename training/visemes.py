"""Learn the parameters of the dynamic visemes from real lips.

Source: Wang & Cai 2003, section 4: two stages of gradient descent on the squared error between the
model's curves and measured ones: first the finals, with the silences and the exponent, then the
initials with those fixed; over and over.

======  =============================================  =========  ================
symbol  name                                           unit       shape
======  =============================================  =========  ================
F       measured FAP of a frame                        FAP units  (num_frames,)
w       weight of a viseme or silence in a frame       1          (num_frames, near)
T       static target                                  FAP units  (num_visemes,)
tau     centre minus time                              s          (num_frames, near)
======  =============================================  =========  ================

Deviations: the speech is words and sentences, not single finals and syllables, so that a stage
moves only its own visemes while the others take part as they are; each FAP is fitted on its own; a
ridge holds what few frames tell about near the hand-set start. The closure rule stays out of the
fit, and so do the lips of labials, whose targets are closed by definition, and the tongue, which
nobody sees. Least squares flattens what it cannot foresee, so the targets are scaled to the
measured extent in the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.optimize import minimize

from services.recognizer.load import load_model
from services.synthesizer.blending import blend, softmax
from services.synthesizer.dominance import log_left_silence, log_pause, log_right_silence
from services.synthesizer.parameters import NUM_MOUTH_FAPS, VisemeParameters, save_parameters
from services.synthesizer.timeline import Timeline, build_timeline
from services.synthesizer.visemes import (
    CLOSURE_FAPS,
    LIP_HEIGHT_FAPS,
    MOUTH_FAPS,
    REST,
    VISEME_INDEX,
    VISEMES,
)
from shared.errors import UserError
from shared.phones import Phone
from training.lip_clips import (
    LEVEL_STEP_S,
    MIRROR,
    LipClip,
    label_clip,
    level_track,
    read_clips,
)
from training.viseme_start import INITIALS, columns, starting_parameters

Array = NDArray[np.float64]

_NEAR = 8  # visemes around a frame that can weigh anything
_FAR_S = 60.0  # where a viseme weighs nothing
_RIDGE = 10.0  # frames' worth of belief in the start: neighbouring frames tell the same
_SPREAD = {"alpha": 0.7, "theta": 0.5, "offset": 0.04, "target": 1.0}
# how far from the start, in spreads
_ALPHA_RANGE, _THETA_RANGE, _OFFSET_RANGE = 4.0, 2.0, 2.0
_LARGEST_GAIN = 2.0
_EXPONENTS = (1.3, 1.5, 1.8)  # below, the corners at centres begin to show
_ROUNDS = 2
_SILENCE_STEP = 1e-4  # of the finite differences, in units of the spread
_LEVEL_RIDGE = 3.0  # units' worth of belief in the start
_SPOKEN_DB = 25.0  # below the loudest: no speech
_CLOSURE_REACHES_S = (0.05, 0.06, 0.07, 0.08, 0.1)  # any shorter would hardly be seen
_CLOSURE_WINDOW_S, _CLOSURE_NEIGHBOURS_S = 0.12, 1.0

_SOURCE = "start and tongue: targets of Crystal.TTVS (Tsinghua University), Apache-2.0"
_UNKNOWNS = ("alpha", "theta_minus", "theta_plus", "offset_s", "target")
_SILENCE_UNKNOWNS = ("theta_left", "theta_right", "offset_left_s", "offset_right_s")


@dataclass(frozen=True, slots=True)
class Frames:
    """Frames of all clips, with the visemes and silences near each."""

    viseme: NDArray[np.intp]  # (num_frames, near)
    before_s: Array  # (num_frames, near) start of the centre interval minus time
    after_s: Array  # (num_frames, near) its end minus time
    silence_start_s: Array  # (num_frames, 2) minus time
    silence_end_s: Array  # (num_frames, 2) minus time
    faps: Array  # (num_frames, num_mouth_faps)


def frames_of(clips: Sequence[LipClip], labels: Sequence[list[Phone]]) -> Frames:
    """Find what is near each frame; the rest of the model has no weight there.

    Raises
    ------
    UserError
        In no clip anything is said.
    """
    parts = []
    for clip, phones in zip(clips, labels, strict=True):
        timeline = _filled_up(build_timeline(phones))
        if not len(timeline.silence_start_s):
            continue
        time = clip.time_s[:, None]

        def nearest(starts: Array, ends: Array, count: int, time: Array = time) -> NDArray[np.intp]:
            distance = np.maximum(np.maximum(starts - time, time - ends), 0.0)
            return np.argsort(distance, axis=1, kind="stable")[:, :count]

        near = nearest(timeline.centre_start_s, timeline.centre_end_s, _NEAR)
        quiet = nearest(timeline.silence_start_s, timeline.silence_end_s, 2)
        parts.append(
            (
                timeline.viseme[near],
                timeline.centre_start_s[near] - time,
                timeline.centre_end_s[near] - time,
                timeline.silence_start_s[quiet] - time,
                timeline.silence_end_s[quiet] - time,
                clip.faps,
            )
        )
    if not parts:
        raise UserError("no speech was heard in the clips for training; give clips with speech")
    return Frames(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _filled_up(timeline: Timeline) -> Timeline:
    """Add visemes far away, so that a frame of a short clip has ``_NEAR`` of them too."""
    far_s = np.full(
        max(_NEAR - len(timeline.viseme), 0), np.append(timeline.centre_end_s, 0.0).max()
    )
    far_s += _FAR_S
    return replace(
        timeline,
        viseme=np.append(timeline.viseme, np.full(len(far_s), VISEME_INDEX[REST])),
        centre_start_s=np.append(timeline.centre_start_s, far_s),
        centre_end_s=np.append(timeline.centre_end_s, far_s),
    )


class _FapFit:
    """The fit of one FAP: unknowns of all visemes (5, num_visemes) and of the silences (4,).

    Decays and dominances are logarithms, so that they stay positive.
    """

    def __init__(self, start: VisemeParameters, frames: Frames, column: int) -> None:
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
        # Closed lips, and lip to teeth, are what they are, and all at the same time.
        self.fixed = np.zeros(len(VISEMES), dtype=bool)
        labials = [*CLOSURE_FAPS] if MOUTH_FAPS[column] in LIP_HEIGHT_FAPS else []
        self.fixed[[VISEME_INDEX[viseme] for viseme in [REST, *labials]]] = True
        # The start's shapes are another speaker's: as large as this one's, to begin with.
        curve = self.curve()[0]
        gain = max(float(curve @ self._measured) / max(float(curve @ curve), 1e-9), 0.0)
        self._start[4, ~self.fixed] *= gain
        self.visemes[4, ~self.fixed] *= gain

    def curve(self) -> tuple[Array, Array]:
        """Modelled and measured values of all frames."""
        silent = self._log_silences(self.silences)
        return self._blend(self.visemes, silent)[0], self._measured

    def descend(self, rows: NDArray[np.intp], with_silences: bool) -> float:
        """Move the unknowns of some visemes, and of the silences; return the loss."""
        num = 5 * len(rows)

        def place(z: Array) -> tuple[Array, Array]:
            visemes, silences = self.visemes.copy(), self.silences.copy()
            visemes[:, rows] = self._start[:, rows] + self._spread * z[:num].reshape(5, -1)
            if with_silences:
                silences = self._silence_start + self._silence_spread * z[num:]
            return visemes, silences

        def loss(z: Array) -> tuple[float, Array]:
            visemes, silences = place(z)
            silent = self._log_silences(silences)
            curve, slopes = self._blend(visemes, silent)
            error = (curve - self._measured) / self._scale
            gradient = np.zeros_like(z)
            for unknown, slope in enumerate(slopes):
                share = 2.0 * error[:, None] / self._scale * slope
                summed = np.bincount(
                    self._viseme.ravel(), weights=share.ravel(), minlength=len(VISEMES)
                )
                gradient[:num].reshape(5, -1)[unknown] = summed[rows]
            gradient[:num] *= np.broadcast_to(self._spread, (5, len(rows))).ravel()
            for unknown in range(len(silences) if with_silences else 0):
                moved = silences.copy()
                moved[unknown] += _SILENCE_STEP * self._silence_spread[unknown]
                beside = self._blend(visemes, self._log_silences(moved))[0]
                gradient[num + unknown] = (
                    np.sum(2.0 * error * (beside - curve)) / self._scale / _SILENCE_STEP
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
        found = minimize(loss, z, jac=True, method="L-BFGS-B", bounds=bounds)
        self.visemes, self.silences = place(found.x)
        return float(found.fun)

    def _log_silences(self, silences: Array) -> Array:
        """Log weights of the silences, (num_frames, 2)."""
        theta_left, theta_right = np.exp(silences[:2])
        start, end = self._silence
        one = np.ones(1)
        return log_pause(
            log_right_silence(start + silences[3], one, theta_right, self.c),
            log_left_silence(end + silences[2], one, theta_left, self.c),
            end - start,
        )

    def _blend(self, visemes: Array, silent: Array) -> tuple[Array, list[Array]]:
        """Model's curve (num_frames,) and its slopes by the five unknowns, (num_frames, near)."""
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


_INITIAL_ROWS = np.array(
    [row for viseme, row in VISEME_INDEX.items() if viseme.partition("_")[0] in INITIALS]
)
_FINAL_ROWS = np.array(
    [row for row in VISEME_INDEX.values() if row not in _INITIAL_ROWS and row != VISEME_INDEX[REST]]
)


def estimate(frames: Frames) -> VisemeParameters:
    """Fit all FAPs that were measured, in the two stages of Wang & Cai 2003."""
    measured = [
        column
        for column in range(NUM_MOUTH_FAPS)
        if not np.isnan(frames.faps[:, column]).all() and MOUTH_FAPS[column] not in MIRROR
    ]

    telling = [column for column in columns((3, 5, 6)) if column in measured] or measured[:1]

    def first_stage_loss(c: float) -> float:
        start = starting_parameters(c)
        return sum(
            _FapFit(start, frames, column).descend(_FINAL_ROWS, with_silences=True)
            for column in telling
        )

    c = min(_EXPONENTS, key=first_stage_loss)
    start = starting_parameters(c)
    arrays = {name: getattr(start, name).copy() for name in (*_UNKNOWNS, *_SILENCE_UNKNOWNS)}
    for column in track(measured, description="FAPs"):
        fit = _FapFit(start, frames, column)
        for _ in range(_ROUNDS):
            fit.descend(_FINAL_ROWS, with_silences=True)
            fit.descend(_INITIAL_ROWS, with_silences=False)
        visemes, silences = fit.visemes.copy(), fit.silences.copy()
        # Least squares flattens what it cannot foresee: give the motion its measured extent.
        modelled, seen = fit.curve()
        gain = min(max(float(np.std(seen) / np.std(modelled)), 1.0), _LARGEST_GAIN)
        visemes[4, ~fit.fixed] *= gain
        visemes[:3], silences[:2] = np.exp(visemes[:3]), np.exp(silences[:2])
        sides = [column] + [
            MOUTH_FAPS.index(right) for right, left in MIRROR.items() if left == MOUTH_FAPS[column]
        ]
        for name, values in zip(_UNKNOWNS, visemes, strict=True):
            arrays[name][:, sides] = values[:, None]
        for name, value in zip(_SILENCE_UNKNOWNS, silences, strict=True):
            arrays[name][sides] = value
    return replace(start, **arrays)


def usual_levels(clips: Sequence[LipClip], labels: Sequence[list[Phone]]) -> Array:
    """Level of each viseme beside its speaker's mean while speaking, dB, (num_visemes,)."""
    start = starting_parameters().level_db
    total, count = _LEVEL_RIDGE * start, np.full(len(VISEMES), _LEVEL_RIDGE)
    for clip, phones in zip(clips, labels, strict=True):
        time_s, level = np.array(level_track(clip.samples)).T
        timeline = build_timeline(phones)
        spoken_db = level[level > np.percentile(level, 95.0) - _SPOKEN_DB]
        for viseme, start_s, end_s in zip(
            timeline.viseme, timeline.centre_start_s, timeline.centre_end_s, strict=True
        ):
            inside = (time_s > start_s - LEVEL_STEP_S) & (time_s < end_s + LEVEL_STEP_S)
            if inside.any():
                quieter_db = float(np.mean(level[inside] - spoken_db.mean()))
                if quieter_db > -_SPOKEN_DB:  # else it was a pause
                    total[viseme] += quieter_db
                    count[viseme] += 1.0
    levels: Array = total / count
    return levels


def closure_reach(
    parameters: VisemeParameters, clips: Sequence[LipClip], labels: Sequence[list[Phone]]
) -> float:
    """T of the closure rule that fits the lips around b p m best, seconds.

    C is not to be learnt: any value above 20 shuts the lips, and more does not show.
    """
    lips = columns((4, 5))

    def loss(reach_s: float) -> float:
        error = 0.0
        for clip, phones in zip(clips, labels, strict=True):
            timeline = build_timeline(phones)
            rows = np.flatnonzero(timeline.viseme == VISEME_INDEX["b"])
            for row in rows:
                centre_s = timeline.centre_start_s[row]
                frames = np.flatnonzero(np.abs(clip.time_s - centre_s) < _CLOSURE_WINDOW_S)
                near = np.abs(timeline.centre_start_s - centre_s) < _CLOSURE_NEIGHBOURS_S
                curve = blend(
                    replace(parameters, closure_reach_s=reach_s),
                    timeline.select(near),
                    clip.time_s[frames],
                )
                error += float(np.nansum((curve[:, lips] - clip.faps[frames][:, lips]) ** 2))
        return error

    return min(_CLOSURE_REACHES_S, key=loss)


def train(folder: Path, output: Path, *, any_licence: bool = False) -> None:
    """Learn viseme parameters from the clips of ``folder`` that are for training.

    Raises
    ------
    UserError
        No clip may be used, or the file cannot be written.
    """
    clips = read_clips(folder, any_licence=any_licence)
    used = [clip for clip in clips if clip.part == "train"]
    if not used:
        raise UserError(
            f"no clip in {folder} may be used; give clips with a free licence, or --any-licence"
        )
    model = load_model()
    labels = [label_clip(model, clip) for clip in used]
    parameters = estimate(frames_of(used, labels))
    parameters = replace(parameters, level_db=usual_levels(used, labels))
    parameters = replace(parameters, closure_reach_s=closure_reach(parameters, used, labels))
    licences = "; ".join(sorted({clip.licence for clip in used}))
    try:
        save_parameters(
            parameters,
            output,
            f"{_SOURCE}; the rest learnt from clips under: {licences}",
            learnt_from=[clip.name for clip in used],
            chosen_with=[clip.name for clip in clips if clip.part == "choice"],
        )
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}") from None
