"""How well the visemes fit lips that they were not trained on.

Source: Wang & Cai 2003, section 4. Their figure 4 shows measured and modeled curves of a single
final and of a sentence. Here the full model runs over the phones of each clip. The phones are
aligned if the text is known, and recognized otherwise. The model runs with the learnt parameters
and with the initial ones, which were set by hand. Each frame counts for the nearest viseme. The
level of the voice is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track

from kouxing.corpora.figures import new_figure
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, label_clip
from kouxing.evaluation.lips.full_model import synthesize
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import CURVES, real_faps
from kouxing.evaluation.lips.references import clips_to_score
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST, VISEMES
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.shared.terminal import print_table

Array = NDArray[np.float64]

_SENTENCE_S = 6.0
_LONG_VOWEL_S, _CONTEXT_S = 0.2, 0.4


@dataclass(slots=True, kw_only=True)
class VisemeError:
    """RMS error over the frames of a viseme, FAP units."""

    viseme: str
    measure: str
    num_frames: int
    extent: float  # standard deviation of the measured values in these frames
    learnt: float
    guessed: float  # with the initial parameters


@dataclass(frozen=True, slots=True)
class FittedClip:
    """A clip with its phones and modeled curves, at the clip's frames."""

    clip: LipClip
    phones: list[Phone]
    inventory: PhoneInventory
    learnt: Array  # (num_frames, 68)
    guessed: Array  # (num_frames, 68)

    def curves(self, measure: str) -> tuple[Array, Array, Array]:
        """Return measured, learnt and guessed values, (num_frames,), without the clip's means."""
        real = CURVES[measure](real_faps(self.clip))
        is_known = ~np.isnan(real)
        learnt, guessed = CURVES[measure](self.learnt), CURVES[measure](self.guessed)
        if is_known.any():
            real, learnt, guessed = (v - v[is_known].mean() for v in (real, learnt, guessed))
        return real, learnt, guessed


def fit_folder(folder: Path, parameters: Path | None) -> list[FittedClip]:
    """Model all clips of a folder that the parameters were not trained on."""
    model = load_model()
    learnt, guessed = (
        DynamicVisemes(values, model.inventory)
        for values in (load_parameters(parameters), initial_parameters())
    )
    clips = clips_to_score(folder, [parameters], language=model.inventory.code)
    return [
        fit_clip(clip, label_clip(model, clip), learnt, guessed)
        for clip in track(clips, description="clips", transient=True)
    ]


def fit_clip(
    clip: LipClip, phones: list[Phone], learnt: DynamicVisemes, guessed: DynamicVisemes
) -> FittedClip:
    """Model a clip's lips with learnt and with initial parameters."""

    def curves(lips: DynamicVisemes) -> Array:
        num_frames = int(max(clip.time_s[-1], 0.0) * FRAME_RATE_HZ) + 2
        frames = synthesize(lips, phones, num_frames, FRAME_RATE_HZ)
        position = np.clip(clip.time_s * FRAME_RATE_HZ, 0.0, num_frames - 1.001)
        before = position.astype(int)
        share = (position - before)[:, None]
        mixed: Array = (1.0 - share) * frames[before] + share * frames[before + 1]
        return mixed

    return FittedClip(clip, phones, learnt.inventory, curves(learnt), curves(guessed))


def viseme_errors(fitted: Sequence[FittedClip]) -> list[VisemeError]:
    """Return the errors of each viseme, and of all together, for every measure."""
    viseme = np.concatenate([_nearest_visemes(clip) for clip in fitted])
    errors = []
    for measure in CURVES:
        curves = zip(*(clip.curves(measure) for clip in fitted), strict=True)
        real, learnt, guessed = (np.concatenate(values) for values in curves)
        for name in ("all", *VISEMES):
            rows = ~np.isnan(real)
            if name != "all":
                rows &= viseme == VISEMES.index(name)
            if rows.any():
                error = VisemeError(
                    viseme=name,
                    measure=measure,
                    num_frames=int(rows.sum()),
                    extent=float(real[rows].std()),
                    learnt=_rms(learnt[rows] - real[rows]),
                    guessed=_rms(guessed[rows] - real[rows]),
                )
                errors.append(error)
    return errors


