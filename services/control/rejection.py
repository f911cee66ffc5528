"""The exception for a request that control rejects."""

from kouxing.shared.wire.session import ErrorCode


class RequestRejected(Exception):
    """Control rejects a request; the sender receives an ``error`` with these fields."""

    def __init__(self, code: ErrorCode, text: str, retry_after_s: float | None = None) -> None:
        super().__init__(text)
        self.code = code
        self.text = text
        self.retry_after_s = retry_after_s
