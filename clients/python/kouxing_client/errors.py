"""Errors, with messages for the person who runs the program."""


class KouxingError(Exception):
    """The system does not answer, a key is missing, or a session has ended."""


class Refused(KouxingError):
    """A service refused a request or audio; ``code`` is one of the error codes of PROTOCOL.md."""

    def __init__(self, code: str, text: str, retry_after_s: float = 0.0) -> None:
        super().__init__(f"{code}: {text}")
        self.code = code
        self.text = text
        self.retry_after_s = retry_after_s  # when to try again; 0 if the service did not say
