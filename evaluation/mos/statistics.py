"""What scores say: outliers, mean opinion scores with confidence, and pairwise tests.

Li et al. 2011, 3.3, draw box plots of each scheme's scores by the interquartile range, remove the
outliers and take the mean (table 2). They do not name the fences; these are Tukey's, a box plot's.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from evaluation.mos.store import Answer

WHISKERS = 1.5  # interquartile ranges beyond the quartiles within which a score is no outlier
CONFIDENCE = 0.95

Scores = dict[tuple[int, str], int]  # of one condition on one scale, by judge and sentence


@dataclass(frozen=True, slots=True, kw_only=True)
class Opinion:
    """How judges find one condition on one scale."""

    scale: str
    condition: str
    mos: float
    """Mean opinion score, 1 to 5: the mean of all scores without outliers."""
    half_width: float | None
    """Of its 95 % confidence interval; None: there is but one judge.

    By Student's t over judges, since the scores of one are alike. One who gave few counts little.
    """
    num_judges: int
    num_scores: int
    num_outliers: int
    """Of the scores, those that were removed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
    """Whether two conditions differ on one scale."""

    scale: str
    conditions: tuple[str, str]
    num_judges: int
    """Who have scores of both left, of the same sentence."""
    difference: float
    """Mean over these judges of the first's scores less the second's."""
    p: float
    """Of Wilcoxon's signed-rank test, two-sided, corrected by Holm over the scale's pairs.

    A judge counts once, by the mean over sentences: what one judge says of twenty sentences is no
    twenty opinions.
    """


def group_scores(answers: Iterable[Answer], scale: str) -> dict[str, Scores]:
    """Return the scores on one scale by condition."""
    groups: defaultdict[str, Scores] = defaultdict(dict)
    for answer in answers:
        if answer.scale == scale:
            groups[answer.condition][answer.judge, answer.sentence] = answer.score
    return dict(groups)


def is_within_fences(scores: ArrayLike) -> NDArray[np.bool_]:
    """Tell which scores are no outliers of their box plot: shape (n,), from shape (n,).

    Quartiles are interpolated linearly, as NumPy and matplotlib do.
    """
    values = np.asarray(scores, float)
    lower, upper = np.quantile(values, [0.25, 0.75])
    reach = WHISKERS * (upper - lower)
    return np.asarray((values >= lower - reach) & (values <= upper + reach))


def without_outliers(scores: Scores) -> Scores:
    """Return the scores of one condition that are no outliers."""
    kept = is_within_fences([*scores.values()])
    return {key: score for (key, score), keep in zip(scores.items(), kept, strict=True) if keep}


def opinion_of(scale: str, condition: str, scores: Scores) -> Opinion:
    """Return the mean opinion of one condition."""
    kept = without_outliers(scores)
    by_judge: defaultdict[int, list[int]] = defaultdict(list)
    for (judge, _), score in kept.items():
        by_judge[judge].append(score)
    mos = float(np.mean([*kept.values()]))
    return Opinion(
        scale=scale,
        condition=condition,
        mos=mos,
        half_width=_half_width(mos, [*by_judge.values()]),
        num_judges=len(by_judge),
        num_scores=len(scores),
        num_outliers=len(scores) - len(kept),
    )


def compare_all(scale: str, groups: dict[str, Scores]) -> list[Comparison]:
    """Compare the conditions of one scale, each with each, where they have pairs of scores."""
    kept = {condition: without_outliers(scores) for condition, scores in groups.items()}
    found: list[tuple[tuple[str, str], NDArray[np.float64]]] = []
    for first, second in combinations(kept, 2):
        by_judge: defaultdict[int, list[int]] = defaultdict(list)
        for key in sorted(kept[first].keys() & kept[second].keys()):
            by_judge[key[0]].append(kept[first][key] - kept[second][key])
        if by_judge:
            found.append(((first, second), np.array([np.mean(each) for each in by_judge.values()])))
    corrected = holm([_signed_rank_p(differences) for _, differences in found])
    return [
        Comparison(
            scale=scale,
            conditions=conditions,
            num_judges=len(differences),
            difference=float(differences.mean()),
            p=p,
        )
        for (conditions, differences), p in zip(found, corrected, strict=True)
    ]


def holm(ps: Sequence[float]) -> list[float]:
    """Correct p values for their number (Holm 1979)."""
    order = np.argsort(ps)
    factors = len(ps) - np.arange(len(ps))
    corrected = np.empty(len(ps))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * np.asarray(ps)[order]), 1.0)
    return [float(p) for p in corrected]


def _half_width(mos: float, by_judge: Sequence[Sequence[int]]) -> float | None:
    num_judges = len(by_judge)
    if num_judges < 2:
        return None
    # The variance of a ratio, scores to their number, whose parts are sums over judges (Cochran,
    # Sampling Techniques, 1977, section 6.3); with as many scores of each, that of their means.
    surplus = [sum(scores) - mos * len(scores) for scores in by_judge]
    variance = num_judges / (num_judges - 1) * np.sum(np.square(surplus))
    quantile = stats.t.ppf((1 + CONFIDENCE) / 2, num_judges - 1)
    return float(quantile * np.sqrt(variance) / sum(map(len, by_judge)))


def _signed_rank_p(differences: NDArray[np.float64]) -> float:
    if not differences.any():
        return 1.0
    return float(stats.wilcoxon(differences).pvalue)
