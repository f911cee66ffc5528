"""Identifies the sender of a message."""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Peer:
    """The sender of a message to a ROUTER socket."""

    address: bytes = b""  # ROUTING_ID
    key: str = ""  # authenticated public key, empty without encryption
    connection: int = field(default=0, compare=False)  # 0: the connection has ended


NO_PEER = Peer()
