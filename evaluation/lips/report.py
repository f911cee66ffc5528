"""Print scores of lips: one table per kind of measure, or the four schemes of Li et al. 2011."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.lips.scheme_scores import ConditionScore, Order, Outcome
from kouxing.evaluation.lips.schemes import DEFAULT_DELAY_S
from kouxing.evaluation.lips.scores import MEASURES, CurveScore, HitScore, LipScore

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
    table = _empty_table(title, ("clips; scheme, delay in ms", *columns), (0, 1, 0, 0))
    for group, members in groupby(scores, lambda score: score.group):
        rows = list(members)
        table.add_row(f"[bold]{group}: {max(score.num_clips for score in rows)}[/bold]")
        for score in rows:
            delay = "" if score.delay_ms is None else f", {score.delay_ms:.0f}"
            table.add_row(f"  {score.scheme}{delay}", *(cell(score) for cell in columns.values()))
        table.add_section()
    return table


def _empty_table(title: str, columns: Sequence[str], padding: tuple[int, int, int, int]) -> Table:
    table = Table(title=title, box=box.SIMPLE, padding=padding, title_justify="left")
    for column in columns:
        table.add_column(column, no_wrap=True)
    return table


def _curve_cell(
    figure: Callable[[CurveScore], float | None],
    form: str = ".2f",
    measures: Sequence[str] = tuple(MEASURES),
) -> Cell:
    def cell(score: LipScore) -> str:
        curves = [score.curves.get(measure) for measure in measures]
        return " ".join(_format(figure(curve) if curve else None, form) for curve in curves)

    return cell


def _opening_cell(figure: Callable[[CurveScore], float | None], form: str = ".2f") -> Cell:
    return _curve_cell(figure, form, ("opening",))


def _format(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else format(value, form)


def _hit_cells(hits: Callable[[LipScore], HitScore]) -> dict[str, Cell]:
    return {
        "met": lambda score: f"{hits(score).met}/{hits(score).real}",
        "true": lambda score: f"{hits(score).true}/{hits(score).made}",
        "recall": lambda score: _format(hits(score).recall),
        "precision": lambda score: _format(hits(score).precision),
        "F1": lambda score: _format(hits(score).f1),
    }


def _pause_cell(name: str) -> Cell:
    def cell(score: LipScore) -> str:
        made, real = (getattr(score.pauses, prefix + name) for prefix in ("", "real_"))
        return f"{_format(made, '.0f')} ({_format(real, '.0f')})"

    return cell


TABLES: dict[str, dict[str, Cell]] = {
    "Correlation of opening, width, jaw": {
        "everything": _curve_cell(lambda curve: curve.correlation),
        "in speech": _curve_cell(lambda curve: curve.correlation_in_speech),
        "without drift": _curve_cell(lambda curve: curve.correlation_without_drift),
    },
    "Opening, width, jaw: error in FAP units, lag in ms (positive: late)": {
        "error": _curve_cell(lambda curve: curve.rmse, ".0f"),
        "best lag": _curve_cell(lambda curve: curve.best_lag_ms, "+.0f"),
        "correlation there": _curve_cell(lambda curve: curve.best_correlation),
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
        "made": _curve_cell(lambda curve: curve.turns_per_s, ".1f"),
        "made, at 50 Hz": _curve_cell(lambda curve: curve.turns_per_s_at_50_hz, ".1f"),
        "real": _curve_cell(lambda curve: curve.real_turns_per_s, ".1f"),
    },
    "Time from real openings to made ones, ms": {
        "p50": lambda score: _format(score.opening_delay_p50_ms, "+.0f"),
        "p95": lambda score: _format(score.opening_delay_p95_ms, "+.0f"),
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
    "all": _opening_cell(lambda curve: curve.correlation),
    "speech": _opening_cell(lambda curve: curve.correlation_in_speech),
    "lag": _opening_cell(lambda curve: curve.best_lag_ms, "+.0f"),
    "closures": lambda score: f"{score.closures.met}/{score.closures.real}",
    "F1": lambda score: _format(score.closures.f1),
    "turns": _opening_cell(lambda curve: curve.turns_per_s, ".1f"),
    "real": _opening_cell(lambda curve: curve.real_turns_per_s, ".1f"),
}


# Table 2: mean opinion scores of sync and realism, and the minimum delay in theory, ms.
PAPER = {1: (4.34, 4.01, 0), 2: (3.98, 3.81, 0), 3: (3.42, 3.50, 45), 4: (3.21, 3.16, 110)}

AGREEMENT: dict[str, Cell] = {
    "of": lambda score: str(score.num_clips),
    "correlation": _curve_cell(lambda curve: curve.correlation),
    "error": _opening_cell(lambda curve: curve.rmse, ".0f"),
    "lag": _opening_cell(lambda curve: curve.best_lag_ms, "+.0f"),
    "F1": lambda score: _format(score.closures.f1),
}
LEGEND = (
    "correlation: opening, width, jaw; opening: error in FAP units, lag in ms and jerk in million "
    "FAP units / s³; F1: of closures; phone: median phone delay, ms; face: delay of the face, ms; "
    "paper: mean opinion scores of sync and realism, minimum delay in theory, ms"
)


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print each lip model against scheme 1 and real lips, then whether the order holds."""
    references: dict[str, Callable[[ConditionScore], LipScore | None]] = {
        "scheme 1": lambda score: score.like_scheme_1,
        "real lips": lambda score: score.like_real_lips,
    }
    for name, agreement in references.items():
        for lips, scores in groupby(outcome.scores, lambda score: score.lips):
            rows = [(score, like) for score in scores if (like := agreement(score))]
            if rows:
                console.print(_scheme_table(f"{lips} against {name}", rows))
    console.print(LEGEND, highlight=False)
    for order in outcome.orders:
        console.print(describe(order), highlight=False, soft_wrap=True)


def describe(order: Order) -> str:
    """Say whether an order holds, and what schemes 3 and 4 lose."""
    figures = " ".join(f"{figure:.2f}" for figure in order.correlations)
    aligned, _, live, next_phone = order.correlations
    return (
        f"{order.lips}, {order.recognizer}, opening against {order.reference} ({figures}): "
        f"1 > 2 > 3 > 4 {'holds' if order.holds else 'does not hold'}, in "
        f"{order.num_holding} of {order.num_sentences} sentences; "
        f"live costs {aligned - live:+.2f}, waiting for the next phone {live - next_phone:+.2f}"
    )


def _scheme_table(title: str, rows: Sequence[tuple[ConditionScore, LipScore]]) -> Table:
    columns = ("scheme", *AGREEMENT, "jerk", "phone", "face", "paper")
    table = _empty_table(title, columns, (0, 0, 0, 0))
    for score, like in rows:
        sync, realism, min_ms = PAPER[score.scheme]
        table.add_row(
            f"{score.scheme} {score.recognizer}",
            *(cell(like) for cell in AGREEMENT.values()),
            _format(score.jerk and score.jerk / 1e6, ".1f"),
            _format(score.phone_delay_p50_ms, ".0f"),
            _format(score.face_delay_ms, ".0f"),
            f"{sync:.2f} {realism:.2f} {min_ms}",
        )
    return table
