"""The report of a study: tables, and the two box plots of Li et al. 2011, figures 7 and 8."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from rich.console import Console
from rich.table import Table

from kouxing.corpora.figures import new_figure
from kouxing.evaluation.mos.statistics import (
    WHISKERS,
    Comparison,
    Mean,
    Opinion,
    compare_all,
    group_scores,
    opinion_of,
)
from kouxing.evaluation.mos.store import Answer
from kouxing.evaluation.mos.study import SCALES, Study
from kouxing.shared.errors import UserError


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
    known = counted(study, answers)
    if not known:
        raise UserError(f"{study.folder}: nobody has judged yet; type: kouxing mos serve")
    opinions, comparisons = [], []
    for scale in SCALES:
        groups = group_scores(known, scale)
        ordered = {name: groups[name] for name in study.conditions if name in groups}
        for name, scores in ordered.items():
            reference = None if name == study.reference else groups.get(study.reference)
            opinions.append(opinion_of(scale, name, scores, reference))
        comparisons += compare_all(scale, ordered)
    judges = sorted({each.judge for each in known})
    num_all = len(study.files) * len(SCALES)
    num_finished = sum(sum(each.judge == judge for each in known) == num_all for judge in judges)
    unsure = [judge for judge in judges if _is_unsure(study, known, judge)]
    return Report(opinions, comparisons, len(judges), num_finished, unsure)


def counted(study: Study, answers: Iterable[Answer]) -> list[Answer]:
    """Return the answers without practice, and without videos that the study has not."""
    return [
        each
        for each in answers
        if each.place >= 0 and (each.sentence, each.condition) in study.files
    ]


def print_report(study: Study, report: Report, console: Console) -> None:
    """Print the tables."""
    roles = {study.reference: " (hidden reference)", study.anchor: " (anchor)"}
    table = Table(title="mean opinion scores, 95 % confidence")
    titles = ["scale", "condition", "MOS, all scores", "MOS, no outliers"]
    if study.reference:
        titles.append("to reference")
    for title in (*titles, "judges", "scores", "outliers"):
        table.add_column(title, overflow="fold")
    for each in report.opinions:
        means: list[Mean | None] = [each.of_all, each.without_outliers]
        if study.reference:
            means.append(each.differential)
        table.add_row(
            each.scale,
            each.condition + roles.get(each.condition, ""),
            *map(_shown, means),
            *(str(number) for number in (each.num_judges, each.num_scores, each.num_outliers)),
        )
    console.print(table)
    console.print(
        "Trust the intervals of all scores. MOS without outliers is for comparison with Li et al. "
        "2011; its intervals are too narrow."
    )
    if study.reference:
        console.print("to reference: score - score of the hidden reference + 5 (ACR-HR)")
    table = Table(title="pairs, all scores: Wilcoxon's signed-rank test, corrected by Holm")
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
        groups = group_scores(counted(study, answers), scale)
        names = [name for name in study.conditions if name in groups]
        axes.boxplot([[*groups[name].values()] for name in names], whis=WHISKERS)
        axes.set_xticks(range(1, len(names) + 1), names, rotation=30, ha="right")
        axes.set(title=scale, ylim=(0.8, 5.2), yticks=range(1, 6))
    figure.axes[0].set_ylabel("score")
    return figure


def to_csv(study: Study, answers: Iterable[Answer]) -> str:
    """Return one line for every score.

    ``place`` is that in the judge's order; ``role`` is practice (a place below 0), reference,
    anchor or empty; ``language`` that of the page; ``unix_s`` when the score came.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    names = [each.name for each in fields(Answer)]
    writer.writerow((*names, "role"))
    roles = {study.reference: "reference", study.anchor: "anchor"}
    for each in answers:
        role = "practice" if each.place < 0 else roles.get(each.condition, "")
        cells = {**asdict(each), "unix_s": f"{each.unix_s:.3f}"}
        writer.writerow((*cells.values(), role))
    return text.getvalue()


def _shown(mean: Mean | None) -> str:
    if mean is None:
        return "-"
    return f"{mean.value:.2f}" + ("" if mean.half_width is None else f" ± {mean.half_width:.2f}")


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
