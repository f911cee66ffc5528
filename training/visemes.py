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

A folder of lips holds for each clip ``<clip>.flac``, ``<clip>.csv`` (a row for each video frame
with ``t`` in seconds) and ``<clip>.json`` (licence, speaker, transcript). Columns are FAPs of a
tracked video (``F5_raise_b_midlip``) or weights of FACEGOOD's face rig (``mouth_stretch_c``).
``held.txt`` names clips and speakers that are for scoring only.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track
from scipy.optimize import minimize

from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.load import load_model
from services.recognizer.pipeline import recognize
from services.synthesizer.blending import softmax
from services.synthesizer.dominance import log_left_silence, log_pause, log_right_silence
from services.synthesizer.parameters import NUM_MOUTH_FAPS, VisemeParameters, save_parameters
from services.synthesizer.timeline import build_timeline
from services.synthesizer.visemes import (
    CLOSURE_FAPS,
    LIP_HEIGHT_FAPS,
    MOUTH_FAPS,
    REST,
    ROUNDED_SHAPES,
    VISEME_INDEX,
    VISEMES,
    static_targets,
)
from shared.errors import UserError
from shared.phones import Phone
from training.align import align_text
from training.corpus import may_ship
from training.feature_cache import read_audio

Array = NDArray[np.float64]

# --- the start, set by hand ----------------------------------------------------------------------

_JAW_FAPS = (3, 14)
_ROUNDING_FAPS = (6, 7, 16, 17, 53, 54)  # mouth width and protrusion
_TONGUE_FAPS = (44, 45, 46, 47)

# Dominance of initials over lip height, jaw and rounding, and their decay. What the ear needs
# stays (teeth shut for sibilants, lips shut for labials); the rest gives way to the vowel, the
# more the further back the tongue works.
_INITIALS = {
    "b": (3.0, 1.2, 0.4, 55.0),
    "f": (2.0, 1.2, 0.6, 55.0),
    "d": (0.6, 0.8, 0.3, 55.0),
    "l": (0.5, 0.6, 0.3, 55.0),
    "g": (0.35, 0.4, 0.25, 50.0),
    "j": (0.8, 1.0, 0.5, 50.0),
    "zh": (1.0, 1.3, 0.7, 50.0),
    "z": (1.0, 1.3, 0.6, 50.0),
}
_FINAL_THETA = 42.0
_ROUNDED_ALPHA = 2.0
_ROUNDED_THETA_MINUS = 28.0  # lips round early
_SILENCE_THETA = 40.0
_SILENCE_OFFSET_S = 0.12  # the mouth opens before the voice and closes after it
_START_C = 1.3
_USUAL_DISTANCE_S = 0.115  # between centres: where decays of different exponents are compared


def _columns(faps: Sequence[int]) -> NDArray[np.intp]:
    return np.array([MOUTH_FAPS.index(fap) for fap in faps], dtype=np.intp)


def starting_parameters(c: float = _START_C) -> VisemeParameters:
    """Parameters set by hand, from which the estimation starts."""
    shape = (len(VISEMES), NUM_MOUTH_FAPS)
    decay = _USUAL_DISTANCE_S ** (_START_C - c)  # the same at the usual distance
    alpha, closes = np.ones(shape), np.zeros(shape)
    theta_minus, theta_plus = np.full(shape, _FINAL_THETA), np.full(shape, _FINAL_THETA)
    for viseme, row in VISEME_INDEX.items():
        group, _, variant = viseme.partition("_")
        if group in _INITIALS:
            lips, jaw, rounding, theta = _INITIALS[group]
            alpha[row] = lips
            alpha[row, _columns(_JAW_FAPS)] = jaw
            alpha[row, _columns(_ROUNDING_FAPS)] = 2.0 * rounding if variant else rounding
            alpha[row, _columns(_TONGUE_FAPS)] = 1.5
            theta_minus[row] = theta_plus[row] = theta
        elif viseme in ROUNDED_SHAPES:
            alpha[row, _columns(_ROUNDING_FAPS)] = _ROUNDED_ALPHA
            theta_minus[row, _columns(_ROUNDING_FAPS)] = _ROUNDED_THETA_MINUS
        closes[row, _columns(CLOSURE_FAPS.get(viseme, ()))] = 1.0
    targets = static_targets()
    per_fap = np.ones(NUM_MOUTH_FAPS)
    return VisemeParameters(
        alpha=alpha,
        theta_minus=theta_minus * decay,
        theta_plus=theta_plus * decay,
        offset_s=np.zeros(shape),
        target=targets,
        closes=closes,
        alpha_left=per_fap,
        alpha_right=per_fap,
        theta_left=_SILENCE_THETA * decay * per_fap,
        theta_right=_SILENCE_THETA * decay * per_fap,
        offset_left_s=-_SILENCE_OFFSET_S * per_fap,
        offset_right_s=_SILENCE_OFFSET_S * per_fap,
        neutral=targets[VISEME_INDEX[REST]],
        c=c,
        closure_ratio=1000.0,
        closure_reach_s=0.07,
    )


