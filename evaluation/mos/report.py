"""The report of a study: mean opinion scores.

Li et al. 2011, section 3.3, remove the outliers and take the mean (table 2). They do not define the
fences; these are Tukey's. An interval of scores without outliers is too narrow, so the report also
has the mean of all scores.
"""

import csv
import io
import shlex
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from kouxing.evaluation.mos.store import Answer
from kouxing.evaluation.mos.study import SCALES, Study
from kouxing.evaluation.tables import Table
from kouxing.shared.arrays import Mask
from kouxing.shared.errors import UserError

FENCE_RANGES = 1.5  # distance of the fences from the quartiles, in interquartile ranges
Scores = dict[tuple[int, str], int]  # one condition on one scale, by judge and sentence


@dataclass(frozen=True, slots=True)
class MeanScore:
    """Mean score with its 95 % confidence interval, by Student's t over judges."""

    value: float
    half_width: float | None  # None: there is only one judge

    def __str__(self) -> str:
        return f"{self.value:.2f}" + (f"±{self.half_width:.2f}" if self.half_width else "")


@dataclass(frozen=True, slots=True)
class Opinion:
    """Scores of one condition on one scale."""

    scale: str
    condition: str
    of_all: MeanScore
    without_outliers: MeanScore  # as in the paper
    num_judges: int
    num_scores: int
    num_outliers: int


def make_report(study: Study, answers: Iterable[Answer]) -> list[Opinion]:
    """Compute the results; raises ``UserError`` if there are no answers."""
    groups: dict[tuple[str, str], Scores] = {
        (scale, condition): {} for scale in SCALES for condition in study.conditions
    }
    for answer in answers:
        is_practice = answer.place < 0
        if not is_practice and (answer.sentence, answer.condition) in study.files:
            scores = groups[answer.scale, answer.condition]
            scores[answer.judge, answer.sentence] = answer.score
    opinions = [opinion_of(*key, scores) for key, scores in groups.items() if scores]
    if not opinions:
        folder = shlex.quote(str(study.folder))
        raise UserError(f"no answers yet; collect them with: kouxing mos serve {folder}")
    return opinions


def is_within_fences(scores: ArrayLike) -> Mask:
    """Return which scores (n,) are not outliers; quartiles are interpolated linearly."""
    values = np.asarray(scores, float)
    lower, upper = np.quantile(values, [0.25, 0.75])
    reach = FENCE_RANGES * (upper - lower)
    return np.asarray((values >= lower - reach) & (values <= upper + reach))


def opinion_of(scale: str, condition: str, scores: Scores) -> Opinion:
    """Summarize the scores of one condition."""
    is_kept = is_within_fences([*scores.values()])
    included = {
        key: score for (key, score), keep in zip(scores.items(), is_kept, strict=True) if keep
    }
    num_judges = len({judge for judge, _ in scores})
    means = mean_of(scores), mean_of(included)
    return Opinion(scale, condition, *means, num_judges, len(scores), len(scores) - len(included))


def mean_of(scores: Scores) -> MeanScore:
    """Return the mean of at least one score."""
    by_judge: defaultdict[int, list[int]] = defaultdict(list)
    for (judge, _), score in scores.items():
        by_judge[judge].append(score)
    mean, num_judges = float(np.mean([*scores.values()])), len(by_judge)
    if num_judges < 2:
        return MeanScore(mean, None)
    # Variance of a ratio whose parts are sums over judges (Cochran 1977, section 6.3). If all
    # judges gave equally many scores, it is the variance of their means.
    deviations = [sum(values) - mean * len(values) for values in by_judge.values()]
    variance = num_judges / (num_judges - 1) * np.sum(np.square(deviations))
    return MeanScore(
        mean, float(stats.t.ppf(0.975, num_judges - 1) * np.sqrt(variance) / len(scores))
    )


def opinions_table(opinions: Iterable[Opinion]) -> Table:
    """Return the results as a table."""
    rows = [
        [
            opinion.scale,
            opinion.condition,
            *map(str, (opinion.of_all, opinion.without_outliers, opinion.num_judges)),
            f"{opinion.num_outliers} of {opinion.num_scores}",
        ]
        for opinion in opinions
    ]
    columns = ("scale", "condition", "all scores", "no outliers", "judges", "outliers")
    title = """\
mean opinion scores, 95 % confidence
Use the intervals of all scores; those without outliers are too narrow."""
    return Table(columns, rows, title)


def to_csv(answers: Iterable[Answer]) -> str:
    """Return a table with a line per score; ``practice`` is True for those that do not count."""
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow([*(field.name for field in fields(Answer)), "practice"])
    for answer in answers:
        writer.writerow([*asdict(answer).values(), answer.place < 0])
    return table.getvalue()
