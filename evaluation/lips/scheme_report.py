"""Print the four schemes in the form of table 2 of Li et al. 2011, next to the paper's scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.lips.report import Cell, curve_cell, format_figure, opening_cell
from kouxing.evaluation.lips.scheme_scores import ConditionScore, Order, Outcome
from kouxing.evaluation.lips.scores import LipScore

# Table 2: mean opinion scores of sync and realism, and the minimum delay in theory, ms.
PAPER = {1: (4.34, 4.01, 0), 2: (3.98, 3.81, 0), 3: (3.42, 3.50, 45), 4: (3.21, 3.16, 110)}

AGREEMENT: dict[str, Cell] = {
    "of": lambda score: str(score.num_clips),
    "correlation": curve_cell(lambda curve: curve.correlation),
    "error": opening_cell(lambda curve: curve.rmse, ".0f"),
    "lag": opening_cell(lambda curve: curve.best_lag_ms, "+.0f"),
    "F1": lambda score: format_figure(score.closures.f1),
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
                console.print(_table(f"{lips} against {name}", rows))
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


def _table(title: str, rows: Sequence[tuple[ConditionScore, LipScore]]) -> Table:
    table = Table(title=title, box=box.SIMPLE, padding=0, title_justify="left")
    for column in ("scheme", *AGREEMENT, "jerk", "phone", "face", "paper"):
        table.add_column(column, no_wrap=True)
    for score, like in rows:
        sync, realism, min_ms = PAPER[score.scheme]
        table.add_row(
            f"{score.scheme} {score.recognizer}",
            *(cell(like) for cell in AGREEMENT.values()),
            format_figure(score.jerk and score.jerk / 1e6, ".1f"),
            format_figure(score.phone_delay_p50_ms, ".0f"),
            format_figure(score.face_delay_ms, ".0f"),
            f"{sync:.2f} {realism:.2f} {min_ms}",
        )
    return table
