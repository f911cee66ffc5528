"""A client of kouxing: send speech to a running system, receive phones, faces and blend shapes.

``Client`` is for programs without an event loop, ``AsyncClient`` for asyncio. Both do the same. A
thread in the background sends lost messages again, and follows sessions that move.
"""

from kouxing_client.aio import AsyncClient, AsyncResults, AsyncSession
from kouxing_client.client import Client, Results, Session
from kouxing_client.errors import KouxingError, Refused
from kouxing_client.keys import Key, find_key, read_key
from kouxing_client.messages import (
    SHAPE_NAMES,
    Event,
    FapFrame,
    Lateness,
    Phone,
    Result,
    ServiceState,
    SessionState,
    Shapes,
    Sound,
    Speech,
    Status,
)

__all__ = [
    "SHAPE_NAMES",
    "AsyncClient",
    "AsyncResults",
    "AsyncSession",
    "Client",
    "Event",
    "FapFrame",
    "Key",
    "KouxingError",
    "Lateness",
    "Phone",
    "Refused",
    "Result",
    "Results",
    "ServiceState",
    "Session",
    "SessionState",
    "Shapes",
    "Sound",
    "Speech",
    "Status",
    "find_key",
    "read_key",
]
