"""The documents' links lead somewhere, and the commands and modules that they name exist."""

import re
from pathlib import Path

import pytest
from typer.main import get_command

from kouxing.services.cli.main import app

ROOT = Path(__file__).parents[2]
LINK = r"\]\((?!http)([^)#]*)(?:#([^)]+))?\)"  # path and heading of a relative link
DOCUMENTS = [
    path
    for pattern in ("*.md", "docs/**/*.md", "proto/*.md", "examples/*.md", "clients/*/*.md")
    for path in ROOT.glob(pattern)
    if "node_modules" not in path.parts
]


def test_the_documents_have_links() -> None:
    assert sum(len(re.findall(LINK, document.read_text("utf-8"))) for document in DOCUMENTS) > 100


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_relative_link_has_a_target(document: Path) -> None:
    links = re.findall(LINK, document.read_text("utf-8"))
    for link, heading in links:
        target = document.parent / link if link else document
        assert target.exists(), link
        if heading:
            titles = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
            anchors = [re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles]
            assert heading in anchors, f"{link}#{heading}"


def test_every_named_command_exists() -> None:
    text = "\n".join(path.read_text("utf-8") for path in DOCUMENTS)
    named = set(re.findall(r"(?:`|^    [^#\n]*?)kouxing ([a-z-]+)", text, re.MULTILINE))
    assert len(named) > 10
    assert named <= {*get_command(app).list_commands(None)}  # type: ignore[attr-defined]


def test_every_named_module_exists() -> None:
    text = "\n".join(path.read_text("utf-8") for path in DOCUMENTS)
    names = set(re.findall(r"`((?:services|shared|tests)/[\w/]+\.py)`", text))
    names |= {f"tests/{name}" for name in re.findall(r"`(\w+/test_\w+\.py)`", text)}
    names = {name for name in names if "NAME" not in name}
    assert len(names) > 30
    assert not {name for name in names if not (ROOT / name).is_file()}


def test_every_quoted_message_exists() -> None:
    """Messages are quoted in the first column of the tables; "..." replaces what varies."""
    text = (ROOT / "docs" / "clients" / "troubleshooting.md").read_text("utf-8")
    first_columns = "\n".join(re.findall(r"^\|([^|]*)\|", text, re.MULTILINE))
    messages = [quoted for quoted in re.findall(r"`([^`\n]+)`", first_columns) if " " in quoted]
    assert len(messages) > 5
    folders = ("services", "clients/python", "clients/javascript", "examples")
    sources = "\n".join(
        path.read_text("utf-8")
        for folder in folders
        for suffix in ("py", "js")
        for path in (ROOT / folder).rglob(f"*.{suffix}")
        if "node_modules" not in path.parts
    )
    parts = {part.strip() for message in messages for part in message.split("...")}
    assert not {part for part in parts if part not in sources}
