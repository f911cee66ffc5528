"""The report of a study: mean opinion scores and box plots.

Li et al. 2011, section 3.3, draw box plots (figures 7 and 8), remove the outliers and take the mean
(table 2). They do not define the fences; these are Tukey's. An interval of scores without outliers
is too narrow, so the report also has the mean of all scores.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.console import Console
from rich.table import Table
from scipy import stats

from kouxing.corpora.figures import new_figure
from kouxing.evaluation.mos.store import Answer
from kouxing.evaluation.mos.study import SCALES, Study
from kouxing.shared.errors import UserError

WHISKERS = 1.5  # interquartile ranges from the quartiles to the fences
Scores = dict[tuple[int, str], int]  # of one condition on one scale, by judge and sentence


@dataclass(frozen=True, slots=True)
class Mean:
    """Mean score with its 95 % confidence interval, by Student's t over judges."""

    value: float
    half_width: float | None  # None: there is only one judge

    def __str__(self) -> str:
        interval = "" if self.half_width is None else f" ± {self.half_width:.2f}"
        return f"{self.value:.2f}{interval}"


@dataclass(frozen=True, slots=True, kw_only=True)
class Opinion:
    """Scores of one condition on one scale."""

    scale: str
    condition: str
    of_all: Mean
    without_outliers: Mean  # as in the paper
    num_judges: int
    num_scores: int
    num_outliers: int


@dataclass(frozen=True, slots=True)
class Report:
    """Results of a study."""

    opinions: list[Opinion]
    num_judges: int  # who gave any score
    num_finished: int  # who scored every video


def make_report(study: Study, answers: Iterable[Answer]) -> Report:
    """Compute the results; raises UserError if there are no answers."""
    answers = counted(study, answers)
    if not answers:
        raise UserError(f"{study.folder} has no answers yet; start with: kouxing mos serve")
    opinions = [
        opinion_of(scale, condition, scores)
        for scale in SCALES
        for condition, scores in group_scores(study, answers, scale).items()
    ]
    num_scores = Counter(answer.judge for answer in answers)
    num_finished = sum(n == len(study.files) * len(SCALES) for n in num_scores.values())
    return Report(opinions, len(num_scores), num_finished)


def counted(study: Study, answers: Iterable[Answer]) -> list[Answer]:
    """Leave out practice, and videos that the study does not contain."""
    files = study.files
    return [a for a in answers if a.place >= 0 and (a.sentence, a.condition) in files]


def group_scores(study: Study, answers: Iterable[Answer], scale: str) -> dict[str, Scores]:
    """Return the scores on one scale by condition, in the study's order."""
    groups: dict[str, Scores] = {name: {} for name in study.conditions}
    for answer in answers:
        if answer.scale == scale:
            groups[answer.condition][answer.judge, answer.sentence] = answer.score
    return {name: scores for name, scores in groups.items() if scores}


def is_within_fences(scores: ArrayLike) -> NDArray[np.bool_]:
    """Return which scores (n,) are not outliers; quartiles are interpolated linearly."""
    values = np.asarray(scores, float)
    lower, upper = np.quantile(values, [0.25, 0.75])
    reach = WHISKERS * (upper - lower)
    return np.asarray((values >= lower - reach) & (values <= upper + reach))


def opinion_of(scale: str, condition: str, scores: Scores) -> Opinion:
    """Summarize the scores of one condition."""
    is_kept = is_within_fences([*scores.values()])
    kept = {key: score for (key, score), keep in zip(scores.items(), is_kept, strict=True) if keep}
    return Opinion(
        scale=scale,
        condition=condition,
        of_all=mean_of(scores),
        without_outliers=mean_of(kept),
        num_judges=len({judge for judge, _ in scores}),
        num_scores=len(scores),
        num_outliers=len(scores) - len(kept),
    )


def mean_of(scores: Scores) -> Mean:
    """Return the mean of at least one score."""
    by_judge: defaultdict[int, list[int]] = defaultdict(list)
    for (judge, _), score in scores.items():
        by_judge[judge].append(score)
    mean, num_judges = float(np.mean([*scores.values()])), len(by_judge)
    if num_judges < 2:
        return Mean(mean, None)
    # Variance of a ratio whose parts are sums over judges (Cochran 1977, section 6.3). If all
    # judges gave equally many scores, it is the variance of their means.
    surplus = [sum(values) - mean * len(values) for values in by_judge.values()]
    variance = num_judges / (num_judges - 1) * np.sum(np.square(surplus))
    return Mean(mean, float(stats.t.ppf(0.975, num_judges - 1) * np.sqrt(variance) / len(scores)))


def print_report(study: Study, report: Report, console: Console) -> None:
    """Print the results as a table."""
    roles = {study.reference: " (hidden reference)", study.anchor: " (anchor)"}
    table = Table(title="mean opinion scores, 95 % confidence")
    for column in ("scale", "condition", "all scores", "no outliers", "judges", "outliers"):
        table.add_column(column, overflow="fold")
    for opinion in report.opinions:
        name = opinion.condition + roles.get(opinion.condition, "")
        outliers = f"{opinion.num_outliers} of {opinion.num_scores}"
        means = str(opinion.of_all), str(opinion.without_outliers)
        table.add_row(opinion.scale, name, *means, str(opinion.num_judges), outliers)
    console.print(table)
    console.print("Use the intervals of all scores; those without outliers are too narrow.")
    console.print(f"{report.num_judges} judges, {report.num_finished} scored every video")


def draw_boxes(study: Study, answers: Sequence[Answer]) -> Any:
    """Return a figure with a box plot of every condition's scores, for each scale."""
    figure = new_figure(4.0 + 1.2 * len(study.conditions), 4.5)
    for axes, scale in zip(figure.subplots(1, len(SCALES), sharey=True), SCALES, strict=True):
        groups = group_scores(study, counted(study, answers), scale)
        axes.boxplot([[*scores.values()] for scores in groups.values()], whis=WHISKERS)
        axes.set_xticks(range(1, len(groups) + 1), groups, rotation=30, ha="right")
        axes.set(title=scale, ylim=(0.8, 5.2), yticks=range(1, 6))
    figure.axes[0].set_ylabel("score")
    return figure
