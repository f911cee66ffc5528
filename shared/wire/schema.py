"""The JSON Schema of all messages.

``python -m kouxing.shared.wire.schema > proto/schema.json`` updates the file.
"""

import json

import msgspec
from kouxing_client.field_types import NO_LINE_BREAK
from kouxing_client.messages import VERSION

from kouxing.shared.wire.kinds import MESSAGES

_FIELD_DEPTH = 4  # $defs, message, properties, field


def schema() -> dict[str, object]:
    """Return the schema, with one definition per kind of message."""
    references, definitions = msgspec.json.schema_components(
        MESSAGES.values(), ref_template="#/$defs/{name}"
    )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"kouxing protocol version {VERSION}",
        "description": "Bodies are msgpack maps; base64 strings stand for binary fields.",
        "properties": dict(zip(MESSAGES, references, strict=True)),
        "$defs": _without_line_break_rule(definitions),
    }


def _without_line_break_rule(definitions: dict[str, object]) -> dict[str, object]:
    """Simplify the patterns, because "$" does not match before a line break in JSON Schema."""
    rule = json.dumps(NO_LINE_BREAK).strip('"')
    simplified: dict[str, object] = json.loads(json.dumps(definitions).replace(rule, ""))
    return simplified


def to_text(value: object, depth: int = 0) -> str:
    """Return the schema as JSON, with one line for each field of a message."""
    if not isinstance(value, dict) or depth == _FIELD_DEPTH or not _has_maps(value):
        return json.dumps(value, sort_keys=True)
    indent = "\n" + " " * depth
    members = (f"{json.dumps(key)}: {to_text(value[key], depth + 1)}" for key in sorted(value))
    return "{" + ",".join(f"{indent} {member}" for member in members) + indent + "}"


def _has_maps(value: dict[str, object]) -> bool:
    return any(isinstance(member, dict) for member in value.values())


if __name__ == "__main__":
    print(to_text(schema()))
