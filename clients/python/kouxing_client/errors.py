"""Errors whose messages are written for the user."""


class KouxingError(Exception):
    """Raised if the system does not answer, a key is missing, or a session has ended."""


class NotConnected(KouxingError):
    """Raised if control does not answer, or does not accept this key."""


class Refused(KouxingError):
    """Raised if a service rejects a request or audio. ``code`` is an error code of PROTOCOL.md."""

    def __init__(self, code: str, text: str, retry_after_s: float = 0.0) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text
        self.retry_after_s = retry_after_s  # retry after this time; 0 if unknown
