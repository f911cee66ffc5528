"""Learn a mouth profile in a process with low priority, so that live streams do not suffer."""

import os
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection

from kouxing.shared.errors import UserError

Learn = Callable[[bytes], tuple[bytes, dict[str, object]]]

_NICENESS = 19
_THREAD_LIMITS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")


def learn_from_landmarks(recording: bytes) -> tuple[bytes, dict[str, object]]:
    """Learn from the content of a landmark file; return the mouth profile and its figures.

    Raises UserError if the content is invalid or has too little speech with lips in view.
    """
    # Imported here, so that the gateway itself does not load the models.
    from kouxing.services.mouth_profiles.landmark_file import parse_landmark_file  # noqa: PLC0415
    from kouxing.services.mouth_profiles.learning import learn_mouth_profile  # noqa: PLC0415

    learned = learn_mouth_profile([parse_landmark_file(recording)])
    return learned.content, learned.figures()


def run(learn: Learn, connection: Connection) -> None:
    """Process main: receive a recording, and send ``(status, result)`` back.

    The status is ``learned``, ``refused`` (with the reason) or ``failed`` (with the traceback).
    """
    os.setsid()  # Ctrl-C in the terminal reaches only the gateway, which stops this process
    os.nice(_NICENESS)
    try:
        connection.send(("learned", learn(connection.recv_bytes())))
    except UserError as error:
        connection.send(("refused", str(error)))
    except Exception:
        connection.send(("failed", traceback.format_exc()))


@contextmanager
def single_threaded_children() -> Iterator[None]:
    """Limit numerical libraries to one thread in processes started within this context."""
    before = {name: os.environ.get(name) for name in _THREAD_LIMITS}
    os.environ.update(dict.fromkeys(_THREAD_LIMITS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
