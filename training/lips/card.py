"""The model card of lips from sound: data, licences, curves, scores, speakers left out."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.lips import LIP_FAPS, NUM_OUTPUTS, LipPredictor
from kouxing.training.lips.positions import Speech, components_of
from kouxing.training.lips.recurrent import Example
from kouxing.training.lips.ridge import Products, history_of
from kouxing.training.lips.scores import Made, Stretch, correlations, count_closures
from kouxing.training.lips.targets import touches

Floats = NDArray[np.float32]

_ABOUT = Path(__file__).with_name("about.md")  # what no figure says, and what others measured
_SHOWN_FAPS = [LIP_FAPS.index(fap) for fap in (3, 4, 5, 6)]  # of opening, width and jaw


@dataclass(frozen=True, slots=True)
class Trained:
    """A model and what it was made from."""

    model: LipPredictor
    losses: list[float]  # of each epoch
    clips: Sequence[LipClip]
    speech: Sequence[Speech]  # of the clips as they are
    targets: Sequence[Floats]  # of each stretch, FAP units, (positions, delays, 17)
    labelled: Sequence[Example]  # by a teacher, besides
    seed: int


def write_card(
    output: Path,
    trained: Trained,
    clips: Sequence[LipClip],
    speech: Mapping[str, Sequence[Speech]],
) -> None:
    """Write the card beside the model.

    Parameters
    ----------
    output
        The model's file; the card has the same name and the suffix ``.md``.
    trained
        The model.
    clips
        All clips, also those that are held out.
    speech
        Stretches of speech of each clip.
    """
    held = [clip for clip in clips if clip.part == "held"]
    heard = {clip.speaker for clip in trained.clips}
    made = {clip.name: lips_of(trained.model, speech[clip.name]) for clip in held}
    groups: dict[str, list[LipClip]] = defaultdict(list)
    for clip in held:
        known = "also in training" if clip.speaker in heard else "not in training"
        groups[f"{clip.language}, all held clips"].append(clip)
        groups[f"{clip.language}, speakers {known}"].append(clip)
        groups[f"{clip.language}, {clip.speaker} ({known})"].append(clip)
    options = " --speech DIR --whisper DIR" if trained.labelled else ""
    lines = [
        "# Lips from sound",
        "",
        *_ABOUT.read_text(encoding="utf-8").splitlines(),
        "",
        f"Made by `kouxing train lips --clips DIR{options} --seed {trained.seed}`. See",
        "`training/lips/recipe.py` for how and `services/recognizer/lips.py` for what it computes.",
        "",
        "## Data",
        "",
        *_data_table(trained.clips),
        "",
        *(_labelled(trained.labelled) if trained.labelled else []),
        "Mean training loss of each epoch: "
        + ", ".join(f"{loss:.3f}" for loss in trained.losses)
        + ".",
        "",
        "## Held clips",
        "",
        "Correlation of opening / width / jaw, each clip's own means removed, frames pooled; at",
        "rest outside speech.",
        "",
        *_score_table(groups, made, trained.model.delays_s, in_speech=False),
        "",
        "Within speech only:",
        "",
        *_score_table(groups, made, trained.model.delays_s, in_speech=True),
        "",
        "## Closures on held clips, within speech",
        "",
        *_closure_table(clips, groups, made, trained.model.delays_s),
        "",
        "## Speakers left out",
        "",
        "The linear part alone, trained without augmentation on all other speakers; the recurrent",
        "part would take minutes a speaker. All clips of the speaker that are not held.",
        "",
        *_left_out_table(trained),
    ]
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def lips_of(model: LipPredictor, speech: Sequence[Speech]) -> list[Stretch]:
    """Run the model over stretches of speech, as a session does."""
    stream = model.stream(model.delays_s)
    stretches = []
    for each in speech:
        stream.reset()
        rows = [stream.step(row) for row in each.features.astype(np.float32)]
        stretches.append(Stretch(each.known_s, np.stack(rows)))
    return stretches


def _data_table(clips: Sequence[LipClip]) -> list[str]:
    by_licence: dict[str, list[LipClip]] = defaultdict(list)
    for clip in clips:
        by_licence[clip.licence].append(clip)
    return [
        "| licence of the clips | clips | speakers | languages | seconds |",
        "|---|---|---|---|---|",
        *(
            f"| {licence} | {len(group)} | {len({clip.speaker for clip in group})} | "
            f"{', '.join(sorted({clip.language for clip in group}))} | "
            f"{sum(len(clip.samples) for clip in group) / SAMPLE_RATE_HZ:.0f} |"
            for licence, group in sorted(by_licence.items())
        ),
    ]


def _labelled(examples: Sequence[Example]) -> list[str]:
    hours = sum(len(each.components) for each in examples) * POSITION_S / 3600
    return [
        f"A teacher labelled {hours:.1f} hours of speech without lips, {len(examples)} stretches.",
        "",
    ]


def _score_table(
    groups: Mapping[str, Sequence[LipClip]],
    made: Made,
    delays_s: Sequence[float],
    *,
    what: str = "held clips",
    in_speech: bool,
) -> list[str]:
    rows = []
    for name, clips in groups.items():
        cells = (
            _figures(correlations(clips, made, delay, delay_s, in_speech=in_speech))
            for delay, delay_s in enumerate(delays_s)
        )
        rows.append(f"| {name} | {len(clips)} | {' | '.join(cells)} |")
    return [*_head(f"{what} | clips", delays_s), *rows]


def _closure_table(
    clips: Sequence[LipClip],
    groups: Mapping[str, Sequence[LipClip]],
    made: Made,
    delays_s: Sequence[float],
) -> list[str]:
    touch = touches(clips)
    rows = []
    for name, members in groups.items():
        counts = [
            count_closures(members, made, touch, delay, delay_s)
            for delay, delay_s in enumerate(delays_s)
        ]
        cells = (f"{each.f1:.2f} ({each.recall:.2f}, {each.precision:.2f})" for each in counts)
        rows.append(f"| {name} | {counts[0].real} | {' | '.join(cells)} |")
    return ["F1 (recall, precision).", "", *_head("held clips | closures", delays_s), *rows]


def _left_out_table(trained: Trained) -> list[str]:
    """Score every speaker with the linear part trained on all others."""
    if len({clip.speaker for clip in trained.clips}) == 1:
        return ["There is one speaker only."]
    model = trained.model
    stretches: dict[str, list[tuple[Speech, Floats]]] = defaultdict(list)
    products: dict[str, Products] = {}
    for speech, target in zip(trained.speech, trained.targets, strict=True):
        history = history_of(components_of(speech, model.feature_mean, model.projection))
        speaker = speech.clip.speaker
        stretches[speaker].append((speech, history))
        wanted = target[:, :, _SHOWN_FAPS].reshape(len(target), -1)
        known = ~np.isnan(wanted).any(axis=1)
        here = Products.of(history[known], wanted[known])
        products[speaker] = products[speaker] + here if speaker in products else here
    total = reduce(add, products.values())
    rows: list[tuple[str, list[LipClip]]] = []
    everything: dict[str, list[Stretch]] = {}
    by_language: dict[str, list[LipClip]] = defaultdict(list)
    for speaker, own in products.items():
        weights = (total - own).solve()
        made: dict[str, list[Stretch]] = defaultdict(list)
        for speech, history in stretches[speaker]:
            outputs = np.zeros((len(history), len(model.delays), NUM_OUTPUTS), np.float32)
            outputs[:, :, _SHOWN_FAPS] = (history @ weights).reshape(*outputs.shape[:2], -1)
            made[speech.clip.name].append(Stretch(speech.known_s, outputs))
        clips = [clip for clip in trained.clips if clip.name in made]
        by_language[clips[0].language] += clips
        everything.update(made)
        rows.append((f"{clips[0].language}, {speaker}", clips))
    rows += [(f"{language}, all", clips) for language, clips in by_language.items()]
    return _score_table(
        dict(rows), everything, model.delays_s, what="speaker left out", in_speech=False
    )


def _head(first: str, delays_s: Sequence[float]) -> list[str]:
    delays = " | ".join(f"{1e3 * delay_s:.0f} ms" for delay_s in delays_s)
    return [f"| {first} | {delays} |", f"|{'---|' * (2 + len(delays_s))}"]


def _figures(values: NDArray[np.floating]) -> str:
    return " / ".join("-" if np.isnan(value) else f"{value:.2f}" for value in values)
