"""Runs the block network in its own thread, so that other sessions do not wait for its runs."""

import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait

from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.services.recognizer.live.stream import SpeechStream
from kouxing.services.recognizer.sessions.session import RecognizerSession

MAX_SESSIONS = 4  # decoded together; all results are sent at the end
MAX_WAIT_S = 0.02  # limit for waiting for more sessions, to save processor time


class NetworkThread:
    """Decodes sessions with enough audio for the next run of the block network.

    While a session is on the thread (``is_scoring``), other threads may only use its stream as
    ``SpeechStream.begin_background_scoring`` describes, so that lips do not wait for the network.
    The thread calls ``on_decoded`` when sessions are decoded.
    """

    def __init__(self, recognizer: Recognizer, on_decoded: Callable[[], None]) -> None:
        self.work_s = 0.0  # processor time of the batches so far
        self.batch_s = 0.0  # duration of the newest batch
        self._recognizer = recognizer
        self._on_decoded = on_decoded
        self._executor = ThreadPoolExecutor(max_workers=1, thread_name_prefix="network")
        self._due: list[RecognizerSession] = []
        self._due_since_s = 0.0  # when the first of them was queued
        self._batch: list[RecognizerSession] = []
        self._job: Future[None] | None = None

    def add(self, session: RecognizerSession, now_s: float) -> None:
        """Queue a session for the network, unless it is already queued."""
        if not session.waits_for_network:
            session.waits_for_network = True
            self._due_since_s = self._due_since_s if self._due else now_s
            self._due.append(session)

    def start(self, now_s: float, *, may_wait: bool = False) -> None:
        """Decode the accepted audio of waiting sessions, unless the thread is busy.

        With ``may_wait``, wait a little for more sessions, because a shared run takes less time.
        """
        if self._job is not None or not self._due:
            return
        is_early = now_s < self._due_since_s + MAX_WAIT_S
        if may_wait and is_early and len(self._due) < MAX_SESSIONS:
            return
        self._batch, self._due = self._due[:MAX_SESSIONS], self._due[MAX_SESSIONS:]
        for session in self._batch:
            session.waits_for_network, session.is_scoring = False, True
            session.stream.begin_background_scoring()
        streams = [session.stream for session in self._batch]
        self._job = self._executor.submit(self._decode, streams)
        self._job.add_done_callback(lambda _: self._on_decoded())

    def take_decoded(self) -> list[RecognizerSession]:
        """Return the sessions that were decoded since the last call."""
        if self._job is None or not self._job.done():
            return []
        self._job.result()  # raises the errors of the decoding
        self._job = None
        for session in self._batch:
            session.is_scoring = False
            session.stream.end_background_scoring()
        return self._batch

    def wait(self) -> None:
        """Wait until the current batch, if any, is decoded."""
        if self._job is not None:
            wait([self._job])

    def _decode(self, streams: Sequence[SpeechStream]) -> None:
        start_s = time.thread_time()
        self._recognizer.decode_speech(streams)
        self.batch_s = time.thread_time() - start_s
        self.work_s += self.batch_s
