"""How well the synthesized lips move like real ones.

The four schemes of Li et al. 2011, section 3.2, and the dial of the live one, against tracked
lips:

1. forced alignment of the transcript, full model (clips with a transcript only);
2. recognised units with their times, full model;
3. the live system at several look-aheads;
4. live, but a unit counts only once the next one begins (look-ahead 50 ms).

Two baselines need no units: the mouth opens with the loudness, and the mouth stands still at its
mean. Measured for lip opening (inner lips), mouth width and jaw: correlation, the lag at which it
is best, the correlation there (lag above 0: the synthesized lips are late), and the root of the
mean squared error in FAP units, each clip's own means removed first: a tracked face at rest is
never quite at 0.

Closures, twice. How many b p m close: the synthesized lips meet within 40 ms of the acoustic
closure, the quietest moment of the unit; units are those of the aligned text, or where that is
unknown of the recogniser's full traceback, which scheme 2 then hits by itself. And how many of the
real lips' closures (opening within a tenth of its range from its least, at a minimum) are met
within 40 ms. A mouth that does not open nearby closes nothing.

Only clips count that the parameters were neither learnt from nor chosen with.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from evaluation.recognizer import is_put_out
from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.load import load_model
from services.recognizer.pipeline import Recognizer, recognize
from services.synthesizer.full import synthesize
from services.synthesizer.live import LiveSynthesizer
from services.synthesizer.parameters import VisemeParameters, clips_seen, load_parameters
from services.synthesizer.visemes import MOUTH_FAPS
from shared.config import SynthesizerConfig
from shared.errors import UserError
from shared.faps import NUM_FAPS
from shared.phones import Phone, SpeechChange
from training.lip_clips import (
    SAMPLE_RATE_HZ,
    LipClip,
    aligned_units,
    level_track,
    read_clips,
)

Array = NDArray[np.float64]
Heard = tuple[float, float, list[Phone | SpeechChange]]  # time in s, level in dB, what was said

DEFAULT_LOOK_AHEAD_S = SynthesizerConfig().look_ahead_ms / 1e3
LOOK_AHEADS_S = sorted({0.0, 0.05, 0.1, 0.2, 0.3, DEFAULT_LOOK_AHEAD_S})
NEXT_UNIT_LOOK_AHEAD_S = 0.05
FRAME_RATE_HZ = 50.0
_LONGEST_LAG_S = 0.3
_CLOSURE_WINDOW_S = 0.04
_CLOSED, _OPEN = 20.0, 100.0  # FAP units of synthesized opening: 0.6 and 3 mm on a face
_CLOSED_SHARE = 0.1  # of a real mouth's range
_OPEN_SHARE, _OPEN_WINDOW_S = 0.5, 0.2  # which opens so far near a closure: else it is a pause
_LEVEL_HOP_S = 0.01
_MEAN_OPENING = 250.0  # FAP units; only closures see it, means are removed

MEASURES: dict[str, Callable[[Array], Array]] = {
    "opening": lambda faps: -faps[:, 3] - faps[:, 4],
    "width": lambda faps: faps[:, 5] + faps[:, 6],
    "jaw": lambda faps: faps[:, 2],
}


@dataclass(slots=True, kw_only=True)
class LipScore:
    """One scheme on one group of clips and one measure."""

    scheme: str
    group: str
    measure: str
    num_clips: int
    correlation: float | None  # None: the synthesized lips stand still
    best_lag_ms: float | None
    best_correlation: float | None
    rmse: float  # FAP units, own means removed
    bpm_met: int  # units that close
    bpm: int
    closures_met: int  # real closures that are met
    closures: int


@dataclass(frozen=True, slots=True)
class ClipLips:
    """What every scheme makes of a clip."""

    clip: LipClip
    schemes: dict[str, Array]  # (num_frames, 68) each
    acoustic_closures_s: Array  # of its b p m


def hear(model: AcousticModel, samples: NDArray[np.float32]) -> list[Heard]:
    """Run the live recognizer over a sound (16 kHz mono), fed as it would arrive."""
    recognizer = Recognizer(model, sample_rate_hz=SAMPLE_RATE_HZ)
    heard, start = [], 0
    for time_s, level in level_track(samples):
        end = round(time_s * SAMPLE_RATE_HZ)
        heard.append((time_s, level, recognizer.accept_waveform(samples[start:end])))
        start = end
    rest = recognizer.accept_waveform(samples[start:]) + recognizer.input_finished()
    heard.append((len(samples) / SAMPLE_RATE_HZ, -np.inf, rest))
    return heard


def live_frames(
    parameters: VisemeParameters,
    heard: Sequence[Heard],
    look_ahead_s: float,
    *,
    wait_for_next: bool = False,
) -> Array:
    """Frames (num_frames, 68) of the live synthesizer, ``FRAME_RATE_HZ`` of them a second."""
    live = LiveSynthesizer(parameters, frame_rate_hz=FRAME_RATE_HZ, look_ahead_s=look_ahead_s)
    frames = []
    for time_s, level, results in heard:
        for said, after in zip_longest(results, results[1:]):
            if not isinstance(said, Phone):
                live.accept_speech(said)
            elif not (wait_for_next and is_put_out(said, after)):
                live.accept_phone(said)
        live.accept_level(time_s, level)
        frames += live.advance(time_s)
    frames += live.advance(heard[-1][0] + look_ahead_s)
    return np.array([faps for _, faps in frames], dtype=float)


def loudness_frames(samples: NDArray[np.float32]) -> Array:
    """Frames (num_frames, 68) of a mouth that opens with the level, 0 to 1 over 40 dB."""
    hop = int(SAMPLE_RATE_HZ / FRAME_RATE_HZ)
    num_frames = len(samples) // hop + 1
    padded = np.pad(samples.astype(float), (hop, 2 * hop))
    power = [np.mean(padded[k * hop : (k + 2) * hop] ** 2) for k in range(num_frames)]
    level_db = 10.0 * np.log10(np.array(power) + 1e-10)
    level = np.clip((level_db - np.percentile(level_db, 95)) / 40.0 + 1.0, 0.0, 1.0)
    level = np.convolve(level, np.hanning(7) / np.hanning(7).sum(), mode="same")
    faps = np.zeros((num_frames, NUM_FAPS))
    faps[:, 2], faps[:, 4] = 300.0 * level, -600.0 * level
    return faps


def lips_of_clip(model: AcousticModel, parameters: VisemeParameters, clip: LipClip) -> ClipLips:
    """Synthesize a clip by every scheme and baseline."""
    num_frames = int(len(clip.samples) / SAMPLE_RATE_HZ * FRAME_RATE_HZ) + 1
    levels = level_track(clip.samples)

    def full(phones: Sequence[Phone]) -> Array:
        frames = synthesize(parameters, phones, num_frames, FRAME_RATE_HZ, levels)
        return frames.astype(float)

    schemes = {}
    aligned = aligned_units(model, clip)
    recognised = recognize(model, clip.samples, SAMPLE_RATE_HZ)
    heard = hear(model, clip.samples)
    if aligned is not None:
        schemes["1 aligned"] = full(aligned)
    schemes["2 recognised"] = full(recognised)
    for look_ahead_s in LOOK_AHEADS_S:
        schemes[f"3 live {1e3 * look_ahead_s:.0f} ms"] = live_frames(
            parameters, heard, look_ahead_s
        )
    schemes["4 next unit"] = live_frames(
        parameters, heard, NEXT_UNIT_LOOK_AHEAD_S, wait_for_next=True
    )
    schemes["loudness"] = loudness_frames(clip.samples)
    schemes["mean mouth"] = np.zeros((num_frames, NUM_FAPS))
    schemes["mean mouth"][:, 4] = -_MEAN_OPENING
    return ClipLips(clip, schemes, acoustic_closures(clip, aligned or recognised))


def acoustic_closures(clip: LipClip, phones: Sequence[Phone]) -> Array:
    """When the units b p m of a clip are quietest, seconds."""
    hop = round(_LEVEL_HOP_S * SAMPLE_RATE_HZ)
    power = np.square(clip.samples[: len(clip.samples) // hop * hop], dtype=float)
    level = power.reshape(-1, hop).mean(axis=1)
    moments = []
    for phone in phones:
        first = round(phone.onset_s / _LEVEL_HOP_S)
        last = max(round((phone.onset_s + phone.duration_s) / _LEVEL_HOP_S), first + 1)
        if phone.unit in "bpm" and first < len(level):
            moments.append((first + int(np.argmin(level[first:last])) + 0.5) * _LEVEL_HOP_S)
    return np.array(moments)


def real_faps(clip: LipClip) -> Array:
    """Tracked FAPs of a clip, (num_frames, 68), nan where not measured."""
    faps = np.full((len(clip.time_s), NUM_FAPS), np.nan)
    faps[:, np.array(MOUTH_FAPS) - 1] = clip.faps
    return faps


def _measured(clip: LipClip, measure: str) -> bool:
    """Whether a clip has any frame of a measure."""
    return not np.isnan(MEASURES[measure](real_faps(clip))).all()


def _aligned(clip: LipClip, frames: Array, measure: str, lag_s: float) -> tuple[Array, Array]:
    """Synthesized and real values at the clip's frames, means removed."""
    real = MEASURES[measure](real_faps(clip))
    known = ~np.isnan(real)
    values = MEASURES[measure](frames)
    times = np.arange(len(values)) / FRAME_RATE_HZ
    made = np.interp(clip.time_s[known] + lag_s, times, values)
    return made - made.mean(), real[known] - real[known].mean()


