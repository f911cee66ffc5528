"""What goes wrong, in words for whoever runs the program."""

from __future__ import annotations


class KouxingError(Exception):
    """The system does not answer, a key is missing, or a session ended."""


class Refused(KouxingError):
    """A service refused a request, or audio; ``code`` is one of PROTOCOL.md's errors."""

    def __init__(self, code: str, text: str, retry_after_s: float = 0.0) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text
        self.retry_after_s = retry_after_s  # when it is worth trying again; 0: not stated
