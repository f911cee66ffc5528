"""The model card of the lip model: data, licenses and scores on held-out clips.

The correlations of opening, width and jaw pool the frames of all clips, after removing each clip's
means. Outside speech the model gives no lips, and the mouth counts as at rest.

The tracked lips close at a minimum of their opening within the lowest tenth of the speaker's range,
if they open to half of the range nearby. The model predicts a closure where its probability is
above one half. A tracked closure is found if one is predicted within 40 ms. A predicted closure is
correct if the tracked lips touch within 40 ms.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.services.mouth_profiles.lip_tracks import (
    MEASURES,
    correlate_curves,
    lip_measures,
    lip_tracks,
)
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.lip_predictor import CLOSURE, LipPredictor
from kouxing.training.lips.positions import Speech
from kouxing.training.lips.recurrent import Example
from kouxing.training.lips.targets import Touch, opening, touches

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_TO_REST_S = 0.06  # after the last lip frame
_CLOSURE_WINDOW_S = 0.04
_OPEN_WINDOW_S = 0.2


@dataclass(frozen=True, slots=True)
class Prediction:
    """What the model predicts for a stretch of speech."""

    known_s: Array  # (positions,)
    outputs: Floats  # (positions, delays, 17), FAPs in FAP units, then log odds


Predictions = Mapping[str, Sequence[Prediction]]  # by clip


def correlations(
    clips: Sequence[LipClip], predictions: Predictions, delay: int, delay_s: float
) -> Array:
    """Correlate the three measures at one delay; NaN if a measure is not tracked."""
    return correlate_curves(
        [_compare(clip, predictions[clip.name], delay, delay_s) for clip in clips]
    )


def _compare(
    clip: LipClip, predictions: Sequence[Prediction], delay: int, delay_s: float
) -> tuple[Array, Array]:
    """Return the predicted and the tracked measures at the clip's frames, (num_frames, 3)."""
    rest = np.zeros((1, len(MEASURES)))
    times, values = [np.array([-1.0])], [rest]
    for prediction in predictions:
        time_s = prediction.known_s - delay_s
        times += [time_s[:1] - _TO_REST_S, time_s, time_s[-1:] + _TO_REST_S]
        values += [rest, lip_measures(prediction.outputs[:, delay]), rest]
    time_s = np.concatenate(times)
    order = np.argsort(time_s, kind="stable")
    curves = np.concatenate(values)[order].T
    predicted = [np.interp(clip.time_s, time_s[order], curve) for curve in curves]
    return np.stack(predicted, axis=1), lip_measures(lip_tracks(clip.faps))


