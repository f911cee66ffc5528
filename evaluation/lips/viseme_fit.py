"""How well the visemes fit lips that they were not learnt from, and what learning changed.

Source: Wang & Cai 2003, section 4, whose fig. 4 shows measured against modelled curves of a single
final and of a sentence. Here the full model runs over the phones of each clip (aligned where the
text is known, else recognised), once with the learnt parameters and once with those set by hand
(``initial_parameters.py``). The errors of a viseme are those of the frames nearest to it. The level
of the voice is left out: this measures the parameters alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, label_clip
from kouxing.evaluation.lips.clip_scores import MEASURES, real_faps
from kouxing.evaluation.lips.schemes import FRAME_RATE_HZ
from kouxing.evaluation.lips.scores import clips_to_score
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import (
    VisemeParameters,
    load_parameters,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST, VISEMES
from kouxing.services.synthesizer.offline import synthesize
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

_COMPARED_FAPS = {"jaw": 3, "lower lip": 5, "corner": 6}
_SENTENCE_S = 6.0
_LONG_VOWEL_S, _AROUND_S = 0.2, 0.4  # least duration of the vowel that is shown; what is around it


@dataclass(slots=True, kw_only=True)
class VisemeError:
    """Root of the mean squared error over the frames of a viseme, FAP units."""

    viseme: str
    measure: str
    num_frames: int
    extent: float  # standard deviation of the measured values in these frames
    learnt: float
    guessed: float


@dataclass(slots=True, kw_only=True)
class Change:
    """What learning made of the parameters of a viseme and a FAP."""

    viseme: str
    fap: int
    guessed: dict[str, float]
    learnt: dict[str, float]


@dataclass(frozen=True, slots=True)
class FittedClip:
    """A clip with its phones and modelled curves, frames as the clip's."""

    clip: LipClip
    phones: list[Phone]
    inventory: PhoneInventory
    learnt: Array  # (num_frames, 68)
    guessed: Array  # (num_frames, 68)


def fit_clip(
    clip: LipClip, phones: list[Phone], learnt: DynamicVisemes, guessed: DynamicVisemes
) -> FittedClip:
    """Model a clip's lips with learnt and with guessed parameters."""

    def curves(lips: DynamicVisemes) -> Array:
        num_frames = int(max(clip.time_s[-1], 0.0) * FRAME_RATE_HZ) + 2
        frames = synthesize(lips, phones, num_frames, FRAME_RATE_HZ)
        position = np.clip(clip.time_s * FRAME_RATE_HZ, 0.0, num_frames - 1.001)
        before = position.astype(int)
        share = (position - before)[:, None]
        mixed: Array = (1.0 - share) * frames[before] + share * frames[before + 1]
        return mixed

    return FittedClip(clip, phones, learnt.inventory, curves(learnt), curves(guessed))


def errors_of_visemes(fitted: Sequence[FittedClip]) -> list[VisemeError]:
    """Errors of each viseme and of all together, for every measure."""
    viseme = np.concatenate([_nearest_visemes(each) for each in fitted])
    errors = []
    for measure in MEASURES:
        real, learnt, guessed = (
            np.concatenate(values)
            for values in zip(*(_centred(each, measure) for each in fitted), strict=True)
        )
        for name in ("all", *VISEMES):
            rows = ~np.isnan(real)
            if name != "all":
                rows &= viseme == VISEMES.index(name)
            if rows.any():
                errors.append(
                    VisemeError(
                        viseme=name,
                        measure=measure,
                        num_frames=int(rows.sum()),
                        extent=float(real[rows].std()),
                        learnt=_rms(learnt[rows] - real[rows]),
                        guessed=_rms(guessed[rows] - real[rows]),
                    )
                )
    return errors


def _centred(each: FittedClip, measure: str) -> tuple[Array, Array, Array]:
    """Measured, learnt and guessed values, the clip's own means removed."""
    real = MEASURES[measure](real_faps(each.clip))
    known = ~np.isnan(real)
    values = (real, MEASURES[measure](each.learnt), MEASURES[measure](each.guessed))
    if known.any():
        real, learnt, guessed = (value - value[known].mean() for value in values)
    else:
        _, learnt, guessed = values
    return real, learnt, guessed


