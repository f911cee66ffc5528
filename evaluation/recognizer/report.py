"""Print the recognizer's figures as tables, and plot them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table

from kouxing.corpora.figures import new_figure, save_figure

Figures = Mapping[str, Any]  # result of evaluate_recognizer


def print_figures(results: Mapping[str, Figures], console: Console) -> None:
    """Print the tables of each model, then all models side by side, then bad rows.

    ``results`` has the figures by the name of the model.
    """
    for name, figures in results.items():
        console.rule(name)
        console.print(_outputs(figures))
        console.print(_live_outputs(figures))
        console.print(_speakers(figures))
        console.print(_labials(figures))
        cost = figures["cpu_per_audio_second"]
        parts = ", ".join(f"{stage} {seconds:.4f}" for stage, seconds in cost.items())
        console.print(f"CPU seconds per second of audio: {parts}; total {sum(cost.values()):.4f}")
    if len(results) > 1:
        console.print(_side_by_side(results))
    messages = dict.fromkeys(line for figures in results.values() for line in figures["bad_rows"])
    for message in messages:
        console.print(message, markup=False, soft_wrap=True)
    if messages:
        console.print(f"{len(messages)} rows skipped")


def _outputs(figures: Figures) -> Table:
    columns = ("output", "phone error %", "95 %", "ins/del/sub %", "viseme error %", "95 %")
    table = _table(
        f"{figures['split']}: {figures['recordings']} recordings, {figures['speakers']} speakers",
        columns,
    )
    for score in figures["scores"]:
        table.add_row(
            score["output"],
            percent(score["phone_error_rate"]),
            _interval(score["phone_interval_95"]),
            _kinds(score["phone_errors"]),
            percent(score["viseme_error_rate"]),
            _interval(score["viseme_interval_95"]),
        )
    return table


def _live_outputs(figures: Figures) -> Table:
    columns = ("output", "final phone / viseme error %", "delay p50 / p95 ms")
    table = _table("live", columns)
    for score in figures["scores"]:
        if _delay(score):
            table.add_row(score["output"], _rates(score, "final_"), _delay(score))
    return table


def _speakers(figures: Figures) -> Table:
    full, live = figures["scores"][0], figures["scores"][-1]
    columns = ("speaker", "phones", "phone error %", "ins/del/sub %", "viseme error %")
    outputs = (f"phone error %, {live['output']}", "final phone error %")
    table = _table(f"by speaker, {full['output']}", (*columns, *outputs))
    for speaker, errors in full["phone_errors_by_speaker"].items():
        table.add_row(
            speaker,
            str(errors["reference"]),
            percent(errors["rate"]),
            _kinds(errors),
            percent(full["viseme_errors_by_speaker"][speaker]["rate"]),
            percent(live["phone_errors_by_speaker"][speaker]["rate"]),
            percent(live["final_phone_errors_by_speaker"][speaker]["rate"]),
        )
    return table


def _labials(figures: Figures) -> Table:
    columns = ("recall", "precision", "recognized as d t n g k h", "d t n g k h spoken")
    table = _table("p, b, m and f, %", ("output", *columns))
    for output, fractions in figures["labials"].items():
        table.add_row(output, *map(percent, fractions.values()))
    return table


def _side_by_side(results: Mapping[str, Figures]) -> Table:
    """Compare offline decoding and both hypotheses of the default output rule."""
    columns = ("offline", "first hypothesis", "final hypothesis", "delay p50 / p95 ms")
    table = _table("phone / viseme error %", ("model", *columns))
    for name, figures in results.items():
        offline, live = figures["scores"][0], figures["scores"][-1]
        table.add_row(name, _rates(offline), _rates(live), _rates(live, "final_"), _delay(live))
    return table


def _table(title: str, columns: Iterable[str]) -> Table:
    table = Table(title=title, box=box.SIMPLE, padding=(0, 1, 0, 0), title_justify="left")
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    return table


def percent(rate: float | None) -> str:
    """Return a rate as a percentage for a table."""
    return "-" if rate is None else f"{100 * rate:.1f}"


def _rates(score: Figures, hypothesis: str = "") -> str:
    if f"{hypothesis}phone_error_rate" not in score:
        return ""
    kinds = ("phone", "viseme")
    return " / ".join(percent(score[f"{hypothesis}{kind}_error_rate"]) for kind in kinds)


def _interval(bounds: tuple[float, float] | None) -> str:
    return "-" if bounds is None else f"{percent(bounds[0])}-{percent(bounds[1])}"


def _kinds(errors: Mapping[str, int]) -> str:
    kinds = ("insertions", "deletions", "substitutions")
    return "/".join(percent(errors[kind] / max(1, errors["reference"])) for kind in kinds)


def _delay(score: Figures) -> str:
    delay = score.get("delay_ms")
    return f"{delay['p50']:.0f} / {delay['p95']:.0f}" if delay else ""


def draw_confusions(figures: Figures, path: Path) -> None:
    """Plot the confusion matrix in the result of ``evaluate_recognizer``, with normalized rows.

    Silence, as ``-``, is the last row (insertions) and column (deletions). Raises UserError if the
    picture cannot be written.
    """
    phones, silence = figures["phones"], figures["silence"]
    order = sorted(range(len(phones)), key=lambda number: phones[number] == silence)
    names = [phones[number] if phones[number] != silence else "-" for number in order]
    counts = np.array(figures["confusions"])[np.ix_(order, order)]
    rates = counts / np.maximum(1, counts.sum(axis=1, keepdims=True))
    figure = new_figure(11.0, 10.0)
    axes = figure.add_subplot()
    picture = axes.imshow(rates, cmap="viridis", vmin=0, vmax=1)
    axes.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xlabel("recognized (-: nothing)")
    axes.set_ylabel("reference (-: nothing)")
    figure.colorbar(picture, label="share of the reference phone", shrink=0.8)
    save_figure(figure, path)


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
