"""The report of a study: tables, and the two box plots of Li et al. 2011, figures 7 and 8."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

from corpora.figures import new_figure
from evaluation.mos.statistics import (
    WHISKERS,
    Comparison,
    Opinion,
    compare_all,
    group_scores,
    opinion_of,
)
from evaluation.mos.store import Answer
from evaluation.mos.study import SCALES, Study
from shared.errors import UserError


@dataclass(frozen=True, slots=True)
class Report:
    """What judges said."""

    opinions: list[Opinion]
    comparisons: list[Comparison]
    num_judges: int
    """Who gave any score."""
    num_finished: int
    """Of these, who scored every video."""
    unsure: list[int]
    """Numbers of judges who liked the anchor no less than the hidden reference."""


def make_report(study: Study, answers: Sequence[Answer]) -> Report:
    """Return what the answers say; all judges count, to the video they came to.

    Raises
    ------
    UserError
        If nobody has answered.
    """
    known = [each for each in answers if (each.sentence, each.condition) in study.files]
    if not known:
        raise UserError(f"{study.folder}: nobody has judged yet; type: kouxing mos serve")
    opinions, comparisons = [], []
    for scale in SCALES:
        groups = group_scores(known, scale)
        ordered = {name: groups[name] for name in study.conditions if name in groups}
        opinions += [opinion_of(scale, name, scores) for name, scores in ordered.items()]
        comparisons += compare_all(scale, ordered)
    judges = sorted({each.judge for each in known})
    num_all = len(study.files) * len(SCALES)
    num_finished = sum(sum(each.judge == judge for each in known) == num_all for judge in judges)
    unsure = [judge for judge in judges if _is_unsure(study, known, judge)]
    return Report(opinions, comparisons, len(judges), num_finished, unsure)


def print_report(study: Study, report: Report, console: Console) -> None:
    """Print the tables."""
    roles = {study.reference: " (hidden reference)", study.anchor: " (anchor)"}
    table = Table(title="mean opinion scores, 95 % confidence")
    for title in ("scale", "condition", "MOS", "judges", "scores", "outliers"):
        table.add_column(title, overflow="fold")
    for each in report.opinions:
        width = "" if each.half_width is None else f" ± {each.half_width:.2f}"
        table.add_row(
            each.scale,
            each.condition + roles.get(each.condition, ""),
            f"{each.mos:.2f}{width}",
            *(str(number) for number in (each.num_judges, each.num_scores, each.num_outliers)),
        )
    console.print(table)
    table = Table(title="pairs: Wilcoxon's signed-rank test, corrected by Holm")
    for title in ("scale", "conditions", "difference", "judges", "p"):
        table.add_column(title, overflow="fold")
    for pair in report.comparisons:
        difference = f"{pair.difference:+.2f}"
        names = " - ".join(pair.conditions)
        table.add_row(pair.scale, names, difference, str(pair.num_judges), f"{pair.p:.3g}")
    console.print(table)
    console.print(f"{report.num_judges} judges, {report.num_finished} of them to the end")
    if report.unsure:
        numbers = ", ".join(map(str, report.unsure))
        console.print(f"who liked the anchor no less than the hidden reference: {numbers}")


def draw_boxes(study: Study, answers: Sequence[Answer]) -> Any:
    """Return the figure: a box plot of the scores of every condition, for each scale."""
    figure = new_figure(4.0 + 1.2 * len(study.conditions), 4.5)
    for axes, scale in zip(figure.subplots(1, len(SCALES), sharey=True), SCALES, strict=True):
        groups = group_scores(answers, scale)
        names = [name for name in study.conditions if name in groups]
        axes.boxplot([[*groups[name].values()] for name in names], whis=WHISKERS)
        axes.set_xticks(range(1, len(names) + 1), names, rotation=30, ha="right")
        axes.set(title=scale, ylim=(0.8, 5.2), yticks=range(1, 6))
    figure.axes[0].set_ylabel("score")
    return figure


def to_csv(answers: Iterable[Answer]) -> str:
    """Return one line for every score, with the time at which it came (Unix, s)."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(("judge", "sentence", "condition", "scale", "score", "unix_s"))
    for each in answers:
        cells = each.judge, each.sentence, each.condition, each.scale, each.score
        writer.writerow((*cells, f"{each.unix_s:.3f}"))
    return text.getvalue()


def _is_unsure(study: Study, answers: Iterable[Answer], judge: int) -> bool:
    if not study.reference or not study.anchor:
        return False
    scores: dict[str, list[int]] = {study.reference: [], study.anchor: []}
    for each in answers:
        if each.judge == judge and each.condition in scores:
            scores[each.condition].append(each.score)
    if not all(scores.values()):
        return False
    means = {name: sum(values) / len(values) for name, values in scores.items()}
    return means[study.anchor] >= means[study.reference]