# --- clips of lips -------------------------------------------------------------------------------

# What a weight of 1 of FACEGOOD's rig does to these FAPs, for the ARKit shape of the same name on
# MakeHuman's face (CC0); left and right of a pair together. The rig's jaw goes further than a
# speaker's: scaled so that its continuous clip opens as far as filmed speakers do; so do its
# pursed lips: scaled to half a centimetre. Pursing draws real lips nearly together, which those
# shapes do not: their lip heights are set by the filmed speakers' u. The jaw's swing backwards is
# left to the head's own jaw.
_RIG_FAPS = (3, 4, 5, 6, 8, 10, 12, 16, 17, 51, 52, 53, 55, 57, 59)
_JAW_SCALE = 0.6
_DEPTH_SCALE = 0.6
_DEPTH_FAPS = (16, 17)
_RIG_DELAY_S = 0.03  # of its lips against the sound, beside filmed speakers'
_RIG = {
    "mouth_stretch_c": [
        _JAW_SCALE * value
        for value in (1021, -47, -1995, -41, 153, -1649, -739, 0, 0, 129, -1884, -50, 276, -1438,
                      -716)
    ],
    "mouth_lowerLipDepress": [-58, 0, -222, 3, 0, -264, -53, 70, 0, 0, -188, 3, 0, -206, -23],
    "mouth_upperLipRaise": [0, -294, 0, -9, -311, 12, 76, 0, 24, -222, 0, -9, -270, 18, 82],
    "mouth_press": [24, -46, 188, 146, -141, 158, 270, 0, 24, 24, 246, 135, -35, 258, 288],
    "mouth_suck_d": [-65, 0, 188, 2, 0, 59, -41, -270, 0, 0, 317, -2, 0, 153, 0],
    "mouth_suck_u": [0, 70, 0, 9, 29, 0, 35, 0, -563, 434, 0, 2, 311, 0, 6],
    "mouth_pucker": [0, 60, 250, -130, 40, 190, 6, 511, 481, -106, 200, -125, -94, 140, -18],
    "mouth_funnel": [0, -100, -250, -70, 40, -100, -18, 293, 581, -150, -100, -86, -12, 20, 0],
    "mouth_oo_c": [0, 60, 250, -140, 40, 190, 6, 511, 481, -106, 200, -135, -94, 140, -18],
    "mouth_oh_c": [0, 60, 250, -130, 40, 190, 0, 450, 500, -100, 200, -120, -70, 140, -14],
    "mouth_lipStretch": [0, 12, -46, 121, 65, -77, -147, 0, 36, 46, -24, 121, 94, -41, -158],
    "mouth_lipCornerPull": [0, -188, 352, 169, -311, 393, 739, 24, 24, -130, 410, 168, -229, 511,
                            768],
    "mouth_dimple": [0, -46, 18, 118, -94, 71, 164, 12, 12, 24, 70, 121, -41, 135, 176],
    "mouth_chinRaise_u": [6, 0, 293, -2, 0, 170, 35, 246, 0, 0, 311, -2, 0, 164, 18],
}  # fmt: skip
_MIRROR = {
    7: 6, 9: 8, 11: 10, 13: 12, 54: 53, 56: 55, 58: 57, 60: 59,
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class LipClip:
    """A recording with what its speaker's mouth did."""

    name: str
    speaker: str
    licence: str
    is_rig: bool  # weights of an animator's rig, not measured points
    is_held: bool  # kept for scoring
    transcript: str  # Chinese, empty where unknown
    time_s: Array  # (num_frames,)
    faps: Array  # (num_frames, num_mouth_faps), FAP units, nan where not measured
    samples: NDArray[np.float32]  # 16 kHz mono


def read_clips(folder: Path) -> list[LipClip]:
    """Read all Mandarin clips of a folder.

    Raises
    ------
    UserError
        The folder holds no clips, or one of them cannot be read.
    """
    held = folder / "held.txt"
    left_out = set(held.read_text(encoding="utf-8").split()) if held.is_file() else set()
    clips = []
    for path in sorted(folder.glob("*.json")):
        try:
            about = json.loads(path.read_text(encoding="utf-8"))
            is_held = path.stem in left_out or about["speaker"] in left_out
            if not str(about["language"]).startswith("zh"):
                continue
            with path.with_suffix(".csv").open(encoding="utf-8", newline="") as file:
                rows = list(csv.DictReader(file))
            columns = {
                name: np.array([float(row[name] or "nan") for row in rows]) for name in rows[0]
            }
            is_rig = "mouth_stretch_c" in columns
            clips.append(
                LipClip(
                    name=path.stem,
                    speaker=about["speaker"],
                    licence=about["licence"],
                    is_rig=is_rig,
                    is_held=is_held,
                    transcript=about.get("transcript") or "",
                    time_s=columns["t"] - (_RIG_DELAY_S if is_rig else 0.0),
                    faps=_rig_faps(columns) if is_rig else _tracked_faps(columns),
                    samples=read_audio(path.with_suffix(".flac")),
                )
            )
        except (OSError, ValueError, KeyError, IndexError) as error:
            raise UserError(f"cannot read the clip {path.stem}: {error!r}; remove it") from error
    if not clips:
        raise UserError(f"no Mandarin clips in {folder}; give a folder of .flac, .csv and .json")
    return clips


def _tracked_faps(columns: dict[str, Array]) -> Array:
    faps = np.full((len(columns["t"]), NUM_MOUTH_FAPS), np.nan)
    for name, values in columns.items():
        number = name[1:].partition("_")[0]
        if name.startswith("F") and number.isdigit() and int(number) in MOUTH_FAPS:
            faps[:, MOUTH_FAPS.index(int(number))] = values
    faps[columns.get("ok", np.ones(len(faps))) == 0.0] = np.nan
    return faps


def _rig_faps(columns: dict[str, Array]) -> Array:
    faps = np.full((len(columns["t"]), NUM_MOUTH_FAPS), np.nan)
    faps[:, _columns(_RIG_FAPS)] = 0.0
    for shape, effect in _RIG.items():
        # a side is named in up to three letters: mouth_suck_dl, mouth_press_l, mouth_funnel_dr
        sides = [
            values
            for name, values in columns.items()
            if name.startswith(shape) and len(name) - len(shape) <= 3
        ]
        weight = np.mean(np.stack(sides), axis=0)
        faps[:, _columns(_RIG_FAPS)] += weight[:, None] * np.array(effect, dtype=float)
    faps[:, _columns(_DEPTH_FAPS)] *= _DEPTH_SCALE
    for upper, lower in _columns((4, 5)), _columns((8, 10)):
        # inner lips that meet stop
        crossed = np.maximum(faps[:, upper] + faps[:, lower], 0.0)
        faps[:, upper] -= 0.5 * crossed
        faps[:, lower] -= 0.5 * crossed
    for right, left in _MIRROR.items():
        faps[:, MOUTH_FAPS.index(right)] = faps[:, MOUTH_FAPS.index(left)]
    return faps


def label_clip(model: AcousticModel, clip: LipClip) -> list[Phone]:
    """Units of a clip: aligned where its text is known, else recognised."""
    if clip.transcript:
        return align_text(model, clip.samples, 16_000, clip.transcript)
    return recognize(model, clip.samples, 16_000)


# --- fitting -------------------------------------------------------------------------------------

_NEAR = 8  # visemes around a frame that can weigh anything
_RIDGE = 30.0  # frames' worth of belief in the start: neighbouring frames tell the same
_SPREAD = {"alpha": 0.7, "theta": 0.5, "offset": 0.04, "target": 1.0}
# how far from the start, in spreads
_ALPHA_RANGE, _THETA_RANGE, _OFFSET_RANGE = 4.0, 2.0, 2.0
_LARGEST_GAIN = 2.0
_EXPONENTS = (1.3, 1.5, 1.8)  # below, the corners at centres begin to show
_ROUNDS = 2
_SILENCE_STEP = 1e-4  # of the finite differences, in units of the spread


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
    """Find what is near each frame; the rest of the model has no weight there."""
    parts = []
    for clip, phones in zip(clips, labels, strict=True):
        timeline = build_timeline(phones)
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
    return Frames(*(np.concatenate(column) for column in zip(*parts, strict=True)))


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
        # Closed lips, and lip to teeth, are what they are.
        self.fixed_target = np.zeros(len(VISEMES), dtype=bool)
        labials = [*CLOSURE_FAPS] if MOUTH_FAPS[column] in LIP_HEIGHT_FAPS else []
        self.fixed_target[[VISEME_INDEX[viseme] for viseme in [REST, *labials]]] = True
        # The start's shapes are another speaker's: as large as this one's, to begin with.
        curve = self.curve()[0]
        gain = max(float(curve @ self._measured) / max(float(curve @ curve), 1e-9), 0.0)
        self._start[4, ~self.fixed_target] *= gain
        self.visemes[4, ~self.fixed_target] *= gain

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
            *[(-_OFFSET_RANGE, _OFFSET_RANGE)] * len(rows),
            *[(0.0, 0.0) if fixed else (None, None) for fixed in self.fixed_target[rows]],
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
    [row for viseme, row in VISEME_INDEX.items() if viseme.partition("_")[0] in _INITIALS]
)
_FINAL_ROWS = np.array(
    [row for row in VISEME_INDEX.values() if row not in _INITIAL_ROWS and row != VISEME_INDEX[REST]]
)


