"""Print scores of lips: one table per kind of measure."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.lips.clip_scores import MEASURES
from kouxing.evaluation.lips.schemes import DEFAULT_DELAY_S
from kouxing.evaluation.lips.scores import CurveScore, HitScore, LipScore

Cell = Callable[[LipScore], str]


def print_scores(scores: Sequence[LipScore], console: Console) -> None:
    """Print all schemes for all clips and by language; the default delay by speaker."""
    languages = {score.group for score in scores if score.kind == "language"}
    kinds = ("all", "language") if len(languages) > 1 else ("all",)
    pooled = [score for score in scores if score.kind in kinds]
    for title, columns in TABLES.items():
        console.print(_table(title, columns, pooled))
    default_ms = round(1e3 * DEFAULT_DELAY_S)
    by_speaker = [s for s in scores if s.kind == "speaker" and s.delay_ms == default_ms]
    if len({score.group for score in by_speaker}) > 1:
        title = "By speaker: correlation, lag, closures reproduced, turns of the opening"
        console.print(_table(title, SPEAKER_COLUMNS, by_speaker))


def _table(title: str, columns: Mapping[str, Cell], scores: Sequence[LipScore]) -> Table:
    table = Table(title=title, box=box.SIMPLE, padding=(0, 1, 0, 0), title_justify="left")
    for column in ("clips; scheme, delay in ms", *columns):
        table.add_column(column, no_wrap=True)
    for group, members in groupby(scores, lambda score: score.group):
        rows = list(members)
        table.add_row(f"[bold]{group}: {max(score.num_clips for score in rows)}[/bold]")
        for score in rows:
            delay = "" if score.delay_ms is None else f", {score.delay_ms:.0f}"
            table.add_row(f"  {score.scheme}{delay}", *(cell(score) for cell in columns.values()))
        table.add_section()
    return table


def curve_cell(
    figure: Callable[[CurveScore], float | None],
    form: str = ".2f",
    measures: Sequence[str] = tuple(MEASURES),
) -> Cell:
    """Return a cell with a figure of opening, width and jaw, or of some of them."""

    def cell(score: LipScore) -> str:
        curves = [score.curves.get(measure) for measure in measures]
        return " ".join(format_figure(figure(curve) if curve else None, form) for curve in curves)

    return cell


def opening_cell(figure: Callable[[CurveScore], float | None], form: str = ".2f") -> Cell:
    """Return a cell with a figure of the opening."""
    return curve_cell(figure, form, ("opening",))


def format_figure(value: float | None, form: str = ".2f") -> str:
    """Format a figure for a cell."""
    return "-" if value is None else format(value, form)


def _hit_cells(hits: Callable[[LipScore], HitScore]) -> dict[str, Cell]:
    return {
        "met": lambda score: f"{hits(score).met}/{hits(score).real}",
        "true": lambda score: f"{hits(score).true}/{hits(score).made}",
        "recall": lambda score: format_figure(hits(score).recall),
        "precision": lambda score: format_figure(hits(score).precision),
        "F1": lambda score: format_figure(hits(score).f1),
    }


def _pause_cell(name: str) -> Cell:
    def cell(score: LipScore) -> str:
        made, real = (getattr(score.pauses, prefix + name) for prefix in ("", "real_"))
        return f"{format_figure(made, '.0f')} ({format_figure(real, '.0f')})"

    return cell


TABLES: dict[str, dict[str, Cell]] = {
    "Correlation of opening, width, jaw": {
        "everything": curve_cell(lambda curve: curve.correlation),
        "in speech": curve_cell(lambda curve: curve.correlation_in_speech),
        "without drift": curve_cell(lambda curve: curve.correlation_without_drift),
    },
    "Opening, width, jaw: error in FAP units, lag in ms (positive: late)": {
        "error": curve_cell(lambda curve: curve.rmse, ".0f"),
        "best lag": curve_cell(lambda curve: curve.best_lag_ms, "+.0f"),
        "correlation there": curve_cell(lambda curve: curve.best_correlation),
    },
    "Closures: real ones reproduced (met), made ones that are true, within 40 ms": {
        **_hit_cells(lambda score: score.closures),
        "b p m": lambda score: f"{score.bpm_met}/{score.bpm}",
    },
    "Closures in speech": _hit_cells(lambda score: score.closures_in_speech),
    "Lower lip to upper teeth (real ones: Mandarin only)": _hit_cells(
        lambda score: score.lip_to_teeth
    ),
    "Turns of opening, width, jaw per second": {
        "made": curve_cell(lambda curve: curve.turns_per_s, ".1f"),
        "made, at 50 Hz": curve_cell(lambda curve: curve.turns_per_s_at_50_hz, ".1f"),
        "real": curve_cell(lambda curve: curve.real_turns_per_s, ".1f"),
    },
    "Time from real openings to made ones, ms": {
        "p50": lambda score: format_figure(score.opening_delay_p50_ms, "+.0f"),
        "p95": lambda score: format_figure(score.opening_delay_p95_ms, "+.0f"),
        "met": lambda score: f"{score.openings_met}/{score.openings}",
    },
    "Pauses, made (real): FAP units/s of opening; ms from last sound to closed lips": {
        "speed": _pause_cell("speed"),
        "p50": _pause_cell("shut_after_p50_ms"),
        "p95": _pause_cell("shut_after_p95_ms"),
        "closed": _pause_cell("shut"),
        "of": lambda score: str(score.pauses.count),
    },
}
SPEAKER_COLUMNS: dict[str, Cell] = {
    "all": opening_cell(lambda curve: curve.correlation),
    "speech": opening_cell(lambda curve: curve.correlation_in_speech),
    "lag": opening_cell(lambda curve: curve.best_lag_ms, "+.0f"),
    "closures": lambda score: f"{score.closures.met}/{score.closures.real}",
    "F1": lambda score: format_figure(score.closures.f1),
    "turns": opening_cell(lambda curve: curve.turns_per_s, ".1f"),
    "real": opening_cell(lambda curve: curve.real_turns_per_s, ".1f"),
}
