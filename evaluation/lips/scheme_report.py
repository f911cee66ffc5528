"""The four schemes' figures, in the shape of table 2 of Li et al. 2011, with its scores beside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import groupby

from rich import box
from rich.console import Console
from rich.table import Table

from kouxing.evaluation.lips.report import Cell, of_curves, of_opening, shown
from kouxing.evaluation.lips.scheme_scores import ConditionScore, Order, Outcome
from kouxing.evaluation.lips.scores import LipScore

# Table 2: mean opinion scores of sync and realism, and the least delay in theory, ms.
PAPER = {1: (4.34, 4.01, 0), 2: (3.98, 3.81, 0), 3: (3.42, 3.50, 45), 4: (3.21, 3.16, 110)}

LIKENESS: dict[str, Cell] = {
    "of": lambda score: str(score.num_clips),
    "correlation": of_curves(lambda curve: curve.correlation),
    "error": of_opening(lambda curve: curve.rmse, ".0f"),
    "lag": of_opening(lambda curve: curve.best_lag_ms, "+.0f"),
    "F1": lambda score: shown(score.closures.f1),
}
LEGEND = (
    "correlation: opening, width, jaw; of the opening error in FAP units, lag in ms and jerk in "
    "million FAP units / s³; F1: of closures; phone: median delay, ms; face: its delay, ms; "
    "paper: mean opinion scores of sync and realism, least delay in theory, ms"
)


def print_outcome(outcome: Outcome, console: Console) -> None:
    """Print each lip model against scheme 1 and real lips, then whether the order holds."""
    references: dict[str, Callable[[ConditionScore], LipScore | None]] = {
        "scheme 1": lambda score: score.like_scheme_1,
        "real lips": lambda score: score.like_real_lips,
    }
    for name, likeness in references.items():
        for lips, of_lips in groupby(outcome.scores, lambda score: score.lips):
            rows = [(score, like) for score in of_lips if (like := likeness(score))]
            if rows:
                console.print(_table(f"{lips} against {name}", rows))
    console.print(LEGEND, highlight=False)
    for order in outcome.orders:
        console.print(sentence(order), highlight=False, soft_wrap=True)


def sentence(order: Order) -> str:
    """Say whether an order holds, and what schemes 3 and 4 lose."""
    figures = " ".join(f"{figure:.2f}" for figure in order.correlations)
    bound, _, live, next_phone = order.correlations
    return (
        f"{order.lips}, {order.recognizer}, opening against {order.reference} ({figures}): "
        f"1 > 2 > 3 > 4 {'holds' if order.holds else 'does not hold'}, in "
        f"{order.num_holding} of {order.num_sentences} sentences; live costs {bound - live:+.2f}, "
        f"waiting for the next phone {live - next_phone:+.2f}"
    )


def _table(title: str, rows: Sequence[tuple[ConditionScore, LipScore]]) -> Table:
    table = Table(title=title, box=box.SIMPLE, padding=0, title_justify="left")
    for column in ("scheme", *LIKENESS, "jerk", "phone", "face", "paper"):
        table.add_column(column, no_wrap=True)
    for score, like in rows:
        sync, realism, least_ms = PAPER[score.scheme]
        table.add_row(
            f"{score.scheme} {score.recognizer}",
            *(cell(like) for cell in LIKENESS.values()),
            shown(score.jerk and score.jerk / 1e6, ".1f"),
            shown(score.phone_delay_p50_ms, ".0f"),
            shown(score.face_delay_ms, ".0f"),
            f"{sync:.2f} {realism:.2f} {least_ms}",
        )
    return table
