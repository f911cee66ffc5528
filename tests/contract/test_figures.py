"""Measured figures: six in both READMEs, and the errors by language, equal the report's."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from kouxing.evaluation.report.page import read_results, write_page
from tests.system import ROOT

RESULTS = read_results(ROOT / "docs" / "results")


def phone_errors(result: Any) -> str:
    return f"{100 * result['blocks']['speech']['clean']['final']['phone_error_rate']:.1f} %"


FIGURES: list[tuple[str, Callable[[Any], str]]] = [  # step and value of each row
    (
        "latency",
        lambda r: "{p50:.1f} ms (p50), {p95:.1f} ms (p95)".format(**r["chunk_to_frame_ms"]),
    ),
    ("latency", lambda r: f"{sum(r['cpu_s_per_audio_s'].values()):.2f} s"),
    ("read", phone_errors),
    ("conversation", phone_errors),
    ("rivals", lambda r: f"{r['learned, 60 ms']['clean']['zh']['r_opening']:.2f}"),
    ("latency", lambda r: f"{r['page']['drawings']['microphone']['pictures_per_s']:.0f}"),
]


def figures_of(readme: str) -> list[str]:
    """Return the values of the table before the section on limits."""
    text = (ROOT / readme).read_text("utf-8")
    rows = re.findall(
        r"^\|[^|]*\|([^|]*)\| `kouxing (?:bench|evaluate)[^|]*\|$", text, re.MULTILINE
    )
    return [value.strip() for value in rows]


@pytest.mark.parametrize("readme", ["README.md", "README.zh.md"])
def test_the_readme_has_six_figures_of_the_report(readme: str) -> None:
    shown = figures_of(readme)
    assert len(shown) == len(FIGURES)
    for value, (step, figure) in zip(shown, FIGURES, strict=True):
        assert value.startswith(figure(RESULTS[step]["result"])), step


ENGLISH = "Mandarin {zh} %, German {de} %, English {en} %, Italian {it} %, Korean {ko} %"
CHINESE = "普通话 {zh}%，德语 {de}%，英语 {en}%，意大利语 {it}%，韩语 {ko}%"


@pytest.mark.parametrize(
    ("file", "text", "to"), [("README.md", ENGLISH, " to "), ("README.zh.md", CHINESE, "% 至 ")]
)
def test_the_errors_by_language_are_those_of_the_report(file: str, text: str, to: str) -> None:
    shown: dict[str, list[str]] = {}
    for group, score in RESULTS["languages"]["result"]["own"]["speech"].items():
        language = group.removeprefix("language ").partition("-")[0]
        rate = f"{100 * score['final']['feature_error_rate']:.0f}"
        shown[language] = sorted([*shown.get(language, []), rate], key=int)
    ranges = {name: to.join(dict.fromkeys((r[0], r[-1]))) for name, r in shown.items()}
    assert text.format(**ranges) in (ROOT / file).read_text("utf-8")


LIPS_ENGLISH = (
    "is only {opening:.2f}. - In Mandarin, the learned lips reproduce {recall:.0f} % of the real "
    "lip closures, at {precision:.0f} % precision. For the newsreader, precision is only"
    " {new:.0f} %."
)
LIPS_CHINESE = (
    "只有 {opening:.2f}。 - 普通话中真实的闭唇，学习式唇形重现了 {recall:.0f} %，"
    "精确率 {precision:.0f} %；对该播音员，精确率只有 {new:.0f} %。"
)


@pytest.mark.parametrize(
    ("file", "text"), [("README.md", LIPS_ENGLISH), ("README.zh.md", LIPS_CHINESE)]
)
def test_the_limits_of_the_learned_lips_are_those_of_the_report(file: str, text: str) -> None:
    scores = RESULTS["rivals"]["result"]["learned, 60 ms"]["clean"]
    mandarin, newsreader = scores["zh"], scores["zh new"]
    expected = text.format(
        opening=newsreader["r_opening"],
        recall=100 * mandarin["closure_recall"],
        precision=100 * mandarin["closure_precision"],
        new=100 * newsreader["closure_precision"],
    )
    assert expected in " ".join((ROOT / file).read_text("utf-8").split())


def test_the_page_was_written_from_these_results(tmp_path: Path) -> None:
    write_page(ROOT / "docs" / "results", tmp_path / "results.md")
    page = (ROOT / "docs" / "results.md").read_text("utf-8")
    assert (tmp_path / "results.md").read_text("utf-8") == page
