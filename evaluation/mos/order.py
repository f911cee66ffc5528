"""The order in which a judge sees the videos: random sentences, balanced conditions.

A Williams design (Williams 1949) is a Latin square in which every condition also follows every
other equally often, so that what was just seen favours none: one square for an even number of
conditions, two for an odd one. A judge sees as many blocks as there are sentences. Each block is a
row of the design, shows every condition once, and sentences that differ as far as they last. Which
rows follow one another is drawn at random: in turn, the same two conditions would always meet where
blocks do.

Before that come some videos for practice (ITU-T P.910), which do not count: one sentence in the
conditions that differ most, as far as the study tells.
"""

from __future__ import annotations

import random

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.mos.study import Study

NUM_PRACTICE = 2


def williams_design(num_conditions: int) -> NDArray[np.int64]:
    """Return the orders of conditions, each a row: shape (n, n), for an odd n > 1 (2 n, n)."""
    n = num_conditions
    steps = np.arange(n)
    first = np.where(steps % 2, (steps + 1) // 2, -(steps // 2))  # 0, 1, -1, 2, -2 ...
    square = (first + steps[:, None]) % n
    return square if n % 2 == 0 or n == 1 else np.vstack([square, square[:, ::-1]])


def order_of_judge(
    judge: int, sentences: tuple[str, ...], conditions: tuple[str, ...]
) -> list[tuple[str, str]]:
    """Return every sentence in every condition once, in the order for one judge.

    Parameters
    ----------
    judge
        Number of the judge: as many in a row as the design has rows see every condition equally
        often at every place. The same number has the same order for ever.
    sentences, conditions
        Their names.
    """
    design = williams_design(len(conditions))
    turns = random.Random(0)  # noqa: S311 - of the blocks, the same for all judges
    shuffled = random.Random(judge).sample(sentences, len(sentences))  # noqa: S311 - no secret
    # How many sentences further each condition is: one sentence returns as late as it can.
    offsets = design[judge % len(design)] * len(sentences) // len(conditions)
    return [
        (shuffled[(block + offsets[condition]) % len(sentences)], conditions[condition])
        for block in range(len(sentences))
        for condition in design[(judge + turns.randrange(len(design))) % len(design)]
    ]


def places_of_judge(judge: int, study: Study) -> dict[int, tuple[str, str]]:
    """Return the sentence and condition at every place of a judge's order; below 0: practice."""
    order = order_of_judge(judge, study.sentences, study.conditions)
    first = dict.fromkeys((study.reference, study.anchor, *study.conditions))
    known = [condition for condition in first if condition][:NUM_PRACTICE]
    practice = [(order[-1][0], condition) for condition in known]  # the sentence returns late
    return dict(enumerate([*practice, *order], start=-len(practice)))