def estimate(frames: Frames) -> VisemeParameters:
    """Fit all FAPs that were measured, in the two stages of Wang & Cai 2003."""
    measured = [
        column
        for column in range(NUM_MOUTH_FAPS)
        if not np.isnan(frames.faps[:, column]).all() and MOUTH_FAPS[column] not in _MIRROR
    ]

    def first_stage_loss(c: float) -> float:
        start = starting_parameters(c)
        return sum(
            _FapFit(start, frames, column).descend(_FINAL_ROWS, with_silences=True)
            for column in _columns((3, 5, 6))
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
        visemes[4, ~fit.fixed_target] *= gain
        visemes[:3], silences[:2] = np.exp(visemes[:3]), np.exp(silences[:2])
        columns = [column] + [
            MOUTH_FAPS.index(right) for right, left in _MIRROR.items() if left == MOUTH_FAPS[column]
        ]
        for name, values in zip(_UNKNOWNS, visemes, strict=True):
            arrays[name][:, columns] = values[:, None]
        for name, value in zip(_SILENCE_UNKNOWNS, silences, strict=True):
            arrays[name][columns] = value
    return replace(start, **arrays)


def train(folder: Path, output: Path) -> None:
    """Learn viseme parameters from the rig's clips of ``folder`` that may be used for a program.

    Filmed clips are left out: whose lips are measured at the points of another face, they are for
    scoring (``evaluation/lips.py``).

    Raises
    ------
    UserError
        No clip can be used.
    """
    clips = [
        clip
        for clip in read_clips(folder)
        if clip.is_rig and not clip.is_held and may_ship(clip.licence)
    ]
    if not clips:
        raise UserError(f"no clip in {folder} may be used; give clips with a free licence")
    model = load_model()
    parameters = estimate(frames_of(clips, [label_clip(model, clip) for clip in clips]))
    names = ", ".join(clip.name for clip in clips)
    save_parameters(parameters, output, f"{_SOURCE}; learned from {names} (FACEGOOD, MIT)")
