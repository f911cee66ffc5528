"""Plot the recognizer's errors over its delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from kouxing.corpora.figures import new_figure, save_figure

_STYLES = {"": ("o-", "first"), "final_": ("s--", "final")}  # by prefix of the keys


def draw_delay_curve(results: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Plot the errors of both hypotheses over the median delay of the first.

    Parameters
    ----------
    results
        Results of ``evaluate_recognizer``, with the model's name as ``acoustic``. Those of one
        model, with several look-aheads, are adjacent.
    path
        File of the picture.

    Raises
    ------
    UserError
        If the picture cannot be written.
    """
    figure = new_figure(11.0, 4.5)
    for axes, kind in zip(figure.subplots(1, 2), ("phone", "viseme"), strict=True):
        by_model = groupby(results, key=lambda result: result["acoustic"])
        for number, (name, group) in enumerate(by_model):
            defaults = [result["scores"][-1] for result in group]
            scores = [score for score in defaults if "delay_ms" in score]
            scores.sort(key=lambda score: score["delay_ms"]["p50"])
            delays_ms = [score["delay_ms"]["p50"] for score in scores]
            for prefix, (style, hypothesis) in _STYLES.items():
                rates = [100 * score[f"{prefix}{kind}_error_rate"] for score in scores]
                label = f"{name}, {hypothesis} hypothesis"
                axes.plot(delays_ms, rates, style, color=f"C{number}", label=label)
        axes.set_xlabel("median delay of the first hypothesis, ms")
        axes.set_ylabel(f"{kind} errors, %")
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path)
