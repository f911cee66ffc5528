"""The recognizer's figures as tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from rich.console import Console
from rich.table import Table

Figures = Mapping[str, Any]  # of evaluation.recognizer.error_rates.evaluate_recognizer


def print_figures(results: Mapping[str, Figures], console: Console) -> None:
    """Print the tables of each model, then all models side by side, then bad rows.

    Parameters
    ----------
    results
        The figures by the model's name.
    console
        Where to print.
    """
    for name, figures in results.items():
        console.rule(name)
        console.print(_outputs(figures))
        console.print(_speakers(figures))
        labials = {name: rate for name, rate in figures["labials"].items() if rate is not None}
        rates = ", ".join(f"{name} {_percent(rate)} %" for name, rate in labials.items())
        console.print(f"p, b, m and f, offline: {rates or 'none'}")
        cost = figures["cpu_per_audio_second"]
        parts = ", ".join(f"{stage} {seconds:.4f}" for stage, seconds in cost.items())
        console.print(f"CPU seconds per second of sound: {parts}; all {sum(cost.values()):.4f}")
    if len(results) > 1:
        console.print(_side_by_side(results))
    messages = dict.fromkeys(line for figures in results.values() for line in figures["bad_rows"])
    for message in messages:
        console.print(message, markup=False, soft_wrap=True)
    if messages:
        console.print(f"{len(messages)} rows skipped")


def _outputs(figures: Figures) -> Table:
    columns = ("output", "phone error %", "95 %", "ins / del / sub %", "viseme error %", "95 %")
    table = _table(
        f"{figures['split']}: {figures['recordings']} recordings, {figures['speakers']} speakers",
        (*columns, "final, phones / visemes", "delay p50 / p95 ms"),
    )
    for score in figures["scores"]:
        table.add_row(
            score["output"],
            _percent(score["phone_error_rate"]),
            _interval(score["phone_interval_95"]),
            _kinds(score["phone_errors"]),
            _percent(score["viseme_error_rate"]),
            _interval(score["viseme_interval_95"]),
            _final(score),
            _delay(score),
        )
    return table


def _speakers(figures: Figures) -> Table:
    full, live = figures["scores"][0], figures["scores"][-1]
    columns = ("speaker", "phones", "phone error %", "ins / del / sub %", "viseme error %")
    outputs = (f"phone error %, {live['output']}", "final phone error %")
    table = _table(f"by speaker, {full['output']}", (*columns, *outputs))
    for speaker, errors in full["phone_errors_by_speaker"].items():
        table.add_row(
            speaker,
            str(errors["reference"]),
            _percent(errors["rate"]),
            _kinds(errors),
            _percent(full["viseme_errors_by_speaker"][speaker]["rate"]),
            _percent(live["phone_errors_by_speaker"][speaker]["rate"]),
            _percent(live["final_phone_errors_by_speaker"][speaker]["rate"]),
        )
    return table


def _side_by_side(results: Mapping[str, Figures]) -> Table:
    table = _table("side by side: phone / viseme error %, delay p50 ms", ("output", *results))
    for scores in zip(*(figures["scores"] for figures in results.values()), strict=True):
        cells = [
            f"{_percent(score['phone_error_rate'])} / {_percent(score['viseme_error_rate'])}, "
            + (f"{score['delay_ms']['p50']:.0f}" if "delay_ms" in score else "-")
            for score in scores
        ]
        table.add_row(scores[0]["output"], *cells)
    return table


def _table(title: str, columns: Iterable[str]) -> Table:
    table = Table(title=title)
    for number, column in enumerate(columns):
        table.add_column(column, justify="right" if number else "left")
    return table


def _percent(rate: float) -> str:
    return f"{100 * rate:.1f}"


def _final(score: Figures) -> str:
    if "final_phone_error_rate" not in score:
        return ""
    return " / ".join(_percent(score[f"final_{kind}_error_rate"]) for kind in ("phone", "viseme"))


def _interval(bounds: tuple[float, float] | None) -> str:
    return "-" if bounds is None else f"{_percent(bounds[0])} - {_percent(bounds[1])}"


def _kinds(errors: Mapping[str, int]) -> str:
    kinds = ("insertions", "deletions", "substitutions")
    return " / ".join(_percent(errors[kind] / max(1, errors["reference"])) for kind in kinds)


def _delay(score: Figures) -> str:
    delay = score.get("delay_ms")
    return f"{delay['p50']:.0f} / {delay['p95']:.0f}" if delay else ""
