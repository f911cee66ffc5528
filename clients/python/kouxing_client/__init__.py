"""The kouxing client: send speech to a running system; receive phones, FAP frames and blendshapes.

``Client`` blocks. ``AsyncClient`` has the same methods for asyncio. A background thread resends
lost messages and follows sessions that move to another worker.
"""

from kouxing_client.aio import AsyncClient, AsyncResults, AsyncSession
from kouxing_client.client import Client, Results, Session
from kouxing_client.errors import KouxingError, NotConnected, Refused
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
    "NotConnected",
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