@dataclass(slots=True)
class ClosureCounts:
    """Closures of some clips."""

    tracked: int = 0
    found: int = 0
    predicted: int = 0
    correct: int = 0

    @property
    def recall(self) -> float:
        """Fraction of the tracked closures that are found."""
        return self.found / max(self.tracked, 1)

    @property
    def precision(self) -> float:
        """Fraction of the predicted closures that are correct."""
        return self.correct / max(self.predicted, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of recall and precision."""
        return 2 * self.recall * self.precision / max(self.recall + self.precision, 1e-9)


def count_closures(
    clips: Sequence[LipClip],
    predictions: Predictions,
    touch: Mapping[str, Touch],
    delay: int,
    delay_s: float,
) -> ClosureCounts:
    """Count the closures within speech at one delay."""
    counts = ClosureCounts()
    for clip in clips:
        limits = touch[clip.speaker]
        height = opening(clip)
        known = ~np.isnan(height)
        frame_s, height = clip.time_s[known], height[known]
        touching_s = frame_s[height < limits.closed_below]
        closures_s = _closures(frame_s, height, limits)
        for prediction in predictions[clip.name]:
            time_s = prediction.known_s - delay_s
            is_closed = prediction.outputs[:, delay, CLOSURE] > 0
            within = (closures_s >= time_s[0]) & (closures_s <= time_s[-1])
            counts.tracked += int(within.sum())
            counts.found += sum(_is_near(at_s, time_s[is_closed]) for at_s in closures_s[within])
            for run_s in _runs(time_s, is_closed):
                if len(frame_s) and frame_s[0] <= run_s[0] and run_s[-1] <= frame_s[-1]:
                    counts.predicted += 1
                    counts.correct += any(_is_near(at_s, touching_s) for at_s in run_s)
    return counts


def _closures(frame_s: Array, height: Array, limits: Touch) -> Array:
    times = []
    for frame in range(1, len(height) - 1):
        before, now, after = height[frame - 1 : frame + 2]
        if now <= before and now < after and now < limits.closed_below:
            near = np.abs(frame_s - frame_s[frame]) < _OPEN_WINDOW_S
            if height[near].max() > limits.half_open:
                times.append(frame_s[frame])
    return np.array(times)


def _runs(time_s: Array, is_closed: NDArray[np.bool_]) -> list[Array]:
    edges = np.flatnonzero(np.diff(is_closed)) + 1
    return [time_s[start:end] for start, end in pairwise(edges) if is_closed[start]]


def _is_near(at_s: float, times_s: Array) -> bool:
    return bool((np.abs(times_s - at_s) <= _CLOSURE_WINDOW_S).any())


_ABOUT = Path(__file__).with_name("about.md")  # the description of every model of this recipe


def write_card(
    output: Path,
    model: LipPredictor,
    clips: Sequence[LipClip],
    speech: Mapping[str, Sequence[Speech]],
    *,
    trained_on: Sequence[LipClip],
    labeled: Sequence[Example],
    losses: Sequence[float],
    seed: int,
) -> None:
    """Write the card of the model in ``output``, with the suffix ``.md``.

    ``clips`` are all clips, ``speech`` their stretches of speech. ``labeled`` are examples of the
    teacher, ``losses`` those of each epoch.
    """
    held = [clip for clip in clips if clip.part == "held"]
    known_speakers = {clip.speaker for clip in trained_on}
    groups: dict[str, list[LipClip]] = defaultdict(list)
    for clip in held:
        known = "also in training" if clip.speaker in known_speakers else "not in training"
        groups[f"{clip.language}, all held clips"].append(clip)
        groups[f"{clip.language}, speakers {known}"].append(clip)
        groups[f"{clip.language}, {clip.speaker} ({known})"].append(clip)
    predictions = {clip.name: predict(model, speech[clip.name]) for clip in held}
    touch = touches(clips)
    correlation_rows, closure_rows = [], []
    for name, members in groups.items():
        correlation_row: list[object] = [name, len(members)]
        closure_row: list[object] = [name, 0]
        for delay in enumerate(model.delays_s):
            figures = correlations(members, predictions, *delay)
            cells = ("-" if np.isnan(figure) else f"{figure:.2f}" for figure in figures)
            correlation_row.append(" / ".join(cells))
            count = count_closures(members, predictions, touch, *delay)
            closure_row[1] = count.tracked if delay[0] == 0 else closure_row[1]
            closure_row.append(f"{count.f1:.2f} ({count.recall:.2f}, {count.precision:.2f})")
        correlation_rows.append(correlation_row)
        closure_rows.append(closure_row)
    by_license: dict[str, list[LipClip]] = defaultdict(list)
    for clip in trained_on:
        by_license[clip.license].append(clip)
    data_rows = [
        [
            name,
            len(group),
            len({clip.speaker for clip in group}),
            ", ".join(sorted({clip.language for clip in group})),
            f"{sum(len(clip.samples) for clip in group) / SAMPLE_RATE_HZ:.0f}",
        ]
        for name, group in sorted(by_license.items())
    ]
    delays = [f"{1e3 * delay_s:.0f} ms" for delay_s in model.delays_s]
    options, teacher = "", ""
    if labeled:
        options = " --speech DIR --whisper DIR"
        hours = sum(len(example.components) for example in labeled) * POSITION_S / 3600
        teacher = f"The teacher labeled {hours:.1f} hours of speech, {len(labeled)} stretches.\n\n"
    text = f"""\
# Lip model

{_ABOUT.read_text(encoding="utf-8").rstrip()}

Made by `kouxing train lips --clips DIR{options} --seed {seed}`. `training/lips/recipe.py`
describes the training, `services/recognizer/lip_predictor.py` the model.

## Data

{_table(["license of the clips", "clips", "speakers", "languages", "seconds"], data_rows)}

{teacher}Mean training loss of each epoch: {", ".join(f"{loss:.3f}" for loss in losses)}.

## Held-out clips

Correlation of opening / width / jaw, after removing each clip's means. The mouth is at
rest outside speech.

{_table(["held-out clips", "clips", *delays], correlation_rows)}

## Closures within speech

F1 (recall, precision).

{_table(["held-out clips", "closures", *delays], closure_rows)}
"""
    output.with_suffix(".md").write_text(text, encoding="utf-8")


def predict(model: LipPredictor, speech: Sequence[Speech]) -> list[Prediction]:
    """Run the model over stretches of speech, as a session does."""
    stream = model.create_stream(model.delays_s)
    predictions = []
    for stretch in speech:
        stream.reset()
        rows = [stream.step(row) for row in stretch.features.astype(np.float32)]
        predictions.append(Prediction(stretch.known_s, np.stack(rows)))
    return predictions


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(map(str, cells))} |" for cells in lines)
