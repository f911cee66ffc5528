"""The documents in proto/, the schema and the code agree."""

import json
import re
from pathlib import Path
from typing import Any, get_args

import msgspec
import pytest
from kouxing_client import KouxingError
from kouxing_client.field_types import MAX_AUDIO_BYTES, NO_LINE_BREAK
from kouxing_client.messages import (
    VERSION,
    Lateness,
    Message,
    ServiceState,
    SessionFacts,
    SessionState,
)
from kouxing_client.options import check_name

from kouxing.services.control.placement import CLIENT_NEEDS
from kouxing.services.control.request_handler import Request
from kouxing.services.synthesizer.service import LOW_LEVEL_FAPS
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS
from kouxing.shared.name_rules import NAME_RULE, is_name
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.wire.control import AllowedKey, EventName, SessionProgress
from kouxing.shared.wire.face import FaceSettings
from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.message import MAX_MESSAGE_BYTES
from kouxing.shared.wire.schema import schema
from kouxing.shared.wire.session import AudioChunk, ErrorCode, SessionMoved, SessionOpened
from kouxing.shared.wire.speech import NewestFrame, Results
from tests.samples import SAMPLES

ROOT = Path(__file__).parents[2]
PROTOCOL, MESSAGES_DOCUMENT, VALUES = (
    (ROOT / "proto" / name).read_text(encoding="utf-8")
    for name in ("PROTOCOL.md", "MESSAGES.md", "VALUES.md")
)
COMMON = {*Message.__struct_fields__}
STRUCTURES: dict[str, type[Any]] = {
    **MESSAGES,
    "service-state": ServiceState,
    "session-state": SessionState,
    "session-progress": SessionProgress,
    "allowed-key": AllowedKey,
    "face-settings": FaceSettings,
    "newest-frame": NewestFrame,
    "session-facts": SessionFacts,
    "lateness": Lateness,
}
WIRE_NAME = {cls: name for name, cls in STRUCTURES.items()}


def section(heading: str, document: str = PROTOCOL) -> str:
    """Return a document's text between a heading and the next one."""
    match = re.search(
        rf"^#+ {re.escape(heading)}\n(.*?)(?=^#+ |\Z)", document, re.DOTALL | re.MULTILINE
    )
    assert match, f"the document has no heading {heading!r}"
    return match[1]


def table(text: str, number: int = 0) -> list[list[str]]:
    """Return the rows of a table in a text, without its header; an empty list without a table."""
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    rows = tables[number].splitlines() if tables else []
    return [[cell.strip() for cell in row.strip("|").split(" |")] for row in rows[2:]]


def type_text(kind: msgspec.inspect.Type) -> str:
    match kind:
        case msgspec.inspect.DictType():
            return f"map of str to {type_text(kind.value_type)}"
        case msgspec.inspect.ListType():
            return f"list of {type_text(kind.item_type)}"
        case msgspec.inspect.StructType():
            return f"`{WIRE_NAME[kind.cls]}`"
        case msgspec.inspect.UnionType():
            return f"{type_text(some_type(kind))} or null"
    return type(kind).__name__.removesuffix("Type").lower()


def some_type(kind: msgspec.inspect.UnionType) -> msgspec.inspect.Type:
    """Return the type of an optional field's value, if it has one."""
    (value_type,) = (
        member for member in kind.types if not isinstance(member, msgspec.inspect.NoneType)
    )
    return value_type


def number_text(value: float) -> str:
    return "2^53" if value == 2**53 else f"{value:.10g}"


def span_text(low: float | None, high: float | None, unit: str = "") -> str:
    if unit:  # a number of characters, bytes or entries
        if high is None or low == high:
            return f"{high} {unit}" if high else ""
        return f"{low} to {high} {unit}" if low else f"up to {high} {unit}"
    if low is not None and high is not None:
        return f"{number_text(low)} to {number_text(high)}"
    return "" if low is None else f"at least {number_text(low)}"


def pattern_text(pattern: str) -> str:
    pattern = pattern.removesuffix(NO_LINE_BREAK)
    choices = re.fullmatch(r"\^\((.*)\)\$", pattern)
    if choices:
        return " or ".join(f"`{choice}`" for choice in choices[1].split("|"))
    return f"`{pattern.strip('^$')}`"


def range_text(kind: msgspec.inspect.Type) -> str:
    text = ""
    match kind:
        case msgspec.inspect.StrType(pattern=str() as pattern):
            text = pattern_text(pattern)
        case msgspec.inspect.StrType():
            text = span_text(kind.min_length, kind.max_length, "characters")
        case msgspec.inspect.BytesType():
            text = span_text(kind.min_length, kind.max_length, "bytes")
        case msgspec.inspect.DictType() | msgspec.inspect.ListType():
            text = span_text(kind.min_length, kind.max_length, "entries")
        case msgspec.inspect.IntType() | msgspec.inspect.FloatType():
            text = (
                f"above 0, up to {number_text(kind.le)}"
                if kind.gt == 0 and kind.le
                else span_text(kind.ge, kind.le)
            )
        case msgspec.inspect.UnionType():
            text = range_text(some_type(kind))
    return text


def default_text(field: msgspec.inspect.Field) -> str:
    if field.required:
        return "required"
    if field.default_factory is not msgspec.NODEFAULT or field.default == b"":
        return "empty"
    if isinstance(field.default, float):
        return f"{field.default:g}"
    is_text = field.default and isinstance(field.default, str)
    return field.default if is_text else json.dumps(field.default)


