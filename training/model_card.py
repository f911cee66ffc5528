"""The model card, which states what a model was trained on."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.training.search_weights import SearchWeights
from kouxing.training.training_set import FRAMES_PER_MINUTE, Example


def write_card(
    output: Path,
    *,
    title: str,
    details: str,
    examples: Sequence[Example],
    errors: RowErrors,
    chosen: SearchWeights | None,
) -> None:
    """Write the card of the model in ``output``, with the suffix ``.md``.

    ``details`` describe the training as part of a sentence. ``chosen`` are the search weights, if
    they were chosen on development data.
    """
    by_license: dict[str, list[Example]] = defaultdict(list)
    for example in examples:
        by_license[example.license or "none given"].append(example)
    rows = [
        f"| {name} | {len(group)} | {len({example.speaker for example in group})} | "
        f"{sum(len(example.log_mel) for example in group) / FRAMES_PER_MINUTE:.1f} |"
        for name, group in sorted(by_license.items())
    ]
    lines = [
        f"# {title}",
        "",
        f"Made by `kouxing train`, {details}.",
        "",
        "| license of the recordings | recordings | speakers | minutes without outer silence |",
        "|---|---|---|---|",
        *rows,
        "",
        f"{len(errors.messages)} rows were skipped.",
    ]
    if chosen:
        lines += [
            "",
            f"Chosen on dev: acoustic scale {chosen.acoustic_scale}, phone penalty "
            f"{chosen.phone_penalty}; phone error rate there {100 * chosen.error_rate:.1f} %.",
        ]
    output.with_suffix(".md").write_text("\n".join(lines) + "\n", encoding="utf-8")
