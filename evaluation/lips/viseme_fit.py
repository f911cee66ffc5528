"""How well the visemes fit lips that they were not trained on.

Source: Wang & Cai 2003, section 4; their figure 4 shows measured and modeled curves. Here the full
model runs over the phones of each clip. The phones are aligned if the text is known, and recognized
otherwise. The model runs with the learned parameters and with the initial parameters, which were
set by hand. Each frame counts for the nearest viseme. The level of the voice is not used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.figures import new_figure
from kouxing.corpora.lip_clips import LipClip, label_clip
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import CURVES, real_faps
from kouxing.evaluation.lips.offline_visemes import synthesize
from kouxing.evaluation.lips.references import clips_to_score
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.synthesizer.lips.dynamic_visemes.initial_parameters import initial_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import REST, VISEMES
from kouxing.shared.arrays import Doubles
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

_SENTENCE_S = 6.0


@dataclass(slots=True, kw_only=True)
class VisemeError:
    """RMS error over the frames of a viseme, FAP units."""

    viseme: str
    measure: str
    num_frames: int
    extent: float  # standard deviation of the measured values in these frames
    learned: float
    guessed: float  # with the initial parameters


@dataclass(frozen=True, slots=True)
class FittedClip:
    """A clip with its phones and modeled curves, at the clip's frames."""

    clip: LipClip
    phones: list[Phone]
    inventory: PhoneInventory
    learned: Doubles  # (num_frames, 68)
    guessed: Doubles  # (num_frames, 68)

    def curves(self, measure: str) -> tuple[Doubles, Doubles, Doubles]:
        """Return measured, learned and guessed values, (num_frames,), without the clip's means."""
        real = CURVES[measure](real_faps(self.clip))
        is_known = ~np.isnan(real)
        learned, guessed = CURVES[measure](self.learned), CURVES[measure](self.guessed)
        if is_known.any():
            real, learned, guessed = (v - v[is_known].mean() for v in (real, learned, guessed))
        return real, learned, guessed


def fit_folder(folder: Path) -> list[FittedClip]:
    """Model all clips of a folder that the shipped parameters were not trained on."""
    model = load_model()
    learned, guessed = (
        DynamicVisemes(values, model.inventory)
        for values in (load_parameters(), initial_parameters())
    )
    clips = clips_to_score(folder, language=model.inventory.code)
    return [
        fit_clip(clip, label_clip(model, clip), learned, guessed)
        for clip in track(clips, description="clips", transient=True)
    ]


def fit_clip(
    clip: LipClip, phones: list[Phone], learned: DynamicVisemes, guessed: DynamicVisemes
) -> FittedClip:
    """Model a clip's lips with learned and with initial parameters."""

    def curves(lips: DynamicVisemes) -> Doubles:
        num_frames = int(max(clip.time_s[-1], 0.0) * FRAME_RATE_HZ) + 2
        frames = synthesize(lips, phones, num_frames, FRAME_RATE_HZ)
        frame_s = np.arange(num_frames) / FRAME_RATE_HZ
        return np.stack([np.interp(clip.time_s, frame_s, fap) for fap in frames.T], axis=1)

    return FittedClip(clip, phones, learned.inventory, curves(learned), curves(guessed))


def viseme_errors(fitted: Sequence[FittedClip]) -> list[VisemeError]:
    """Return the errors of each viseme, and of all together, for every measure."""
    viseme = np.concatenate([_nearest_visemes(clip) for clip in fitted])
    errors = []
    for measure in CURVES:
        curves = zip(*(clip.curves(measure) for clip in fitted), strict=True)
        real, learned, guessed = (np.concatenate(values) for values in curves)
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
                    learned=_rms(learned[rows] - real[rows]),
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


def _rms(error: Doubles) -> float:
    return float(np.sqrt(np.mean(error**2)))


def fit_figure(fitted: Sequence[FittedClip]) -> Any:
    """Plot measured and modeled curves of the clip with the most phones in the first 6 s."""
    figure = new_figure(10.0, 6.0)
    axes = figure.subplots(len(CURVES), sharex=True)
    clip = max(fitted, key=lambda clip: len(_first_phones(clip)))
    is_shown = clip.clip.time_s <= _SENTENCE_S
    for axis, name in zip(axes, CURVES, strict=True):
        real, learned, guessed = (curve[is_shown] for curve in clip.curves(name))
        time_s = clip.clip.time_s[is_shown]
        axis.plot(time_s, guessed, color="C1", linewidth=0.8, label="initial parameters")
        axis.plot(time_s, real, color="0.6", linewidth=2.5, label="measured")
        axis.plot(time_s, learned, color="black", linewidth=1.2, label="learned parameters")
        axis.set_ylabel(f"{name}, FAP units", fontsize=8)
    top = axes[0].get_ylim()[1]
    for number, phone in enumerate(_first_phones(clip)):
        label = phone.symbol + "\n" * (number % 2)  # two heights, so that labels do not overlap
        axes[0].text(phone.onset_s, top, label, fontsize=8)
    axes[0].set_title(clip.clip.name, fontsize=9, pad=25)
    axes[0].legend(fontsize=8, loc="upper right")
    axes[-1].set_xlabel("s")
    return figure


def _first_phones(fitted: FittedClip) -> list[Phone]:
    silence = fitted.inventory.silence
    phones = [phone for phone in fitted.phones if phone.symbol != silence]
    return [phone for phone in phones if phone.onset_s < _SENTENCE_S]
