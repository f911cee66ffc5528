"""Accuracy of the lips against real ones, at several speaking rates.

Source: Zhang et al. 2021, section 6, eq. 7 to 9 (*reconstructed*) and tables 3 and 4. With the
displacements ``V`` of the lips' feature points from the closed mouth,

    accuracy = 1 - sum |V_made - V_real| / sum |V_real|

over all vertical displacements of lip points and all frames. Two deviations: the paper divides by
the mean of several speakers; here each speaker's displacements, and those of each method, are
scaled so that the widest opening (98th percentile) is that of R = 5. And other rates are the same
recording, time-scaled with its pitch kept, so that the real lips are known: they move as much
faster.

Where a clip's words are not known, its recognised syllables are the text, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from corpora.figures import new_figure
from corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, read_clips
from evaluation.lips.schemes import DEFAULT_DELAY_S, FRAME_RATE_HZ, live_events, live_frames
from evaluation.recognizer.disturbances import faster
from services.cli.mouth_drawing import syllables_of
from services.recognizer.acoustic.acoustic_model import AcousticModel
from services.recognizer.acoustic.load import load_live_model
from services.recognizer.alignment import align_phones, spoken
from services.recognizer.front_end.pcm import progress_of
from services.recognizer.lips import lips_for
from services.recognizer.offline import recognize
from services.synthesizer.lips.ferguson.contour import faps_of
from services.synthesizer.lips.ferguson.motion import MAX_OPENING, KeyFrames
from services.synthesizer.lips.ferguson.openings import key_frames_of
from services.synthesizer.lips.ferguson.table import load_table
from services.synthesizer.lips.ferguson.timing import time_text
from services.synthesizer.lips.load import LIP_MODELS, load_lip_model
from shared.errors import UserError
from shared.face.faps import FAPS, MOUTH_FAPS
from shared.phones.events import Phone
from shared.phones.inventory import Syllable

Array = NDArray[np.float64]
Samples = NDArray[np.float32]
Curves = Callable[[Array], Array]  # times (n,), seconds -> mouth FAPs (n, num_mouth_faps)

RATES = (0.8, 1.0, 1.25, 1.5, 2.0)
_FULL_PERCENTILE = 98.0
_LIP_COLUMNS = [
    column
    for column, fap in enumerate(MOUTH_FAPS)
    if FAPS[fap - 1].direction in ("up", "down") and FAPS[fap - 1].feature_points[0][0] in "28"
    if fap != 3
]
_MIDDLES = [MOUTH_FAPS.index(4), MOUTH_FAPS.index(5)]
BEST_OPENING, STILL = "best R of each frame", "still mouth"


@dataclass(frozen=True, slots=True, kw_only=True)
class RateScore:
    """What every method scores at one speaking rate."""

    rate: float  # relative to the recording
    syllables_per_s: float
    accuracy: dict[str, float]


def accuracy_of(made: Array, real: Array) -> float:
    """Compare mouth FAPs, (num_frames, num_mouth_faps) each; NaN where not measured."""
    made, real = made[:, _LIP_COLUMNS], real[:, _LIP_COLUMNS]
    difference, size = np.abs(made - real), np.abs(real)
    return 1.0 - float(np.nansum(difference) / np.sum(size[np.isfinite(difference)]))


def score_rates(folder: Path, part: str, rates: Sequence[float] = RATES) -> list[RateScore]:
    """Score all lip models on the clips of a part ("choice" or "held"), in sync, in Mandarin.

    Raises
    ------
    UserError
        If there are no such clips.
    """
    clips = [clip for clip in read_clips(folder) if clip.part == part and clip.is_in_sync]
    if not clips:
        raise UserError(f"{folder} has no {part} clips in sync")
    real = scaled([clip.speaker for clip in clips], [clip.faps for clip in clips])
    model = load_live_model()
    scores = []
    for rate in rates:
        made: dict[str, list[Array]] = {}
        num_syllables, seconds = 0, 0.0
        for clip in track(clips, description=f"{rate:g} times the rate"):
            samples = clip.samples if rate == 1.0 else faster(clip.samples, rate)
            syllables, phones = _text(model, clip, samples)
            num_syllables += len(syllables)
            seconds += sum(phone.duration_s for phone in phones)
            for name, curves in _methods(model, samples, syllables, phones):
                made.setdefault(name, []).append(curves(clip.time_s / rate))
        accuracy = {
            name: accuracy_of(
                np.concatenate(scaled([name] * len(clips), mouths)), np.concatenate(real)
            )
            for name, mouths in made.items()
        }
        accuracy |= limits(np.concatenate(real))
        scores.append(
            RateScore(
                rate=rate,
                syllables_per_s=num_syllables / max(seconds, 1e-9),
                accuracy=accuracy,
            )
        )
    return scores


def scaled(mouths_of: Sequence[str], mouths: Sequence[Array]) -> list[Array]:
    """Scale FAPs (num_frames, num_mouth_faps): the widest opening of everyone is that of R = 5."""
    whole = -float(faps_of([MAX_OPENING])[0, _MIDDLES].sum())
    openings: dict[str, list[Array]] = {}
    for owner, faps in zip(mouths_of, mouths, strict=True):
        openings.setdefault(owner, []).append(-faps[:, _MIDDLES].sum(axis=1))
    widest = {
        owner: max(float(np.nanpercentile(np.concatenate(group), _FULL_PERCENTILE)), 1.0)
        for owner, group in openings.items()
    }
    return [faps * whole / widest[owner] for owner, faps in zip(mouths_of, mouths, strict=True)]


def _text(
    model: AcousticModel, clip: LipClip, samples: Samples
) -> tuple[list[Syllable], list[Phone]]:
    """Return the syllables of a clip, known or recognised, and their phones with true times."""
    if clip.transcript:
        syllables = model.inventory.pronounce(clip.transcript)
        phones = align_phones(model, samples, SAMPLE_RATE_HZ, syllables)
        return syllables, spoken(phones, model.inventory)
    phones = spoken(recognize(model, samples, SAMPLE_RATE_HZ), model.inventory)
    groups = syllables_of(phones, model.inventory)
    return [tuple(phone.symbol for phone in group) for group in groups], phones


def _methods(
    model: AcousticModel, samples: Samples, syllables: Sequence[Syllable], phones: Sequence[Phone]
) -> Iterator[tuple[str, Curves]]:
    """Yield each way to make lips, with what it makes of a sound."""
    inventory = model.inventory
    table = load_table(inventory)
    by_endpoints = time_text(progress_of(samples), syllables, table)
    for name, timed in (("text by endpoints", by_endpoints), ("text by alignment", phones)):
        yield name, _curves_of(key_frames_of(timed, table, inventory.silence))
    events = live_events(model, samples, lips_for(model), [DEFAULT_DELAY_S])[DEFAULT_DELAY_S]
    for name in LIP_MODELS:
        lips = load_lip_model(inventory.language, name)
        frames = live_frames(lips, events, DEFAULT_DELAY_S, FRAME_RATE_HZ)
        yield f"{name}, live", _between(frames[:, np.array(MOUTH_FAPS) - 1])


def _curves_of(motion: KeyFrames) -> Curves:
    return lambda times_s: faps_of(motion.openings_at(times_s))


def _between(mouth: Array) -> Curves:
    """Interpolate between frames (num_frames, num_mouth_faps)."""
    frame_s = np.arange(len(mouth)) / FRAME_RATE_HZ
    return lambda times_s: np.stack(
        [np.interp(times_s, frame_s, column) for column in mouth.T], axis=1
    )


def limits(real: Array) -> dict[str, float]:
    """Score the best that one opening a frame can do, and a mouth that stands still."""
    candidates = faps_of(np.linspace(0.0, MAX_OPENING, 51))
    away = np.stack(
        [np.nansum(np.abs(real - mouth)[:, _LIP_COLUMNS], axis=1) for mouth in candidates]
    )
    still = np.zeros_like(real)
    for column in _LIP_COLUMNS:
        measured = real[np.isfinite(real[:, column]), column]
        still[:, column] = np.median(measured) if len(measured) else 0.0
    return {
        BEST_OPENING: accuracy_of(candidates[away.argmin(axis=0)], real),
        STILL: accuracy_of(still, real),
    }


def print_rates(scores: Sequence[RateScore], console: Console) -> None:
    """Print accuracies by speaking rate as the paper's table 3, a row for each method."""
    table = Table("accuracy at the rate", *(f"{score.rate:g}" for score in scores))
    table.add_row("syllables a second", *(f"{score.syllables_per_s:.1f}" for score in scores))
    for name in scores[0].accuracy:
        table.add_row(name, *(f"{100 * score.accuracy[name]:.0f} %" for score in scores))
    console.print(table)


def rates_figure(scores: Sequence[RateScore]) -> Any:
    """Draw the accuracies over the speaking rate."""
    figure = new_figure(8.0, 4.5)
    axis = figure.subplots()
    rates = [score.rate for score in scores]
    for name in scores[0].accuracy:
        is_limit = name in (BEST_OPENING, STILL)
        axis.plot(
            rates,
            [100 * score.accuracy[name] for score in scores],
            "--" if is_limit else "o-",
            color="0.6" if is_limit else None,
            label=name,
        )
    axis.set_xlabel("speaking rate, relative to the recording")
    axis.set_ylabel("accuracy, %")
    axis.legend(fontsize=8)
    return figure
