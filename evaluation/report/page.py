"""Writes the report page, docs/results.md, and its picture from the results of the steps.

``template.md`` has the text, with a line ``[[NAME]]`` for each table.
"""

import json
import re
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from kouxing.corpora.figures import new_figure, save_figure
from kouxing.evaluation.report import lip_tables, paper_tables, recognition_table, system_tables
from kouxing.evaluation.report.lip_tables import CLOSURE_COLUMNS, MOTION_COLUMNS, measures_table
from kouxing.evaluation.report.steps import STEPS
from kouxing.evaluation.tables import Figures, Table

PICTURE = "delay.png"
_TEMPLATE = Path(__file__).with_name("template.md")

# Each table lists the steps whose results it shows, and a function that makes the table from these
# results. A step that was not measured has an empty result.
TABLES: dict[str, tuple[tuple[str, ...], Callable[..., Table]]] = {
    "recognition": (
        ("read", "conversation", "disturbed", "languages"),
        recognition_table.recognition,
    ),
    "agreement": (("rivals",), lip_tables.agreement_table),
    "closures": (("rivals",), partial(measures_table, measures=CLOSURE_COLUMNS)),
    "delay": (("delay",), lip_tables.delay_table),
    "motion": (("rivals",), partial(measures_table, measures=MOTION_COLUMNS)),
    "schemes": (("schemes", "schemes-paper-rule"), paper_tables.report_schemes),
    "visemes": (("visemes",), paper_tables.viseme_fit_table),
    "ferguson": (("ferguson",), paper_tables.ferguson_table),
    "system": (
        ("latency", "load", "busy", "browser", "package", "sizes"),
        system_tables.system_table,
    ),
    "faults": (("faults",), system_tables.faults_table),
}


def read_results(folder: Path) -> dict[str, Any]:
    """Read the results of all measured steps."""
    paths = {name: folder / f"{name}.json" for name in STEPS}
    return {n: json.loads(path.read_text("utf-8")) for n, path in paths.items() if path.exists()}


def write_page(folder: Path, page: Path) -> None:
    """Write the page and its picture from the results in a folder."""
    steps = read_results(folder)
    results = {name: step["result"] for name, step in steps.items()}
    better = [
        *lip_tables.better_programs(results.get("rivals", {})),
        *recognition_table.better_recognizers(results.get("languages", {})),
        *system_tables.better_packages(results.get("browser", {})),
    ]
    lines = [
        f"{measure}: {figure} ({program}); kouxing {own}"
        for measure, program, figure, own in better
    ]
    text = _TEMPLATE.read_text("utf-8").replace("[[better]]\n", bullets(lines or ["In no measure"]))
    parts = re.sub(r"\[\[(\w+)\]\]\n", lambda match: _render_table(match[1], steps, results), text)
    page.write_text(parts, encoding="utf-8")
    if "delay" in results:
        save_figure(_delay_figure(results["delay"]), page.with_name(PICTURE))


def markdown(table: Table) -> str:
    """Return a table in Markdown."""
    lines = [table.columns, ["---"] * len(table.columns), *table.rows]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in lines)


def bullets(sentences: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "".join(f"- {sentence}\n" for sentence in sentences)


def _render_table(name: str, steps: Figures, results: Figures) -> str:
    shown, make_table = TABLES[name]
    missing = [step for step in shown if step not in steps]
    command = f'Not measured yet: `make report STEPS="{" ".join(missing)}"`'
    if missing == [*shown]:
        return f"{command}.\n"
    notes = [_describe_measurement(steps[step]) for step in shown if step in steps]
    notes += [command] if missing else []
    if name == "agreement" and "lips" in steps:
        notes += [*lip_tables.disturbed_lips(results["lips"]), _describe_measurement(steps["lips"])]
    table = make_table(*(results.get(step, {}) for step in shown))
    return f"{markdown(table)}\n{bullets(notes)}"


def _describe_measurement(step: Figures) -> str:
    commands = "`, `".join(step["commands"])
    measured = f"{step['machine']}, {step['date']}, commit {step['commit']}"
    cpu = f" ({step['cpu_seconds']} s of processor time)" if "cpu_seconds" in step else ""
    return f"`{commands}`: {measured}, {step['seconds']} s{cpu}, load {step['load']:.1f}"


def _delay_figure(faces: Figures) -> Any:
    figure = new_figure(9.0, 3.6)
    axes = figure.subplots(1, 2, sharex=True)
    titles = {"r_opening": "correlation of the opening", "closure_f1": "F1 of closures"}
    for lips, points in lip_tables.delay_curves(faces).items():
        for axis, (measure, title) in zip(axes, titles.items(), strict=True):
            delays = sorted(points)
            axis.plot(delays, [points[delay][measure] for delay in delays], "o-", label=lips)
            axis.set_title(title, fontsize=9)
            axis.set_xlabel("delay, ms")
            axis.set_ylim(0.0, 1.0)
    axes[-1].legend(fontsize=8)
    return figure
