"""The order in which a judge sees the videos: a Williams design (Williams 1949).

It is a Latin square, or two for an odd number of conditions, in which every condition also follows
every other equally often. A judge sees one row per sentence, drawn at random. Two videos for
practice (ITU-T P.910) come first and do not count.
"""

from __future__ import annotations

import random

import numpy as np
from numpy.typing import NDArray

from kouxing.evaluation.mos.study import Study


def williams_design(num_conditions: int) -> NDArray[np.int64]:
    """Return orders of conditions as rows: shape (n, n), for an odd n > 1 (2 n, n)."""
    n = num_conditions
    steps = np.arange(n)
    first = np.where(steps % 2, (steps + 1) // 2, -(steps // 2))  # 0, 1, -1, 2, -2 ...
    square = (first + steps[:, None]) % n
    return square if n % 2 == 0 or n == 1 else np.vstack([square, square[:, ::-1]])


def places_of_judge(judge: int, study: Study) -> dict[int, tuple[str, str]]:
    """Return the sentence and condition at every place of a judge; practice is below 0.

    If the number of judges is a multiple of the design's number of rows, every condition is equally
    frequent at every place.
    """
    sentences, conditions = study.sentences, study.conditions
    design = williams_design(len(conditions))
    rows = random.Random(0)  # noqa: S311 - no secret; the same for all judges
    shuffled = random.Random(judge).sample(sentences, len(sentences))  # noqa: S311 - no secret
    # The conditions use sentences as far apart as possible, so that a sentence returns late.
    offsets = design[judge % len(design)] * len(sentences) // len(conditions)
    order = [
        (shuffled[(block + offsets[condition]) % len(sentences)], conditions[condition])
        for block in range(len(sentences))
        for condition in design[(judge + rows.randrange(len(design))) % len(design)]
    ]
    extremes = dict.fromkeys((study.reference, study.anchor, *conditions))
    practice = [(order[-1][0], condition) for condition in extremes if condition][:2]
    return dict(enumerate([*practice, *order], start=-len(practice)))
