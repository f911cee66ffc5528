"""Sends the frames and audio of recorded sessions to the process that writes their videos."""

import contextlib
import math
import multiprocessing
import threading
from collections.abc import Callable
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from kouxing.services.driver.config import DriverConfig
from kouxing.shared.files.output_file import remove_unfinished
from kouxing.shared.settings.keys import MAX_KEY_SHARE
from kouxing.shared.wire.control import StartSession
from kouxing.shared.wire.session import ErrorCode

MAX_QUEUED = 100_000  # unread commands
IDLE_S = 10.0  # after this time without a video, the process ends and frees its memory
REPORT_S = 0.02  # interval of reading the reports of the process
HANG_S = 600.0  # limit without a report; completing a long video may take minutes
MAX_TICK_S = 0.1  # anything longer is the driver's own delay
CLOSE_TIMEOUT_S = 3.0
KILL_TIMEOUT_S = 1.0
HANG_REASON = "the process that draws videos does not respond; record again"
EXIT_REASON = (
    "the process that draws videos ended unexpectedly; see the driver's log, and record again"
)

_SPAWN = multiprocessing.get_context("spawn")


def _run_recorder(connection: Connection, config: DriverConfig) -> None:
    """Run the recorder in its process; only this process needs the slow imports."""
    from kouxing.services.driver import recorder

    recorder.run(connection, config)


class _RecorderProcess:
    """The recorder's process. A thread sends its commands, so the driver never blocks."""

    def __init__(self, config: DriverConfig) -> None:
        self.connection, child_end = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_run_recorder, args=(child_end, config), daemon=True)
        self.process.start()
        child_end.close()
        self.commands: SimpleQueue[tuple[object, ...] | None] = SimpleQueue()
        threading.Thread(target=self._send, daemon=True).start()

    def _send(self) -> None:
        with contextlib.suppress(OSError):  # the process has ended
            while command := self.commands.get():
                self.connection.send(command)
            self.connection.send(None)

    def kill(self) -> None:
        self.process.kill()
        self.process.join(KILL_TIMEOUT_S)
        self.commands.put(None)  # ends the thread


