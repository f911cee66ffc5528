"""The training curves, as an image next to the model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kouxing.corpora.figures import new_figure, save_figure

_SMOOTHED_STEPS = 20


def draw_curves(
    losses: Sequence[tuple[int, float]], error_rates: Sequence[tuple[int, float]], path: Path
) -> None:
    """Draw cross-entropy (nats a frame) and dev phone error rate over the steps.

    Both are pairs of step and value. There may be no error rates.
    """
    figure = new_figure(6.0, 3.2)
    left = figure.add_subplot()
    right = left.twinx()
    steps, nats = np.array(losses).T
    width = min(_SMOOTHED_STEPS, len(steps))
    left.plot(steps[width - 1 :], np.convolve(nats, np.ones(width) / width, "valid"), linewidth=0.8)
    if error_rates:
        right.plot(*zip(*((step, 100 * rate) for step, rate in error_rates), strict=True), "o:")
    left.set_xlabel("steps")
    left.set_ylabel("nats a frame (line)")
    right.set_ylabel("dev phone error % (dots)")
    right.set_ylim(bottom=0)
    save_figure(figure, path)