def _met(moments_s: Array, frames: Array) -> int:
    """How many of some closures the synthesized lips meet."""
    opening = MEASURES["opening"](frames)
    time_s = np.arange(len(opening)) / FRAME_RATE_HZ
    closed, opened = time_s[opening < _CLOSED], time_s[opening > _OPEN]
    return sum(
        bool(
            (np.abs(closed - moment_s) <= _CLOSURE_WINDOW_S).any()
            and (np.abs(opened - moment_s) <= _OPEN_WINDOW_S).any()
        )
        for moment_s in moments_s
    )


def _real_closures(clip: LipClip) -> Array:
    """When the tracked lips close, seconds."""
    real = MEASURES["opening"](real_faps(clip))
    if np.isnan(real).all():
        return np.zeros(0)
    low, high = np.nanpercentile(real, [1, 99])
    before, here, after = real[:-2], real[1:-1], real[2:]
    shut = (here <= before) & (here < after) & (here < low + _CLOSED_SHARE * (high - low))
    return np.array(
        [
            time_s
            for time_s in clip.time_s[1:-1][shut]
            if np.nanmax(real[np.abs(clip.time_s - time_s) < _OPEN_WINDOW_S])
            > low + _OPEN_SHARE * (high - low)
        ]
    )


def score_clips(group: str, lips: Sequence[ClipLips]) -> list[LipScore]:
    """Score every scheme over a group of clips, all frames pooled."""
    scores = []
    lags = np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S + 0.005, 0.01)
    here = len(lags) // 2
    real_closures = [_real_closures(each.clip) for each in lips]
    for scheme in dict.fromkeys(name for each in lips for name in each.schemes):
        made_by_scheme = [k for k, each in enumerate(lips) if scheme in each.schemes]
        for measure in MEASURES:
            used = [k for k in made_by_scheme if _measured(lips[k].clip, measure)]
            if not used:
                continue
            made = [lips[k].schemes[scheme] for k in used]
            acoustic = [lips[k].acoustic_closures_s for k in used]
            real = [real_closures[k] for k in used]
            joined = []
            for lag_s in lags:
                pairs = [
                    _aligned(lips[k].clip, frames, measure, float(lag_s))
                    for k, frames in zip(used, made, strict=True)
                ]
                joined.append([np.concatenate(side) for side in zip(*pairs, strict=True)])
            correlations = [_correlation(a, b) for a, b in joined]
            best = max(
                (
                    (value, float(lag_s))
                    for value, lag_s in zip(correlations, lags, strict=True)
                    if value is not None
                ),
                default=(None, None),
            )
            scores.append(
                LipScore(
                    scheme=scheme,
                    group=group,
                    measure=measure,
                    num_clips=len(used),
                    correlation=correlations[here],
                    best_lag_ms=None if best[1] is None else round(1e3 * best[1]),
                    best_correlation=best[0],
                    rmse=float(np.sqrt(np.mean((joined[here][0] - joined[here][1]) ** 2))),
                    bpm_met=sum(map(_met, acoustic, made)),
                    bpm=sum(map(len, acoustic)),
                    closures_met=sum(map(_met, real, made)),
                    closures=sum(map(len, real)),
                )
            )
    return scores