class RecorderClient:
    """Passes each session's frames and audio to its video.

    ``on_written`` receives the start of the session and its video's path. ``on_error`` receives
    ``SHORT_VIDEO`` or ``NO_VIDEO``, the start, and the reason why the video ends early, before it
    is written, or is not complete.
    """

    def __init__(
        self,
        config: DriverConfig,
        *,
        on_written: Callable[[StartSession, Path], None],
        on_error: Callable[[ErrorCode, StartSession, str], None],
        on_image: Callable[[], None],
    ) -> None:
        self._config = config
        self._on_written = on_written
        self._on_error = on_error
        self._on_image = on_image
        self._video_numbers = count()
        self._open: dict[str, int] = {}  # numbers of the videos that accept frames, by session
        self._unfinished: dict[int, StartSession] = {}  # sessions by number
        self._recorder: _RecorderProcess | None = None
        self._last_busy_s = 0.0  # when a video was last unfinished
        self._last_tick_s = 0.0
        self._unreported_s = 0.0  # time since the last report

    @property
    def unfinished(self) -> list[str]:
        """The sessions whose videos are not written yet."""
        return [start.session for start in self._unfinished.values()]

    def is_open(self, session: str) -> bool:
        """Return whether a session's video still accepts frames."""
        return session in self._open

    def rejection_reason(self, key: str) -> str:
        """Return why a key cannot record another session now; empty if it can."""
        limit = self._config.max_videos
        key_limit = math.ceil(MAX_KEY_SHARE * limit)
        num_of_key = sum(start.client_key == key for start in self._unfinished.values())
        if len(self._unfinished) >= limit:
            reason = f"the driver is writing {limit} videos, the maximum (driver.max_videos)"
        elif key and num_of_key >= key_limit:
            reason = f"your key has {key_limit} unfinished videos, the maximum"
        else:
            return ""
        return f"{reason}; wait until one is written, or open the session without 'record'"

    def begin(self, start: StartSession) -> None:
        """Open a session's video."""
        session = start.session
        path = Path(self._config.out) / f"{session}.mp4"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            self._on_error(
                ErrorCode.NO_VIDEO, start, f"cannot create {path.parent}: {error.strerror}"
            )
            return
        number = self._open[session] = next(self._video_numbers)
        self._unfinished[number] = start
        if self._recorder is None:
            self._recorder, self._unreported_s = _RecorderProcess(self._config), 0.0
        self._send(session, "begin", start.client_key or "", path)

    def add_frame(self, session: str, time_s: float, values: bytes) -> None:
        """Add a FAP frame (68 values), if the session is recorded."""
        self._send(session, "add_frame", time_s, values)

    def add_audio(self, session: str, media_time: int, pcm: bytes) -> None:
        """Add 16-bit audio, 16 kHz, if the session is recorded."""
        self._send(session, "add_audio", media_time, pcm)

    def end(self, session: str) -> None:
        """Finish a session's video with the frames that have arrived."""
        self._send(session, "end")
        self._open.pop(session, None)

    def tick(self, now_s: float) -> float:
        """Handle the reports of the process, and end it after ``IDLE_S`` without a video.

        Return when to call this again.
        """
        if self._recorder is None:
            return math.inf
        self._unreported_s += min(now_s - self._last_tick_s, MAX_TICK_S)
        self._last_tick_s = now_s
        self._receive(timeout_s=0.0)
        if self._unreported_s > HANG_S:
            self._fail_all(HANG_REASON)
        elif self._unfinished:
            self._last_busy_s = now_s
        elif now_s >= self._last_busy_s + IDLE_S:
            self._kill()
            return math.inf
        return now_s + REPORT_S if self._unfinished else self._last_busy_s + IDLE_S

    def close(self) -> None:
        """Save the finished part of every video."""
        if self._recorder is not None:
            self._recorder.commands.put(None)
            while self._unfinished and self._receive(CLOSE_TIMEOUT_S):
                pass  # on a timeout, the process still ends by itself

    def _send(self, session: str, command: str, *arguments: object) -> None:
        number = self._open.get(session)
        if number is None or self._recorder is None:
            return
        self._recorder.commands.put((command, number, *arguments))
        if self._recorder.commands.qsize() > MAX_QUEUED:
            self._fail_all(HANG_REASON)

    def _receive(self, timeout_s: float) -> bool:
        """Handle reports, waiting up to the timeout for the first; return whether one arrived."""
        has_received = False
        try:
            while self._recorder is not None and self._recorder.connection.poll(timeout_s):
                self._on_report(*self._recorder.connection.recv())
                has_received, timeout_s = True, 0.0
        except (EOFError, OSError):
            self._fail_all(EXIT_REASON)
        return has_received

    def _on_report(self, kind: str, number: int = -1, detail: Any = None) -> None:
        self._unreported_s = 0.0
        if kind == "alive":
            return
        start = self._unfinished[number]
        if kind == "image":
            self._on_image()
            return
        if kind != "short":
            del self._unfinished[number]
        if self._open.get(start.session) == number:
            del self._open[start.session]
        if kind == "written":
            self._on_written(start, detail)
        else:
            is_short = kind == "short"
            self._on_error(ErrorCode.SHORT_VIDEO if is_short else ErrorCode.NO_VIDEO, start, detail)

    def _fail_all(self, reason: str) -> None:
        self._kill()
        starts = list(self._unfinished.values())
        self._open.clear()
        self._unfinished.clear()
        for start in starts:
            self._on_error(ErrorCode.NO_VIDEO, start, reason)

    def _kill(self) -> None:
        if self._recorder is not None:
            self._recorder.kill()
            self._recorder = None
            remove_unfinished(Path(self._config.out))