def _nearest_visemes(fitted: FittedClip) -> NDArray[np.intp]:
    """Return the viseme nearest to each frame, or rest in silence."""
    timeline = build_timeline(fitted.phones, fitted.inventory)
    time_s = fitted.clip.time_s[:, None]
    is_quiet = ((time_s > timeline.silence_start_s) & (time_s < timeline.silence_end_s)).any(axis=1)
    rest = VISEMES.index(REST)
    if not len(timeline.viseme):
        return np.full(len(time_s), rest)
    distance = np.maximum(timeline.apex_start_s - time_s, time_s - timeline.apex_end_s)
    return np.where(is_quiet, rest, timeline.viseme[np.argmin(distance, axis=1)])


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def print_errors(errors: Sequence[VisemeError], console: Console) -> None:
    """Print the errors, one row per viseme."""
    rows = []
    for viseme in dict.fromkeys(error.viseme for error in errors):
        of_viseme = {error.measure: error for error in errors if error.viseme == viseme}
        cells = {
            measure: f"{error.learnt:.0f} ({error.guessed:.0f}); {error.extent:.0f}"
            for measure, error in of_viseme.items()
        }
        num_frames = max(error.num_frames for error in of_viseme.values())
        rows.append([viseme, str(num_frames), *(cells.get(measure, "") for measure in CURVES)])
    title = "error in FAP units: learnt (initial); standard deviation of the measured values"
    print_table(console, title, ("viseme", "frames", *CURVES), rows)


def fit_figure(fitted: Sequence[FittedClip]) -> Any:
    """Plot measured and modeled curves: of a long vowel, and of a sentence."""
    figure = new_figure(14.0, 6.0)
    axes = figure.subplots(
        1 + len(CURVES), 2, sharex="col", sharey="row", width_ratios=(1.0, 2.2), squeeze=False
    )
    clip = max(fitted, key=lambda clip: _long_vowel(clip)[2])
    start_s, length_s, _ = _long_vowel(clip)
    _draw_fit(axes[:, 0], clip, start_s - _CONTEXT_S, start_s + length_s + _CONTEXT_S)
    clip = max(fitted, key=lambda clip: _busiest_stretch(clip)[1])
    start_s, _ = _busiest_stretch(clip)
    _draw_fit(axes[:, 1], clip, start_s, start_s + _SENTENCE_S)
    for axis, measure in zip(axes[1:, 0], CURVES, strict=True):
        axis.set_ylabel(f"{measure}, FAP units", fontsize=8)
    axes[1, 1].legend(fontsize=8, loc="upper right")
    return figure


def _long_vowel(fitted: FittedClip) -> tuple[float, float, float]:
    """Return onset, duration and confidence of the best long vowel before a pause."""
    inventory = fitted.inventory
    return max(
        (
            (phone.onset_s, phone.duration_s, phone.confidence)
            for phone, after in pairwise(fitted.phones)
            if phone.symbol in inventory.vowels
            and len(inventory.visemes[phone.symbol]) == 1
            and phone.duration_s > _LONG_VOWEL_S
            and after.symbol == inventory.silence
        ),
        key=lambda vowel: vowel[2],
        default=(0.0, 0.0, 0.0),
    )


def _busiest_stretch(fitted: FittedClip) -> tuple[float, int]:
    """Return the start of the 6 s with the most phones, and their number."""
    silence = fitted.inventory.silence
    onsets_s = np.array([phone.onset_s for phone in fitted.phones if phone.symbol != silence])
    if not onsets_s.size:
        return 0.0, 0
    until = np.searchsorted(onsets_s, onsets_s + _SENTENCE_S)
    count = until - np.arange(len(onsets_s))
    best = int(np.argmax(count))
    return max(float(onsets_s[best]) - 0.1, 0.0), int(count[best])


def _draw_fit(axes: Any, fitted: FittedClip, start_s: float, end_s: float) -> None:
    first, last = (round(max(time_s, 0.0) * SAMPLE_RATE_HZ) for time_s in (start_s, end_s))
    phones = [phone for phone in fitted.phones if start_s <= phone.onset_s < end_s]
    samples = fitted.clip.samples[first:last]
    axes[0].plot((first + np.arange(len(samples))) / SAMPLE_RATE_HZ, samples, color="0.6", lw=0.3)
    bottom = -1.1 * float(np.abs(samples).max(initial=1e-3))
    top = -1.5 * bottom
    axes[0].set(ylim=(bottom, top), yticks=[])
    for number, phone in enumerate(phones):
        for axis in axes:
            axis.axvline(phone.onset_s, color="0.92", zorder=0)
        if phone.symbol != fitted.inventory.silence:
            # two heights, so that labels of short phones do not overlap
            axes[0].text(phone.onset_s, top * (0.7 + 0.15 * (number % 2)), phone.symbol, fontsize=8)
    axes[0].set_title(fitted.clip.name, fontsize=9)
    is_shown = (fitted.clip.time_s >= start_s) & (fitted.clip.time_s <= end_s)
    time_s = fitted.clip.time_s[is_shown]
    for axis, measure in zip(axes[1:], CURVES, strict=True):
        real, learnt, guessed = (curve[is_shown] for curve in fitted.curves(measure))
        axis.plot(time_s, guessed, color="C1", linewidth=0.8, label="initial parameters")
        axis.plot(time_s, real, color="0.6", linewidth=2.5, label="measured")
        axis.plot(time_s, learnt, color="black", linewidth=1.2, label="learnt parameters")
    axes[-1].set_xlabel("s")