def _correlation(a: Array, b: Array) -> float | None:
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else None


def clips_to_score(folder: Path, parameters: Path | None) -> list[LipClip]:
    """Clips of a folder that some parameters were neither learnt from nor chosen with.

    Raises
    ------
    UserError
        There are none.
    """
    seen = clips_seen(parameters)
    clips = [clip for clip in read_clips(folder) if clip.name not in seen]
    if not clips:
        raise UserError(
            f"{folder}: the parameters were learnt from or chosen with every clip; give other clips"
        )
    measured = [clip for clip in clips if any(_measured(clip, name) for name in MEASURES)]
    if not measured:
        raise UserError(
            f"{folder}: no clip measures lip opening (FAP 4 and 5), mouth width (FAP 6 and 7) or "
            "jaw (FAP 3); add such columns"
        )
    return measured


def main(folder: Path, parameters: Path | None = None) -> list[LipScore]:
    """Score lips, print tables and return the scores."""
    model, viseme_parameters = load_model(), load_parameters(parameters)
    lips = [
        lips_of_clip(model, viseme_parameters, clip)
        for clip in track(clips_to_score(folder, parameters), description="clips", transient=True)
    ]
    groups: dict[str, list[ClipLips]] = {"all": lips}
    for each in lips:
        groups.setdefault(each.clip.speaker, []).append(each)
    scores = [
        score
        for group, members in groups.items()
        if group == "all" or len(groups) > 2
        for score in score_clips(group, members)
    ]
    console = Console()
    for measure in MEASURES:
        table = Table(title=f"{measure}: correlation (best at lag), error in FAP units")
        for column in (
            "group", "scheme", "clips", "r", "best r", "lag ms", "rmse", "b p m", "closures",
        ):  # fmt: skip
            table.add_column(column, no_wrap=True)
        for score in scores:
            if score.measure == measure:
                table.add_row(
                    score.group,
                    score.scheme,
                    str(score.num_clips),
                    _figure(score.correlation, ".2f"),
                    _figure(score.best_correlation, ".2f"),
                    _figure(score.best_lag_ms, ".0f"),
                    f"{score.rmse:.0f}",
                    f"{score.bpm_met}/{score.bpm}",
                    f"{score.closures_met}/{score.closures}",
                )
        if table.row_count:
            console.print(table)
    return scores


def _figure(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