def _nearest_visemes(each: FittedClip) -> NDArray[np.intp]:
    """Viseme nearest to each frame; ``rest`` where nothing is said."""
    timeline = build_timeline(each.phones, each.inventory)
    time_s = each.clip.time_s[:, None]
    quiet = ((time_s > timeline.silence_start_s) & (time_s < timeline.silence_end_s)).any(axis=1)
    rest = VISEMES.index(REST)
    if not len(timeline.viseme):
        return np.full(len(time_s), rest)
    distance = np.maximum(timeline.apex_start_s - time_s, time_s - timeline.apex_end_s)
    return np.where(quiet, rest, timeline.viseme[np.argmin(distance, axis=1)])


def _rms(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2)))


def changes(learnt: VisemeParameters, guessed: VisemeParameters) -> list[Change]:
    """Compare parameters, for one FAP of jaw, lips and mouth width each."""
    names = ("target", "alpha", "theta_minus", "theta_plus", "offset_s")
    return [
        Change(
            viseme=viseme,
            fap=fap,
            guessed={n: float(getattr(guessed, n)[row, MOUTH_FAPS.index(fap)]) for n in names},
            learnt={n: float(getattr(learnt, n)[row, MOUTH_FAPS.index(fap)]) for n in names},
        )
        for fap in _COMPARED_FAPS.values()
        for row, viseme in enumerate(VISEMES)
        if viseme != REST
    ]


def main(folder: Path, parameters: Path | None, picture: Path | None) -> dict[str, Any]:
    """Fit all clips that were not learnt from, print tables and return the figures."""
    model = load_model()
    learnt, guessed = load_parameters(parameters), initial_parameters()
    lips = [DynamicVisemes(each, model.inventory) for each in (learnt, guessed)]
    clips = clips_to_score(folder, parameters, language=model.inventory.code)
    fitted = [
        fit_clip(clip, label_clip(model, clip), *lips)
        for clip in track(clips, description="clips", transient=True)
    ]
    errors, changed = errors_of_visemes(fitted), changes(learnt, guessed)
    console = Console()
    _print_errors(errors, console)
    _print_changes(changed, console)
    if picture is not None:
        save_figure(fit_figure(fitted), picture)
    return {
        "clips": [each.clip.name for each in fitted],
        "errors": [asdict(error) for error in errors],
        "changes": [asdict(change) for change in changed],
    }


def _print_errors(errors: Sequence[VisemeError], console: Console) -> None:
    table = Table(title="error in FAP units: learnt (guessed); extent of what was measured")
    table.add_column("viseme")
    table.add_column("frames")
    for measure in MEASURES:
        table.add_column(measure)
    for viseme in dict.fromkeys(error.viseme for error in errors):
        rows = [error for error in errors if error.viseme == viseme]
        cells = {
            error.measure: f"{error.learnt:.0f} ({error.guessed:.0f}); {error.extent:.0f}"
            for error in rows
        }
        num_frames = max(error.num_frames for error in rows)
        table.add_row(viseme, str(num_frames), *(cells.get(m, "") for m in MEASURES))
    console.print(table)


def _print_changes(changed: Sequence[Change], console: Console) -> None:
    for name, fap in _COMPARED_FAPS.items():
        table = Table(title=f"{name} (FAP {fap}): guessed -> learnt")
        for column in ("viseme", "T", "alpha", "theta-", "theta+", "t_o ms"):
            table.add_column(column)
        for change in changed:
            if change.fap == fap:
                old, new = change.guessed, change.learnt
                table.add_row(
                    change.viseme,
                    f"{old['target']:.0f} -> {new['target']:.0f}",
                    f"{old['alpha']:.2f} -> {new['alpha']:.2f}",
                    f"{old['theta_minus']:.0f} -> {new['theta_minus']:.0f}",
                    f"{old['theta_plus']:.0f} -> {new['theta_plus']:.0f}",
                    f"{1e3 * old['offset_s']:.0f} -> {1e3 * new['offset_s']:.0f}",
                )
        console.print(table)


