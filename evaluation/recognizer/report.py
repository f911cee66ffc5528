"""Print the recognizer's figures as a table, and plot them."""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.console import Console

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.evaluation.recognizer.disturbances import CLEAN
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
        "phone/viseme errors, %; delay of the first hypothesis, p50/p95, ms;\n"
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
                percent(score[hypothesis][f"{unit}_error_rate"]) for unit in ("phone", "viseme")
            )
            for hypothesis in HYPOTHESES
        ),
        f"{delay['p50']:.0f}/{delay['p95']:.0f}" if delay else "-",
        "/".join(percent(rate, ".0f") for rate in labials),
    ]


def draw_delay_curve(results: Sequence[Figures], path: Path) -> None:
    """Plot the errors of both hypotheses in clean speech over the first hypothesis's median delay.

    ``acoustic`` of each result is the name of the model. The results of one model, with several
    look-aheads, are adjacent. Raises UserError if the picture cannot be written.
    """
    figure = new_figure(11.0, 4.5)
    for axes, kind in zip(figure.subplots(1, 2), ("phone", "viseme"), strict=True):
        by_model = groupby(results, key=lambda result: result["acoustic"])
        for number, (name, group) in enumerate(by_model):
            clean = [result["speech"][CLEAN] for result in group]
            scores = [score for score in clean if "delay_ms" in score]
            scores.sort(key=lambda score: score["delay_ms"]["p50"])
            delays_ms = [score["delay_ms"]["p50"] for score in scores]
            for hypothesis, style in (("first", "o-"), ("final", "s--")):
                rates = [100 * score[hypothesis][f"{kind}_error_rate"] for score in scores]
                label = f"{name}, {hypothesis} hypothesis"
                axes.plot(delays_ms, rates, style, color=f"C{number}", label=label)
        axes.set_xlabel("median delay of the first hypothesis, ms")
        axes.set_ylabel(f"{kind} errors, %")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)
