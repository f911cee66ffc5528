"""One message of every kind, as ``proto/golden`` has them, and builders of frequent messages."""

import json
from pathlib import Path
from typing import Any

import msgspec
from kouxing_client.field_types import MASK_BYTES
from kouxing_client.messages import VERSION, FapFrame, Message, SessionFacts

from kouxing.shared.fast_record import replace
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.kinds import MESSAGES
from kouxing.shared.wire.session import OpenSession

FILE = Path(__file__).parents[1] / "proto" / "golden" / f"version{VERSION}.json"
STORED = json.loads(FILE.read_text(encoding="utf-8"))
SAMPLES: dict[str, Message] = {
    kind: msgspec.convert(stored["message"], MESSAGES[kind]) for kind, stored in STORED.items()
}

START = StartSession(
    session="s", epoch=1, request="r", token="t", opening=OpenSession(request="r"),
    facts=SessionFacts(language="mandarin"), endpoints={},
)  # fmt: skip


def with_opening(start: StartSession, **fields: Any) -> StartSession:
    """Return a start message whose client requested something else."""
    return replace(start, opening=replace(start.opening, **fields))


def fap_frame(session: str, number: int, values: bytes, epoch: int = 1) -> FapFrame:
    """Return the ``number``-th frame of a session at 50 Hz, from 0."""
    return FapFrame(
        session=session, epoch=epoch, sequence=number + 1, media_time=number * 320,
        packed_values=values, mask=bytes(MASK_BYTES),
    )  # fmt: skip
