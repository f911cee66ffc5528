"""A client of kouxing: speech to a running system; phones, FAP frames and blend shapes back.

``Client`` is for plain programs, ``AsyncClient`` for asyncio; both do the same. A thread of their
own sends what has to be sent again, and follows sessions that move.
"""

from kouxing_client.aio import AsyncClient, AsyncResults, AsyncSession
from kouxing_client.client import Client, Results, Session
from kouxing_client.errors import KouxingError, Refused
from kouxing_client.keys import Key, find_key, read_key
from kouxing_client.messages import SHAPE_NAMES, FapFrame, Phone, Result, Shapes, Sound, Speech

__all__ = [
    "SHAPE_NAMES",
    "AsyncClient",
    "AsyncResults",
    "AsyncSession",
    "Client",
    "FapFrame",
    "Key",
    "KouxingError",
    "Phone",
    "Refused",
    "Result",
    "Results",
    "Session",
    "Shapes",
    "Sound",
    "Speech",
    "find_key",
    "read_key",
]
