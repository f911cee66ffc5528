"""Print scores of lips: one table per kind of measure, or the four schemes of Li et al. 2011."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import groupby, pairwise

from rich.console import Console

from kouxing.evaluation.lips.scheme_scores import ConditionScore, Order, Outcome
from kouxing.evaluation.lips.scores import MEASURES, CurveScore, HitScore, LipScore
from kouxing.evaluation.tables import format_number
from kouxing.shared.terminal import plural, print_table

Cell = Callable[[LipScore], str]


def print_scores(scores: Sequence[LipScore], console: Console) -> None:
    """Print all schemes for all clips, and by language if there are several."""
    languages = {score.group for score in scores if score.kind == "language"}
    kinds = ("all", "language") if len(languages) > 1 else ("all",)
    pooled = [score for score in scores if score.kind in kinds]
    for title, columns in TABLES.items():
        rows = []
        for group, members in groupby(pooled, lambda score: score.group):
            of_group = list(members)
            rows.append([f"{group}: {max(score.num_clips for score in of_group)}"])
            for score in of_group:
                delay = "" if score.delay_ms is None else f", {score.delay_ms:.0f}"
                rows.append([f"  {score.scheme}{delay}", *_cells(columns, score)])
        print_table(console, title, ("clips; scheme, delay in ms", *columns), rows)


def _cells(columns: Mapping[str, Cell], score: LipScore) -> list[str]:
    return [cell(score) for cell in columns.values()]


def _curve_cell(
    figure: Callable[[CurveScore], float | None],
    form: str = ".2f",
    measures: Sequence[str] = tuple(MEASURES),
) -> Cell:
    def cell(score: LipScore) -> str:
        curves = [score.curves.get(measure) for measure in measures]
        return " ".join(format_number(figure(curve) if curve else None, form) for curve in curves)

    return cell


def _hit_cells(hits: Callable[[LipScore], HitScore]) -> dict[str, Cell]:
    return {
        "met": lambda score: f"{hits(score).met}/{hits(score).real}",
        "true": lambda score: f"{hits(score).true}/{hits(score).made}",
        "recall": lambda score: format_number(hits(score).recall),
        "precision": lambda score: format_number(hits(score).precision),
        "F1": lambda score: format_number(hits(score).f1),
    }


TABLES: dict[str, dict[str, Cell]] = {
    "Opening, width, jaw: correlation, error in FAP units, lag in ms (positive: late)": {
        "everything": _curve_cell(lambda curve: curve.correlation),
        "in speech": _curve_cell(lambda curve: curve.correlation_in_speech),
        "error": _curve_cell(lambda curve: curve.rmse, ".0f"),
        "lag": _curve_cell(lambda curve: curve.best_lag_ms, "+.0f"),
    },
    "Closures: real ones reproduced (met), made ones that are true, within 40 ms": {
        **_hit_cells(lambda score: score.closures),
        "b p m": lambda score: f"{score.bpm_met}/{score.bpm}",
    },
    "Closures in speech": _hit_cells(lambda score: score.closures_in_speech),
    "Time from real openings to made ones, ms": {
        "p50": lambda score: format_number(score.opening_delay_p50_ms, "+.0f"),
        "p95": lambda score: format_number(score.opening_delay_p95_ms, "+.0f"),
        "met": lambda score: f"{score.openings_met}/{score.openings}",
    },
}

# Table 2: mean opinion scores of sync and realism, and the minimum delay in theory, ms.
PAPER = {1: (4.34, 4.01, 0), 2: (3.98, 3.81, 0), 3: (3.42, 3.50, 45), 4: (3.21, 3.16, 110)}

AGREEMENT: dict[str, Cell] = {
    "of": lambda score: str(score.num_clips),
    "correlation": _curve_cell(lambda curve: curve.correlation),
    "error": _curve_cell(lambda curve: curve.rmse, ".0f", ("opening",)),
    "lag": _curve_cell(lambda curve: curve.best_lag_ms, "+.0f", ("opening",)),
    "F1": lambda score: format_number(score.closures.f1),
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
                columns = ("scheme", *AGREEMENT, "jerk", "phone", "face", "paper")
                print_table(console, f"{lips} against {name}", columns, map(_row, rows))
    console.print(LEGEND, highlight=False)
    for order in outcome.orders:
        console.print(describe(order), highlight=False)


def describe(order: Order) -> str:
    """Say whether an order holds, and how much correlation each step costs."""
    figures = " ".join(f"{figure:.2f}" for figure in order.correlations)
    steps = [before - after for before, after in pairwise(order.correlations)]
    costs = ("recognition errors cost", "live output", "waiting for the next phone")
    return (
        f"{order.lips}, {order.recognizer}, opening against {order.reference} ({figures}): "
        f"1 > 2 > 3 > 4 {'holds' if order.holds else 'does not hold'}, in "
        f"{order.num_holding} of {plural(order.num_sentences, 'sentence')}; "
        + ", ".join(f"{cost} {step:.2f}" for cost, step in zip(costs, steps, strict=True))
    )


def _row(pair: tuple[ConditionScore, LipScore]) -> list[str]:
    score, like = pair
    sync, realism, min_ms = PAPER[score.scheme]
    return [
        f"{score.scheme} {score.recognizer}",
        *_cells(AGREEMENT, like),
        format_number(score.jerk and score.jerk / 1e6, ".1f"),
        format_number(score.phone_delay_p50_ms, ".0f"),
        format_number(score.face_delay_ms, ".0f"),
        f"{sync:.2f} {realism:.2f} {min_ms}",
    ]