def expected_rows(cls: type[Any]) -> list[list[str]]:
    """Return field, type, range and default as the document must have them."""
    info = msgspec.inspect.type_info(cls)
    assert isinstance(info, msgspec.inspect.StructType)
    return [
        [
            f"`{field.encode_name}`",
            type_text(field.type),
            range_text(field.type),
            default_text(field),
        ]
        for field in info.fields
        if cls is Message or field.name not in COMMON or not issubclass(cls, Message)
    ]


def test_the_document_has_version_limits_errors_and_events() -> None:
    assert PROTOCOL.startswith(f"# The kouxing protocol, version {VERSION}\n")
    assert f"at most {MAX_MESSAGE_BYTES // 2**20} MiB" in section("A message")
    assert f"{MAX_AUDIO_BYTES // 1024} KiB of audio" in section("A message")
    assert [row[:4] for row in table(section("A message"))] == expected_rows(Message)
    assert {row[0].strip("`") for row in table(section("Errors"))} == {*ErrorCode}
    assert {row[0].strip("`") for row in table(section("Events"))} == {*EventName}


def test_the_schema_the_samples_and_the_document_have_the_same_messages() -> None:
    stored = json.loads((ROOT / "proto" / "schema.json").read_text(encoding="utf-8"))
    assert stored == json.loads(json.dumps(schema()))
    assert SAMPLES.keys() == MESSAGES.keys()
    described = re.findall(r"^### `([a-z-]+)`$", MESSAGES_DOCUMENT, re.MULTILINE)
    assert sorted(described) == sorted(STRUCTURES)
    for cls in (SessionOpened, SessionMoved):
        assert set(CLIENT_NEEDS) <= {*cls.__struct_fields__}


@pytest.mark.parametrize("name", STRUCTURES)
def test_the_document_has_every_field_with_type_range_and_default(name: str) -> None:
    rows = table(section(f"`{name}`", MESSAGES_DOCUMENT))
    assert [row[:4] for row in rows] == expected_rows(STRUCTURES[name])
    assert all(row[4] for row in rows), "every field has its meaning"


def test_the_document_has_every_answer() -> None:
    rows = [
        [set(re.findall(r"`([a-z-]+)`", cell)) for cell in row] for row in table(section("Answers"))
    ]
    asked, answers, errors = (set().union(*column) for column in zip(*rows, strict=True))
    from_clients = {cls.kind for cls in (*get_args(Request), AudioChunk)}
    assert asked - {"joined", "request"} == from_clients | {
        "heartbeat",
        "start-session",
        Results.kind,
    }
    assert answers < set(MESSAGES)
    assert errors - {"request"} < {*ErrorCode}


def test_the_document_has_every_fap_and_shape() -> None:
    points = {fap.number: ", ".join(fap.feature_points) for fap in FAPS}
    assert table(section("FAPs", VALUES), -1) == [
        [
            str(fap.number),
            f"`{fap.name}`",
            fap.fapu,
            fap.direction.replace("_", " "),
            points[fap.number],
        ]
        for fap in FAPS
    ]
    units = {row[0] for row in table(section("FAPs", VALUES))}
    assert units == {fap.fapu for fap in FAPS if fap.fapu}
    assert table(section("Sets of shapes", VALUES)) == [
        [f"`{name}`", " ".join(shapes.names)] for name, shapes in SHAPE_SETS.items()
    ]
    assert list(LOW_LEVEL_FAPS) == list(range(2, 68)), "FAP 1 and 2 are never set"


def test_the_document_has_every_phone_with_a_correct_example() -> None:
    inventory = load_inventory()
    rows = table(section("Phones", VALUES))
    assert [[row[0], row[1], row[4]] for row in rows] == [
        [f"`{phone}`", kind, ", ".join(viseme for viseme, _ in inventory.visemes[phone])]
        for phone, kind in zip(inventory.phones, inventory.kinds, strict=True)
    ]
    for symbol, kind, _, example, _ in rows:
        if kind != "silence":
            character, pinyin = example.split()
            ((syllable),) = inventory.pronounce(character)
            assert inventory.pronounce(pinyin) == [syllable]
            assert symbol.strip("`") in syllable


def test_the_document_has_the_messages_of_each_publisher() -> None:
    published = {
        row[2].strip("`"): set(re.findall(r"`([a-z-]+)`", row[4]))
        for row in table(section("Sockets"))
        if row[1] == "XPUB"
    }
    for endpoint in ("phones", "faps"):
        kinds = {kind for kind, cls in MESSAGES.items() if cls.published_at == endpoint}
        assert published[endpoint] == kinds


def test_documents_the_order_of_lip_values() -> None:
    ranges: list[list[int]] = []
    for fap in MOUTH_FAPS:
        if ranges and fap == ranges[-1][-1] + 1:
            ranges[-1].append(fap)
        else:
            ranges.append([fap])
    texts = [f"{r[0]} to {r[-1]}" if len(r) > 2 else ", ".join(map(str, r)) for r in ranges]
    assert ", ".join(texts) in section("`lip-positions`", MESSAGES_DOCUMENT)


@pytest.mark.parametrize("name", ["", "a", "a" * 64, "a" * 65, "a b", "a\n", "é"])
def test_the_client_accepts_the_session_names_of_the_wire(name: str) -> None:
    if name == "" or is_name(name):
        check_name(name)
    else:
        with pytest.raises(KouxingError, match=re.escape(NAME_RULE)):
            check_name(name)
