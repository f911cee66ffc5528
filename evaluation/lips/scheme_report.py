"""Print the comparison of the four schemes of Li et al. 2011."""

from collections.abc import Callable, Iterator, Sequence
from itertools import groupby, pairwise

from rich.console import Console

from kouxing.evaluation.lips.agreement import Agreement
from kouxing.evaluation.lips.scheme_scores import ConditionScore, SchemeComparison
from kouxing.evaluation.tables import format_number
from kouxing.shared.terminal import print_table

# Table 2: mean opinion scores of sync and realism, and the minimum delay in theory, ms.
PAPER = {1: (4.34, 4.01, 0), 2: (3.98, 3.81, 0), 3: (3.42, 3.50, 45), 4: (3.21, 3.16, 110)}

AGREEMENT = ("of", "correlation", "error", "lag", "F1")
LEGEND = (
    "correlation: opening, width, jaw; opening: error in FAP units, lag in ms and jerk in million "
    "FAP units / s³; F1: of closures; phone: median phone delay, ms; face: delay of the face, ms; "
    "paper: mean opinion scores of sync and realism, minimum delay in theory, ms"
)


def print_comparison(outcome: SchemeComparison, console: Console) -> None:
    """Print each lip model against scheme 1 and real lips, then the cost of each step."""
    references: dict[str, Callable[[ConditionScore], Agreement | None]] = {
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
    for line in describe_steps(outcome.scores):
        console.print(line, highlight=False)


def describe_steps(scores: Sequence[ConditionScore]) -> Iterator[str]:
    """Yield how much of the opening's correlation with scheme 1 each later scheme costs."""
    figures = {
        (score.lips, score.recognizer, score.scheme): score.like_scheme_1.correlation["opening"]
        for score in scores
        if score.like_scheme_1
    }
    costs = ("recognition errors cost", "live output", "waiting for the next phone")
    for lips, recognizer in dict.fromkeys(key[:2] for key in figures if key[1]):
        keys = (lips, "", 1), *((lips, recognizer, scheme) for scheme in (2, 3, 4))
        steps = [(figures[before], figures[after]) for before, after in pairwise(keys)]
        yield f"{lips}, {recognizer}, opening: " + ", ".join(
            f"{cost} {(before or 0.0) - (after or 0.0):.2f}"
            for cost, (before, after) in zip(costs, steps, strict=True)
        )


def _row(pair: tuple[ConditionScore, Agreement]) -> list[str]:
    score, like = pair
    sync, realism, min_ms = PAPER[score.scheme]
    return [
        f"{score.scheme} {score.recognizer}",
        str(like.num_clips),
        " ".join(map(format_number, like.correlation.values())),
        format_number(like.error, ".0f"),
        format_number(like.lag_ms, "+.0f"),
        format_number(like.closure_f1),
        format_number(score.jerk and score.jerk / 1e6, ".1f"),
        format_number(score.phone_delay_p50_ms, ".0f"),
        format_number(score.face_delay_ms, ".0f"),
        f"{sync:.2f} {realism:.2f} {min_ms}",
    ]
