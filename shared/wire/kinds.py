"""All kinds of message: importing this module registers them in ``MESSAGES``."""

from kouxing.shared.wire import control, face, session, speech
from kouxing.shared.wire.message import MESSAGES

__all__ = ["MESSAGES", "control", "face", "session", "speech"]
