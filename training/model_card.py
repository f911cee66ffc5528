"""The model card, which states what a model was trained on."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from kouxing.corpora.emotions import EmotionRecording
from kouxing.corpora.lip_clips import LipClip
from kouxing.corpora.speech_corpus import RowErrors, Utterance
from kouxing.shared.terminal import write_text
from kouxing.training.training_set import Example


def write_card(
    output: Path,
    *,
    title: str,
    details: str,
    recordings: Sequence[Example]
    | Sequence[LipClip]
    | Sequence[Utterance]
    | Sequence[EmotionRecording],
    errors: RowErrors | None = None,
    notes: str = "",
) -> None:
    """Write the card of the model in ``output``, with the suffix ``.md``.

    ``details`` describe the training as part of a sentence.
    """
    by_license: dict[str, list[Example | LipClip | Utterance | EmotionRecording]] = defaultdict(
        list
    )
    for recording in recordings:
        by_license[recording.license or "none given"].append(recording)
    rows = [
        f"| {name} | {len(group)} | {len({recording.speaker for recording in group})} | "
        f"{sum(recording.minutes for recording in group):.1f} |"
        for name, group in sorted(by_license.items())
    ]
    lines = [
        f"# {title}",
        "",
        f"Made by `kouxing train`, {details}.",
        "",
        "| license of the recordings | recordings | speakers | minutes |",
        "|---|---|---|---|",
        *rows,
    ]
    if errors:
        lines += ["", f"{len(errors.messages)} rows were skipped."]
    if notes:
        lines += ["", notes]
    write_text(output.with_suffix(".md"), "\n".join(lines) + "\n")
