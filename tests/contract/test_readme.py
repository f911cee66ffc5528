"""The two READMEs say the same: commands, code, links, pictures and figures."""

from __future__ import annotations

import re
from collections import Counter
from itertools import zip_longest
from pathlib import Path

import pytest
from typer.main import get_command

from kouxing.services.cli.main import app

ROOT = Path(__file__).parents[2]
ENGLISH, CHINESE = (
    re.split(r"^## .*\n", (ROOT / name).read_text("utf-8"), flags=re.MULTILINE)
    for name in ("README.md", "README.zh.md")
)
SECTIONS = list(zip_longest(ENGLISH, CHINESE, fillvalue=""))

pytestmark = pytest.mark.contract


@pytest.mark.parametrize(
    "pattern",
    [
        pytest.param(r"`[^`\n]+`", id="commands and names"),
        pytest.param(r"^(?:    .*?|```[^`]*```)$", id="code"),
        pytest.param(r"(?:\]\(|<)((?!README)[^)>\s]+)[)>]", id="links and pictures"),
        pytest.param(r"\d+(?:\.\d+)?", id="figures"),
    ],
)
@pytest.mark.parametrize("section", range(len(SECTIONS)))
def test_both_languages_have_the_same(pattern: str, section: int) -> None:
    found = [
        Counter(re.findall(pattern, re.sub(r" +# .*", "", text), re.MULTILINE))
        for text in SECTIONS[section]
    ]
    assert found[0] == found[1]


def test_tables_have_the_same_shape() -> None:
    shapes = [
        [
            line.replace("\\|", "").count("|")
            for line in "".join(text).splitlines()
            if line[:1] == "|"
        ]
        for text in (ENGLISH, CHINESE)
    ]
    assert shapes[0] == shapes[1]


PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/clients/*.md"), ROOT / "examples" / "README.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_leads_to_a_file_and_a_heading_there(page: Path) -> None:
    links = re.findall(r"\]\((?!http)([^)#]*)(?:#([^)]+))?\)", page.read_text("utf-8"))
    for link, heading in links:
        target = page.parent / link if link else page
        assert target.exists(), link
        if heading:
            titles = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
            assert heading in anchors, f"{link}#{heading}"


def test_every_client_has_a_picture_and_numbered_steps() -> None:
    for page in set((ROOT / "docs" / "clients").glob("*.md")):
        text = page.read_text("utf-8")
        if page.stem not in ("README", "troubleshooting"):
            assert "![" in text, page.name
            assert re.search(r"^4\. ", text, re.MULTILINE), page.name
            assert "\nTimed" in text, page.name
            assert f"({page.name})" in (page.parent / "README.md").read_text("utf-8")


def test_they_lead_to_each_other() -> None:
    assert "(README.zh.md)" in ENGLISH[0]
    assert "(README.md)" in CHINESE[0]


def test_every_command_that_documents_name_exists() -> None:
    text = "\n".join(path.read_text("utf-8") for path in [*PAGES, *ROOT.glob("*/*.md")])
    named = set(re.findall(r"(?:`|^    [^#\n]*?)kouxing ([a-z-]+)", text, re.MULTILINE))
    assert len(named) > 10
    assert named <= {*get_command(app).list_commands(None)}  # type: ignore[attr-defined]
