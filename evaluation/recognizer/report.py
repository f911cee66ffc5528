"""Print the recognizer's figures as tables, and plot them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from rich.console import Console

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.evaluation.tables import percent
from kouxing.shared.terminal import plural, print_table

Figures = Mapping[str, Any]  # result of evaluate_recognizer


def print_figures(results: Mapping[str, Figures], console: Console) -> None:
    """Print the tables of each model, then all models side by side, then bad rows.

    ``results`` has the figures by the name of the model.
    """
    for name, figures in results.items():
        console.rule(name)
        print_table(
            console,
            f"{figures['split']}: {plural(figures['recordings'], 'recording')}, "
            f"{plural(figures['speakers'], 'speaker')}",
            ("output", "phone error %", "95 %", "ins/del/sub %", "viseme error %", "95 %"),
            map(_output, figures["scores"]),
        )
        print_table(
            console,
            "live",
            ("output", "final phone / viseme error %", "delay p50 / p95 ms"),
            (
                (score["output"], _rates(score, "final_"), _delay(score))
                for score in figures["scores"]
            ),
        )
        print_table(
            console,
            "p, b, m and f, %",
            ("output", "recall", "precision"),
            (
                (output, *map(percent, fractions.values()))
                for output, fractions in figures["labials"].items()
            ),
        )
    if len(results) > 1:
        print_table(
            console,
            "phone / viseme error %",
            ("model", "offline", "first hypothesis", "final hypothesis", "delay p50 / p95 ms"),
            (
                (name, _rates(first), _rates(last), _rates(last, "final_"), _delay(last))
                for name, (first, *_, last) in (
                    (name, figures["scores"]) for name, figures in results.items()
                )
            ),
        )
    messages = dict.fromkeys(line for figures in results.values() for line in figures["bad_rows"])
    for message in messages:
        console.print(message, markup=False, soft_wrap=True)
    if messages:
        console.print(f"{plural(len(messages), 'row')} skipped")


def _output(score: Figures) -> list[str]:
    errors = score["phone_errors"]
    kinds = ("insertions", "deletions", "substitutions")
    return [
        score["output"],
        percent(score["phone_error_rate"]),
        _interval(score["phone_interval_95"]),
        "/".join(percent(errors[kind] / max(1, errors["reference"])) for kind in kinds),
        percent(score["viseme_error_rate"]),
        _interval(score["viseme_interval_95"]),
    ]


def _rates(score: Figures, hypothesis: str = "") -> str:
    rates = (score.get(f"{hypothesis}{kind}_error_rate") for kind in ("phone", "viseme"))
    return " / ".join(map(percent, rates))


def _interval(bounds: tuple[float, float] | None) -> str:
    return "-" if bounds is None else f"{percent(bounds[0])}-{percent(bounds[1])}"


def _delay(score: Figures) -> str:
    delay = score.get("delay_ms")  # missing if no phone was right
    return f"{delay['p50']:.0f} / {delay['p95']:.0f}" if delay else "-"


def draw_delay_curve(results: Sequence[Figures], path: Path) -> None:
    """Plot the errors of both hypotheses over the median delay of the first.

    The results have the model's name as ``acoustic``. Those of one model, with several look-aheads,
    are adjacent. Raises UserError if the picture cannot be written.
    """
    figure = new_figure(11.0, 4.5)
    for axes, kind in zip(figure.subplots(1, 2), ("phone", "viseme"), strict=True):
        by_model = groupby(results, key=lambda result: result["acoustic"])
        for number, (name, group) in enumerate(by_model):
            defaults = [result["scores"][-1] for result in group]
            scores = [score for score in defaults if "delay_ms" in score]
            scores.sort(key=lambda score: score["delay_ms"]["p50"])
            delays_ms = [score["delay_ms"]["p50"] for score in scores]
            for prefix, style, hypothesis in (("", "o-", "first"), ("final_", "s--", "final")):
                rates = [100 * score[f"{prefix}{kind}_error_rate"] for score in scores]
                label = f"{name}, {hypothesis} hypothesis"
                axes.plot(delays_ms, rates, style, color=f"C{number}", label=label)
        axes.set_xlabel("median delay of the first hypothesis, ms")
        axes.set_ylabel(f"{kind} errors, %")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)