def fit_figure(fitted: Sequence[FittedClip]) -> Any:
    """Measured against modelled curves: a long vowel with what is around it, and a sentence."""
    figure = new_figure(14.0, 6.0)
    num_rows = 1 + len(MEASURES)
    axes = figure.subplots(
        num_rows, 2, sharex="col", sharey="row", width_ratios=(1.0, 2.2), squeeze=False
    )
    shown = max(fitted, key=lambda each: _surest_vowel(each)[2])
    start_s, length_s, _ = _surest_vowel(shown)
    _draw_fit(axes[:, 0], shown, start_s - _AROUND_S, start_s + length_s + _AROUND_S)
    shown = max(fitted, key=lambda each: _busiest(each)[1])
    start_s, _ = _busiest(shown)
    _draw_fit(axes[:, 1], shown, start_s, start_s + _SENTENCE_S)
    for axis, measure in zip(axes[1:, 0], MEASURES, strict=True):
        axis.set_ylabel(f"{measure}, FAP units", fontsize=8)
    axes[1, 1].legend(fontsize=8, loc="upper right")
    return figure


def _surest_vowel(each: FittedClip) -> tuple[float, float, float]:
    """Onset, duration and confidence of the surest long vowel of one viseme before a pause."""
    inventory = each.inventory
    return max(
        (
            (phone.onset_s, phone.duration_s, phone.confidence)
            for phone, after in pairwise(each.phones)
            if phone.symbol in inventory.vowels
            and len(inventory.visemes[phone.symbol]) == 1
            and phone.duration_s > _LONG_VOWEL_S
            and after.symbol == inventory.silence
        ),
        key=lambda vowel: vowel[2],
        default=(0.0, 0.0, 0.0),
    )


def _busiest(each: FittedClip) -> tuple[float, int]:
    """Onset of the stretch of a sentence's length with the most phones, and how many."""
    silence = each.inventory.silence
    onsets_s = np.array([phone.onset_s for phone in each.phones if phone.symbol != silence])
    if not onsets_s.size:
        return 0.0, 0
    until = np.searchsorted(onsets_s, onsets_s + _SENTENCE_S)
    count = until - np.arange(len(onsets_s))
    best = int(np.argmax(count))
    return max(float(onsets_s[best]) - 0.1, 0.0), int(count[best])


def _draw_fit(axes: Any, each: FittedClip, start_s: float, end_s: float) -> None:
    first, last = (round(max(time_s, 0.0) * SAMPLE_RATE_HZ) for time_s in (start_s, end_s))
    inside = [phone for phone in each.phones if start_s <= phone.onset_s < end_s]
    samples = each.clip.samples[first:last]
    _draw_sound(axes[0], samples, inside, each.inventory.silence, first / SAMPLE_RATE_HZ)
    axes[0].set_title(each.clip.name, fontsize=9)
    shown = (each.clip.time_s >= start_s) & (each.clip.time_s <= end_s)
    time_s = each.clip.time_s[shown]
    for axis, measure in zip(axes[1:], MEASURES, strict=True):
        real, learnt, guessed = _centred(each, measure)
        axis.plot(time_s, guessed[shown], color="C1", linewidth=0.8, label="guessed")
        axis.plot(time_s, real[shown], color="0.6", linewidth=2.5, label="measured")
        axis.plot(time_s, learnt[shown], color="black", linewidth=1.2, label="learnt")
        for phone in inside:
            axis.axvline(phone.onset_s, color="0.92", zorder=0)
    axes[-1].set_xlabel("s")


def _draw_sound(
    axis: Any,
    samples: NDArray[np.float32],
    phones: Sequence[Phone],
    silence: str,
    start_s: float = 0.0,
) -> None:
    """Draw a waveform that begins at ``start_s``, with its phones above."""
    time_s = start_s + np.arange(len(samples)) / SAMPLE_RATE_HZ
    axis.plot(time_s, samples, color="0.6", linewidth=0.3)
    top = 1.1 * float(np.abs(samples).max(initial=1e-3))
    for number, phone in enumerate(phones):
        axis.axvline(phone.onset_s, color="0.9", zorder=0)
        if phone.symbol != silence:
            # two heights, so that short phones do not overlap
            axis.text(phone.onset_s, top * (1.0 + 0.25 * (number % 2)), phone.symbol, fontsize=8)
    axis.set_ylim(-top, 1.5 * top)
    axis.set_yticks([])
