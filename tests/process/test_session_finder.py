"""The search of ``kouxing send`` for the session to follow."""

import threading
from typing import Any, cast

from kouxing_client import KouxingError

from kouxing.services.cli.system.send import _SessionFinder
from tests.system import LIMIT_S


class SilentClient:
    """A client whose control does not answer."""

    def __init__(self) -> None:
        self.was_asked = threading.Event()
        self.was_closed = threading.Event()

    def status(self) -> None:
        self.was_asked.set()
        self.was_closed.wait(LIMIT_S)
        raise KouxingError("control does not answer")

    def close(self) -> None:
        self.was_closed.set()


def test_the_search_ends_although_control_does_not_answer() -> None:
    client = SilentClient()
    with _SessionFinder("", cast(Any, client), cast(Any, None)):
        assert client.was_asked.wait(LIMIT_S)
    assert client.was_closed.is_set()
