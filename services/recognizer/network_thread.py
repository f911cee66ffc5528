"""The thread of the block network, so that other sessions do not wait for its runs."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

from kouxing.services.recognizer.recognizer import Recognizer
from kouxing.services.recognizer.session import RecognizerSession
from kouxing.services.recognizer.stream import SpeechStream

MAX_SESSIONS = 4  # decoded together; the results of all of them are sent at the end


class NetworkThread:
    """Decodes sessions whose next audio is due for the block network.

    Sessions that become due in the meantime wait, and share the next runs. While a session is here
    (``is_scoring``), its stream must not be used elsewhere.

    Parameters
    ----------
    recognizer
        Decodes the streams.
    on_decoded
        Called on the thread when sessions are decoded.
    """

    def __init__(self, recognizer: Recognizer, on_decoded: Callable[[], None]) -> None:
        self.work_s = 0.0  # processor time of the batches so far
        self._recognizer = recognizer
        self._on_decoded = on_decoded
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="network")
        self._due: list[RecognizerSession] = []
        self._batch: list[RecognizerSession] = []
        self._job: Future[None] | None = None

    def add(self, sessions: Sequence[RecognizerSession]) -> None:
        """Decode the accepted audio of some sessions."""
        for session in sessions:
            session.is_scoring = True
        self._due += sessions
        self._start_batch()

    def take_decoded(self) -> list[RecognizerSession]:
        """Return the sessions that were decoded since the last call."""
        if self._job is None or not self._job.done():
            return []
        self._job.result()  # raises what the decoding has raised
        decoded, self._job = self._batch, None
        for session in decoded:
            session.is_scoring = False
        self._start_batch()
        return decoded

    def wait(self) -> None:
        """Wait until the current batch, if any, is decoded."""
        if self._job is not None:
            wait([self._job])

    def _start_batch(self) -> None:
        if self._job is None and self._due:
            self._batch, self._due = self._due[:MAX_SESSIONS], self._due[MAX_SESSIONS:]
            streams = [session.stream for session in self._batch]
            self._job = self._executor.submit(self._decode, streams)
            self._job.add_done_callback(lambda _: self._on_decoded())

    def _decode(self, streams: Sequence[SpeechStream]) -> None:
        start_s = time.thread_time()
        self._recognizer.decode_streams(streams)
        self.work_s += time.thread_time() - start_s
