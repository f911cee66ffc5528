"""PROTOCOL.md, the schema and the code say the same."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from shared.messages import MESSAGES
from shared.schema import schema
from tests.samples import SAMPLES

pytestmark = pytest.mark.contract
ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "proto" / "PROTOCOL.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", MESSAGES)
def test_every_kind_is_in_the_document(kind: str) -> None:
    assert re.search(rf"(`|\b){re.escape(kind)}(`|\b)", DOCUMENT)


def test_every_error_code_in_the_code_is_in_the_document() -> None:
    sources = "\n".join(
        path.read_text(encoding="utf-8")
        for service in ("control", "recognizer", "synthesizer", "driver")
        for path in (ROOT / "services" / service).rglob("*.py")
    )
    pattern = r'(?:Refusal\(\s*|code=|sender, |_report\(session, )"([a-z]+(?:-[a-z]+)*)"'
    used = set(re.findall(pattern, sources))
    assert len(used) > 5
    assert used <= set(re.findall(r"^\| `([a-z-]+)` \|", DOCUMENT, re.MULTILINE))


def test_every_event_name_in_the_code_is_in_the_document() -> None:
    source = (ROOT / "services" / "control" / "service.py").read_text(encoding="utf-8")
    names = set(re.findall(r'"((?:session|speech|service)-[a-z]+|recorded)"', source))
    names.discard("session-exists")
    assert len(names) > 5
    assert all(f"`{name}`" in DOCUMENT for name in names)


def test_the_schema_is_that_of_the_classes() -> None:
    stored = json.loads((ROOT / "proto" / "schema.json").read_text(encoding="utf-8"))
    assert stored == json.loads(json.dumps(schema()))


def test_there_is_a_sample_of_every_kind() -> None:
    assert [sample.kind for sample in SAMPLES] == list(MESSAGES)


def test_no_topic_is_a_prefix_of_another() -> None:
    topics = [f"{kind}/{session}/" for kind in MESSAGES for session in ("a", "ab")]
    for one in topics:
        assert not any(other != one and other.startswith(one) for other in topics)
