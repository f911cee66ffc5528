"""The JSON schema of every message, made from the message classes.

``python -m shared.schema > proto/schema.json`` writes it anew.
"""

from __future__ import annotations

import json
import sys

import msgspec

from shared.messages import MESSAGES, VERSION


def schema() -> dict[str, object]:
    """Return the schema: one definition a message, by the kind that its topic begins with."""
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
