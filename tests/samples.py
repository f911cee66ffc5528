"""One message of every kind, as ``proto/golden`` has them."""

import json
from pathlib import Path

import msgspec

from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.message import VERSION, Message

FILE = Path(__file__).parents[1] / "proto" / "golden" / f"version{VERSION}.json"
STORED = json.loads(FILE.read_text(encoding="utf-8"))
SAMPLES: dict[str, Message] = {
    kind: msgspec.convert(stored["message"], MESSAGES[kind]) for kind, stored in STORED.items()
}
