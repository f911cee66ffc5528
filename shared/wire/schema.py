"""The JSON schema of every message, made from the message classes.

``python -m kouxing.shared.wire.schema > proto/schema.json`` rewrites it.
"""

from __future__ import annotations

import json
import sys

import msgspec

from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.message import VERSION


def schema() -> dict[str, object]:
    """Return the schema: one definition per message, by its kind."""
    references, definitions = msgspec.json.schema_components(
        MESSAGES.values(), ref_template="#/$defs/{name}"
    )
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"kouxing protocol version {VERSION}",
        "description": "Bodies are msgpack maps; what is base64 here is binary there.",
        "properties": dict(zip(MESSAGES, references, strict=True)),
        "$defs": definitions,
    }


if __name__ == "__main__":
    json.dump(schema(), sys.stdout, indent=1, sort_keys=True)
    print()
