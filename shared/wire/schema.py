"""The JSON Schema of all messages.

``python -m kouxing.shared.wire.schema > proto/schema.json`` updates the file.
"""

import json
import sys

import msgspec

from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.message import VERSION


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
        "$defs": definitions,
    }


if __name__ == "__main__":
    json.dump(schema(), sys.stdout, indent=1, sort_keys=True)
    print()
