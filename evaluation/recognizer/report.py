"""Print the recognizer's figures as a table."""

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import Console

from kouxing.evaluation.recognizer.error_rates import HYPOTHESES
from kouxing.evaluation.tables import letters_of, percent
from kouxing.shared.terminal import plural, print_table

Figures = Mapping[str, Any]  # result of evaluate_recognizer


def print_figures(results: Mapping[str, Figures], split: str, console: Console) -> None:
    """Print one table. ``results`` contains the figures of each model by its name."""
    letters, legend = letters_of(list(results))
    first = next(iter(results.values()))
    print_table(
        console,
        f"{split}: {plural(first['recordings'], 'recording')}, "
        f"{plural(first['speakers'], 'speaker')}. {legend}\n"
        "phone/viseme errors, %, of universal phones also features;\n"
        "delay of the first hypothesis, p50/p95, ms;\n"
        "p b m f of the final hypothesis, recall/precision, %; /s: clean, syllables/s",
        ("speech", "", "phones", *HYPOTHESES, "delay", "p b m f"),
        _rows(results, letters),
    )


def _rows(results: Mapping[str, Figures], letters: Mapping[str, str]) -> Iterator[list[str]]:
    for kind in dict.fromkeys(kind for figures in results.values() for kind in figures["speech"]):
        label = kind
        for name, figures in results.items():
            if score := figures["speech"].get(kind):
                yield [label, letters[name], *_cells(score)]
                label = ""


def _cells(score: Figures) -> list[str]:
    delay = score.get("delay_ms")  # missing if no phone was right
    labials = score["final"]["labials"].values()
    return [
        str(score["final"]["phone_errors"]["reference"]),
        *(
            "/".join(
                percent(score[hypothesis][f"{unit}_error_rate"])
                for unit in ("phone", "viseme", "feature")
                if f"{unit}_error_rate" in score[hypothesis]
            )
            for hypothesis in HYPOTHESES
        ),
        f"{delay['p50']:.0f}/{delay['p95']:.0f}" if delay else "-",
        "/".join(percent(rate, ".0f") for rate in labials),
    ]
