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
never quite at 0. Closures: how many of the clip's real closures (opening within a tenth of its
range from its least, at a minimum) are met by closed synthesized lips within 60 ms.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.load import load_model
from services.recognizer.pipeline import Recognizer, recognize
from services.synthesizer.full import synthesize
from services.synthesizer.live import LiveSynthesizer
from services.synthesizer.parameters import VisemeParameters, load_parameters
from services.synthesizer.visemes import MOUTH_FAPS
from shared.faps import NUM_FAPS
from shared.phones import Phone
from training.align import align_text
from training.visemes import LipClip, read_clips

Array = NDArray[np.float64]

LOOK_AHEADS_S = (0.0, 0.05, 0.1, 0.2, 0.3)
FRAME_RATE_HZ = 50.0
_LONGEST_LAG_S = 0.3
_CHUNK_SAMPLES = 160  # sound comes 10 ms at a time
_CLOSED_SHARE = 0.1
_CLOSURE_WINDOW_S = 0.06
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
    correlation: float
    best_lag_ms: float
    best_correlation: float
    rmse: float  # FAP units, own means removed
    closures_met: int
    closures: int


def live_frames(
    model: AcousticModel,
    parameters: VisemeParameters,
    samples: NDArray[np.float32],
    look_ahead_s: float,
    wait_for_next: bool,
) -> Array:
    """Frames (num_frames, 68) of the live system, fed as the sound would arrive."""
    recognizer = Recognizer(model, sample_rate_hz=16_000)
    live = LiveSynthesizer(parameters, frame_rate_hz=FRAME_RATE_HZ, look_ahead_s=look_ahead_s)
    frames = []
    for start in range(0, len(samples), _CHUNK_SAMPLES):
        chunk = samples[start : start + _CHUNK_SAMPLES]
        for said in recognizer.accept_waveform(chunk):
            if not isinstance(said, Phone):
                live.accept_speech(said)
            elif said.final or not wait_for_next:
                live.accept_phone(said)
        frames += live.advance((start + len(chunk)) / 16_000)
    for said in recognizer.input_finished():
        if isinstance(said, Phone):
            live.accept_phone(said)
        else:
            live.accept_speech(said)
    frames += live.advance(len(samples) / 16_000 + look_ahead_s)
    return np.array([faps for _, faps in frames], dtype=float)


def loudness_frames(samples: NDArray[np.float32]) -> Array:
    """Frames (num_frames, 68) of a mouth that opens with the level, 0 to 1 over 40 dB."""
    hop = int(16_000 / FRAME_RATE_HZ)
    num_frames = len(samples) // hop + 1
    padded = np.pad(samples.astype(float), (hop, 2 * hop))
    power = [np.mean(padded[k * hop : (k + 2) * hop] ** 2) for k in range(num_frames)]
    level_db = 10.0 * np.log10(np.array(power) + 1e-10)
    level = np.clip((level_db - np.percentile(level_db, 95)) / 40.0 + 1.0, 0.0, 1.0)
    level = np.convolve(level, np.hanning(7) / np.hanning(7).sum(), mode="same")
    faps = np.zeros((num_frames, NUM_FAPS))
    faps[:, 2], faps[:, 4] = 300.0 * level, -600.0 * level
    return faps


def frames_of_schemes(
    model: AcousticModel, parameters: VisemeParameters, clip: LipClip
) -> dict[str, Array]:
    """Frames of every scheme and baseline for a clip, each (num_frames, 68)."""
    num_frames = int(len(clip.samples) / 16_000 * FRAME_RATE_HZ) + 1

    def full(phones: Sequence[Phone]) -> Array:
        return synthesize(parameters, phones, num_frames, FRAME_RATE_HZ).astype(float)

    schemes = {}
    if clip.transcript:
        schemes["1 aligned"] = full(align_text(model, clip.samples, 16_000, clip.transcript))
    schemes["2 recognised"] = full(recognize(model, clip.samples, 16_000))
    for look_ahead_s in LOOK_AHEADS_S:
        schemes[f"3 live {1e3 * look_ahead_s:.0f} ms"] = live_frames(
            model, parameters, clip.samples, look_ahead_s, wait_for_next=False
        )
    schemes["4 next unit"] = live_frames(model, parameters, clip.samples, 0.05, wait_for_next=True)
    schemes["loudness"] = loudness_frames(clip.samples)
    schemes["mean mouth"] = np.zeros((num_frames, NUM_FAPS))
    schemes["mean mouth"][:, 4] = -_MEAN_OPENING
    return schemes


def _real_faps(clip: LipClip) -> Array:
    faps = np.full((len(clip.time_s), NUM_FAPS), np.nan)
    faps[:, np.array(MOUTH_FAPS) - 1] = clip.faps
    return faps


