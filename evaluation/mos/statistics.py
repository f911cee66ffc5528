"""What scores say: outliers, mean opinion scores with confidence, and pairwise tests.

Li et al. 2011, 3.3, draw box plots of each scheme's scores by the interquartile range, remove the
outliers and take the mean (table 2). They do not name the fences; these are Tukey's, a box plot's.

Without outliers scores differ less than those of the next judges will, so an interval made of them
is too narrow. Whatever else is computed here is computed of all scores.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from kouxing.evaluation.mos.store import Answer

WHISKERS = 1.5  # interquartile ranges beyond the quartiles within which a score is no outlier
CONFIDENCE = 0.95

Scores = dict[tuple[int, str], int]  # of one condition on one scale, by judge and sentence


@dataclass(frozen=True, slots=True)
class Mean:
    """A mean of scores."""

    value: float
    half_width: float | None
    """Of its 95 % confidence interval; None: there is but one judge.

    By Student's t over judges, since the scores of one are alike. One who gave few counts little.
    """


@dataclass(frozen=True, slots=True, kw_only=True)
class Opinion:
    """How judges find one condition on one scale."""

    scale: str
    condition: str
    without_outliers: Mean
    """Mean opinion score, 1 to 5, as the paper has it."""
    of_all: Mean
    """Mean opinion score of all scores, whose interval can be trusted."""
    differential: Mean | None
    """Mean of a judge's score less that judge's score of the hidden reference in the same sentence,
    plus 5 (ACR-HR, ITU-T P.910, P.913); None: this is the reference, or there is none."""
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
    """Who have scored both, in the same sentence."""
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


def differential_scores(scores: Scores, reference: Scores) -> Scores:
    """Return score - reference + 5 of every judge and sentence that have both.

    As P.910 has it: 5 and more where the condition is no worse than the hidden reference.
    """
    both = scores.keys() & reference.keys()
    return {key: scores[key] - reference[key] + 5 for key in scores if key in both}


def opinion_of(
    scale: str, condition: str, scores: Scores, reference: Scores | None = None
) -> Opinion:
    """Return the mean opinion of one condition; ``reference``: scores of the hidden reference."""
    kept = without_outliers(scores)
    differential = differential_scores(scores, reference or {})
    return Opinion(
        scale=scale,
        condition=condition,
        without_outliers=mean_of(kept),
        of_all=mean_of(scores),
        differential=mean_of(differential) if differential else None,
        num_judges=len({judge for judge, _ in scores}),
        num_scores=len(scores),
        num_outliers=len(scores) - len(kept),
    )


def mean_of(scores: Scores) -> Mean:
    """Return the mean of at least one score."""
    by_judge: defaultdict[int, list[int]] = defaultdict(list)
    for (judge, _), score in scores.items():
        by_judge[judge].append(score)
    mean = float(np.mean([*scores.values()]))
    return Mean(mean, _half_width(mean, [*by_judge.values()]))


def compare_all(scale: str, groups: dict[str, Scores]) -> list[Comparison]:
    """Compare the conditions of one scale, each with each, where they have pairs of scores."""
    found: list[tuple[tuple[str, str], NDArray[np.float64]]] = []
    for first, second in combinations(groups, 2):
        by_judge: defaultdict[int, list[int]] = defaultdict(list)
        for key in sorted(groups[first].keys() & groups[second].keys()):
            by_judge[key[0]].append(groups[first][key] - groups[second][key])
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


def _half_width(mean: float, by_judge: Sequence[Sequence[int]]) -> float | None:
    num_judges = len(by_judge)
    if num_judges < 2:
        return None
    # The variance of a ratio, scores to their number, whose parts are sums over judges (Cochran,
    # Sampling Techniques, 1977, section 6.3); with as many scores of each, that of their means.
    surplus = [sum(scores) - mean * len(scores) for scores in by_judge]
    variance = num_judges / (num_judges - 1) * np.sum(np.square(surplus))
    quantile = stats.t.ppf((1 + CONFIDENCE) / 2, num_judges - 1)
    return float(quantile * np.sqrt(variance) / sum(map(len, by_judge)))


def _signed_rank_p(differences: NDArray[np.float64]) -> float:
    if not differences.any():
        return 1.0
    return float(stats.wilcoxon(differences).pvalue)
