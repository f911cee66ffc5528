"""The model card of the lip model: data, licenses and scores on held-out clips."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.lip_predictor import LipPredictor
from kouxing.training.lips.positions import Speech
from kouxing.training.lips.recurrent import Example
from kouxing.training.lips.scores import Prediction, correlations, count_closures
from kouxing.training.lips.targets import touches

_ABOUT = Path(__file__).with_name("about.md")  # the description of every model of this recipe


@dataclass(frozen=True, slots=True)
class Trained:
    """A model and its training data."""

    model: LipPredictor
    losses: list[float]  # of each epoch
    clips: Sequence[LipClip]
    labeled: Sequence[Example]  # by the teacher
    seed: int


def write_card(
    output: Path, trained: Trained, clips: Sequence[LipClip], speech: Mapping[str, Sequence[Speech]]
) -> None:
    """Write the card of the model in ``output``, with the suffix ``.md``.

    ``clips`` are all clips, including those that are held out, and ``speech`` their stretches of
    speech.
    """
    held = [clip for clip in clips if clip.part == "held"]
    known_speakers = {clip.speaker for clip in trained.clips}
    groups: dict[str, list[LipClip]] = defaultdict(list)
    for clip in held:
        known = "also in training" if clip.speaker in known_speakers else "not in training"
        groups[f"{clip.language}, all held clips"].append(clip)
        groups[f"{clip.language}, speakers {known}"].append(clip)
        groups[f"{clip.language}, {clip.speaker} ({known})"].append(clip)
    predictions = {clip.name: predict(trained.model, speech[clip.name]) for clip in held}
    touch = touches(clips)
    delays_s = trained.model.delays_s
    correlation_rows, closure_rows = [], []
    for name, members in groups.items():
        figures = [correlations(members, predictions, *delay) for delay in enumerate(delays_s)]
        counts = [
            count_closures(members, predictions, touch, *delay) for delay in enumerate(delays_s)
        ]
        f1 = [f"{count.f1:.2f} ({count.recall:.2f}, {count.precision:.2f})" for count in counts]
        correlation_rows.append([name, len(members), *map(_join, figures)])
        closure_rows.append([name, counts[0].tracked, *f1])
    delays = [f"{1e3 * delay_s:.0f} ms" for delay_s in delays_s]
    options = " --speech DIR --whisper DIR" if trained.labeled else ""
    lines = [
        "# Lip model",
        "",
        *_ABOUT.read_text(encoding="utf-8").splitlines(),
        "",
        f"Made by `kouxing train lips --clips DIR{options} --seed {trained.seed}`. "
        "`training/lips/recipe.py`",
        "describes the training, `services/recognizer/lip_predictor.py` the model.",
        "",
        "## Data",
        "",
        *_table(["license of the clips", "clips", "speakers", "languages", "seconds"],
                _data_rows(trained.clips)),
        "",
        *(_labeled(trained.labeled) if trained.labeled else []),
        "Mean training loss of each epoch: "
        + ", ".join(f"{loss:.3f}" for loss in trained.losses)
        + ".",
        "",
        "## Held-out clips",
        "",
        "Correlation of opening / width / jaw, after removing each clip's means. The mouth is at",
        "rest outside speech.",
        "",
        *_table(["held-out clips", "clips", *delays], correlation_rows),
        "",
        "## Closures within speech",
        "",
        "F1 (recall, precision).",
        "",
        *_table(["held-out clips", "closures", *delays], closure_rows),
    ]  # fmt: skip
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def predict(model: LipPredictor, speech: Sequence[Speech]) -> list[Prediction]:
    """Run the model over stretches of speech, as a session does."""
    stream = model.create_stream(model.delays_s)
    predictions = []
    for stretch in speech:
        stream.reset()
        rows = [stream.step(row) for row in stretch.features.astype(np.float32)]
        predictions.append(Prediction(stretch.known_s, np.stack(rows)))
    return predictions


def _data_rows(clips: Sequence[LipClip]) -> list[list[object]]:
    by_license: dict[str, list[LipClip]] = defaultdict(list)
    for clip in clips:
        by_license[clip.license].append(clip)
    return [
        [
            name,
            len(group),
            len({clip.speaker for clip in group}),
            ", ".join(sorted({clip.language for clip in group})),
            f"{sum(len(clip.samples) for clip in group) / SAMPLE_RATE_HZ:.0f}",
        ]
        for name, group in sorted(by_license.items())
    ]


def _labeled(examples: Sequence[Example]) -> list[str]:
    hours = sum(len(example.components) for example in examples) * POSITION_S / 3600
    return [f"The teacher labeled {hours:.1f} hours of speech, {len(examples)} stretches.", ""]


def _table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    lines = [head, ["---"] * len(head), *rows]
    return [f"| {' | '.join(map(str, cells))} |" for cells in lines]


def _join(values: NDArray[np.floating]) -> str:
    return " / ".join("-" if np.isnan(value) else f"{value:.2f}" for value in values)