def _aligned(clip: LipClip, frames: Array, measure: str, lag_s: float) -> tuple[Array, Array]:
    """Synthesized and real values at the clip's frames, means removed."""
    real = MEASURES[measure](_real_faps(clip))
    known = ~np.isnan(real)
    values = MEASURES[measure](frames)
    times = np.arange(len(values)) / FRAME_RATE_HZ
    made = np.interp(clip.time_s[known] + lag_s, times, values)
    return made - made.mean(), real[known] - real[known].mean()


def _closures(clip: LipClip, frames: Array) -> tuple[int, int]:
    """Real closures that are met, and all real closures."""
    real = MEASURES["opening"](_real_faps(clip))
    low, high = np.nanpercentile(real, [1, 99])
    made = MEASURES["opening"](frames)
    times = np.arange(len(made)) / FRAME_RATE_HZ
    closed = times[made < _CLOSED_SHARE * max(np.percentile(made, 99), 1.0)]
    before, here, after = real[:-2], real[1:-1], real[2:]
    shut = (here <= before) & (here < after) & (here < low + _CLOSED_SHARE * (high - low))
    # a mouth that is shut for long is a pause, no closure
    moments = [
        time_s
        for time_s in clip.time_s[1:-1][shut]
        if np.nanmax(real[np.abs(clip.time_s - time_s) < 0.2]) > low + 0.5 * (high - low)
    ]
    met = sum(bool((np.abs(closed - time_s) <= _CLOSURE_WINDOW_S).any()) for time_s in moments)
    return met, len(moments)


def score_clips(clips: Sequence[LipClip], frames: Sequence[dict[str, Array]]) -> list[LipScore]:
    """Score every scheme over a group of clips, all frames pooled."""
    scores = []
    lags = np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S + 0.005, 0.01)
    for scheme in dict.fromkeys(name for schemes in frames for name in schemes):
        used = [
            (clip, schemes[scheme])
            for clip, schemes in zip(clips, frames, strict=True)
            if scheme in schemes
        ]
        closures = np.array([_closures(clip, made) for clip, made in used]).sum(axis=0)
        for measure in MEASURES:
            pooled = [
                [_aligned(clip, made, measure, float(lag_s)) for clip, made in used]
                for lag_s in lags
            ]
            joined = [
                (np.concatenate([a for a, _ in pairs]), np.concatenate([b for _, b in pairs]))
                for pairs in pooled
            ]
            correlations = [_correlation(a, b) for a, b in joined]
            best, here = int(np.argmax(correlations)), len(lags) // 2
            scores.append(
                LipScore(
                    scheme=scheme,
                    group=clips[0].name.split("_")[0],
                    measure=measure,
                    num_clips=len(used),
                    correlation=correlations[here],
                    best_lag_ms=round(1e3 * float(lags[best])),
                    best_correlation=correlations[best],
                    rmse=float(np.sqrt(np.mean((joined[here][0] - joined[here][1]) ** 2))),
                    closures_met=int(closures[0]),
                    closures=int(closures[1]),
                )
            )
    return scores


def _correlation(a: Array, b: Array) -> float:
    size = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / size if size > 0.0 else 0.0


def main(folder: Path, output: Path | None = None, parameters: Path | None = None) -> None:
    """Score lips on all Mandarin clips of ``folder`` that are not for training."""
    model, viseme_parameters = load_model(), load_parameters(parameters)
    groups: dict[str, list[LipClip]] = {}
    for clip in read_clips(folder):
        if clip.is_held or not clip.is_rig:
            groups.setdefault(clip.name.split("_")[0], []).append(clip)
    scores = []
    for clips in groups.values():
        frames = [
            frames_of_schemes(model, viseme_parameters, clip)
            for clip in track(clips, description=clips[0].speaker)
        ]
        scores += score_clips(clips, frames)
    console = Console()
    for measure in MEASURES:
        table = Table(title=f"{measure}: correlation (best at lag), error in FAP units")
        for column in ("group", "scheme", "clips", "r", "best r", "lag ms", "rmse", "closures"):
            table.add_column(column)
        for score in scores:
            if score.measure == measure:
                table.add_row(
                    score.group,
                    score.scheme,
                    str(score.num_clips),
                    f"{score.correlation:.2f}",
                    f"{score.best_correlation:.2f}",
                    f"{score.best_lag_ms:.0f}",
                    f"{score.rmse:.0f}",
                    f"{score.closures_met}/{score.closures}",
                )
        console.print(table)
    if output is not None:
        output.write_text(json.dumps([asdict(score) for score in scores], indent=1) + "\n")
