"""Print scores of lips: a table for each group of figures."""

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
    """Print all schemes for all clips and each language; the default delay for each speaker."""
    languages = {score.group for score in scores if score.kind == "language"}
    kinds = ("all", "language") if len(languages) > 1 else ("all",)
    together = [score for score in scores if score.kind in kinds]
    for title, columns in TABLES.items():
        console.print(_table(title, columns, together))
    by_speaker = [
        score
        for score in scores
        if score.kind == "speaker" and score.delay_ms == round(1e3 * DEFAULT_DELAY_S)
    ]
    if len({score.group for score in by_speaker}) > 1:
        console.print(
            _table(
                "By speaker: correlation, lag, closures met, turns of the opening",
                SPEAKER_COLUMNS,
                by_speaker,
            )
        )


def print_comparison(scores: Sequence[LipScore], console: Console) -> None:
    """Print the few figures that lip sync is compared by, a table for each language."""
    by_language = [score for score in scores if score.kind == "language"]
    title = "Correlation of opening, width, jaw; closures; lag of the opening in ms"
    console.print(_table(title, COMPARED_COLUMNS, by_language))


def _table(title: str, columns: Mapping[str, Cell], scores: Sequence[LipScore]) -> Table:
    table = Table(title=title, box=box.SIMPLE, padding=(0, 1, 0, 0), title_justify="left")
    for column in ("clips; scheme, delay in ms", *columns):
        table.add_column(column, no_wrap=True)
    for group, members in groupby(scores, lambda score: score.group):
        rows = list(members)
        num_clips = max(score.num_clips for score in rows)
        table.add_row(f"[bold]{group}: {num_clips}[/bold]")
        for score in rows:
            delay = "" if score.delay_ms is None else f", {score.delay_ms:.0f}"
            table.add_row(f"  {score.scheme}{delay}", *(cell(score) for cell in columns.values()))
        table.add_section()
    return table


def of_curves(figure: Callable[[CurveScore], float | None], form: str = ".2f") -> Cell:
    """Return a cell with a figure of opening, width and jaw."""

    def cell(score: LipScore) -> str:
        curves = [score.curves.get(measure) for measure in MEASURES]
        return " ".join(shown(figure(curve) if curve else None, form) for curve in curves)

    return cell


def of_opening(figure: Callable[[CurveScore], float | None], form: str = ".2f") -> Cell:
    """Return a cell with a figure of the opening."""

    def cell(score: LipScore) -> str:
        opening = score.curves.get("opening")
        return shown(figure(opening) if opening else None, form)

    return cell


def _of_hits(hits: Callable[[LipScore], HitScore]) -> dict[str, Cell]:
    """Return columns for events that were met and made."""
    return {
        "met": lambda score: f"{hits(score).met}/{hits(score).real}",
        "true": lambda score: f"{hits(score).true}/{hits(score).made}",
        "recall": lambda score: shown(hits(score).recall),
        "precision": lambda score: shown(hits(score).precision),
        "F1": lambda score: shown(hits(score).f1),
    }


def _of_pauses(made: str, real: str) -> Cell:
    """Return a cell with figures of the made and of the real lips."""

    def cell(score: LipScore) -> str:
        figures = (shown(getattr(score.pauses, name), ".0f") for name in (made, real))
        return "{} ({})".format(*figures)

    return cell


def shown(value: float | None, form: str = ".2f") -> str:
    """Return a figure as a cell shows it."""
    return "-" if value is None else format(value, form)


TABLES: dict[str, dict[str, Cell]] = {
    "Correlation of opening, width, jaw": {
        "everything": of_curves(lambda curve: curve.correlation),
        "in speech": of_curves(lambda curve: curve.correlation_in_speech),
        "without drift": of_curves(lambda curve: curve.correlation_without_drift),
    },
    "Opening, width, jaw: error in FAP units, lag in ms (above 0: late)": {
        "error": of_curves(lambda curve: curve.rmse, ".0f"),
        "best lag": of_curves(lambda curve: curve.best_lag_ms, "+.0f"),
        "correlation there": of_curves(lambda curve: curve.best_correlation),
    },
    "Closures: real ones met, made ones that are true, within 40 ms": {
        **_of_hits(lambda score: score.closures),
        "b p m": lambda score: f"{score.bpm_met}/{score.bpm}",
    },
    "Closures within speech": _of_hits(lambda score: score.closures_in_speech),
    "Lower lip to upper teeth: real ones met (Mandarin), made ones that are true": _of_hits(
        lambda score: score.lip_to_teeth
    ),
    "Turns of opening, width, jaw a second": {
        "made": of_curves(lambda curve: curve.turns_per_s, ".1f"),
        "made, at 50 Hz": of_curves(lambda curve: curve.turns_per_s_at_50_hz, ".1f"),
        "real": of_curves(lambda curve: curve.real_turns_per_s, ".1f"),
    },
    "Time from real openings to made ones, ms": {
        "p50": lambda score: shown(score.opening_delay_p50_ms, "+.0f"),
        "p95": lambda score: shown(score.opening_delay_p95_ms, "+.0f"),
        "met": lambda score: f"{score.openings_met}/{score.openings}",
    },
    "Pauses, made (real): FAP units/s of opening; ms from last sound to shut lips": {
        "speed": _of_pauses("speed", "real_speed"),
        "p50": _of_pauses("shut_after_p50_ms", "real_shut_after_p50_ms"),
        "p95": _of_pauses("shut_after_p95_ms", "real_shut_after_p95_ms"),
        "shut": _of_pauses("shut", "real_shut"),
        "of": lambda score: str(score.pauses.count),
    },
}
COMPARED_COLUMNS: dict[str, Cell] = {
    "in speech": of_curves(lambda curve: curve.correlation_in_speech),
    "closures F1": lambda score: shown(score.closures.f1),
    "F1 in speech": lambda score: shown(score.closures_in_speech.f1),
    "lag": of_opening(lambda curve: curve.best_lag_ms, "+.0f"),
}
SPEAKER_COLUMNS: dict[str, Cell] = {
    "all": of_opening(lambda curve: curve.correlation),
    "speech": of_opening(lambda curve: curve.correlation_in_speech),
    "lag": of_opening(lambda curve: curve.best_lag_ms, "+.0f"),
    "closures": lambda score: f"{score.closures.met}/{score.closures.real}",
    "F1": lambda score: shown(score.closures.f1),
    "turns": of_opening(lambda curve: curve.turns_per_s, ".1f"),
    "real": of_opening(lambda curve: curve.real_turns_per_s, ".1f"),
}
