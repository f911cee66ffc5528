"""The model card, which states what a model was trained on."""

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.shared.command.terminal import write_text


class LicensedRecording(Protocol):
    """What the card reports about a recording."""

    @property
    def license(self) -> str:
        """License; empty if unknown."""

    @property
    def speaker(self) -> str:
        """Name of the speaker."""

    @property
    def minutes(self) -> float:
        """Duration."""


def write_card(
    output: Path,
    *,
    title: str,
    details: str,
    recordings: Sequence[LicensedRecording],
    errors: RowErrors | None = None,
    notes: str = "",
) -> None:
    """Write the card of the model in ``output``, with the suffix ``.md``.

    ``details`` describe the training as part of a sentence.
    """
    by_license: dict[str, list[LicensedRecording]] = defaultdict(list)
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
