"""All classes of messages by kind, and a base class of the messages between services.

``kouxing_client.messages`` has the messages that the Python client reads. A message is two ZeroMQ
parts: the topic ``<kind>/<session>/`` and a msgpack map of the fields of its class.
``proto/PROTOCOL.md`` is the authority. A new optional field or a new kind keeps the version; any
other change needs a new version.
"""

import re

from kouxing_client.messages import (
    EndOfFaps,
    Event,
    FapFrame,
    Joined,
    Message,
    Phone,
    Sound,
    Speech,
)

DOCUMENT = "proto/PROTOCOL.md"
MAX_COMMAND_BYTES = 256 * 1024  # a heartbeat that names 2000 sessions
MAX_MESSAGE_BYTES = 1024 * 1024

# Every class by its kind, once its module is imported
MESSAGES: dict[str, type[Message]] = {
    cls.kind: cls for cls in (EndOfFaps, Event, FapFrame, Joined, Phone, Sound, Speech)
}


class RegisteredMessage(Message, frozen=True, kw_only=True):
    """Base class that adds each subclass to ``MESSAGES``.

    The kind is the class name in kebab-case: ``OpenSession`` is an ``open-session``. The messages
    are exchanged between services, or the Python client reads and writes them as maps.
    """

    def __init_subclass__(cls) -> None:
        cls.kind = re.sub(r"(?<!^)(?=[A-Z])", "-", cls.__name__).lower()
        MESSAGES[cls.kind] = cls
