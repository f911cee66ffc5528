"""Immutable records, for data that is created hundreds of times a second.

Creating a record takes a twentieth of the time of a frozen dataclass, because no Python code runs.
"""

from msgspec import Struct
from msgspec.structs import replace as replace  # noqa: PLC0414 - the public name


class Record(Struct, frozen=True):
    """Base class of records. ``replace`` returns a changed copy of a record or a message."""
