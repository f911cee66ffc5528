"""The open videos of recorded sessions, drawn in small steps."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from kouxing.services.driver.video.recording import Recording
from kouxing.shared.errors import UserError

Float32 = NDArray[np.float32]


class Recordings:
    """Passes each session's frames and sound to its video, and draws images when time permits.

    ``make`` opens the video of a session. ``on_failed`` receives the session and the reason why it
    has no video.
    """

    def __init__(
        self,
        make: Callable[[str], Recording],
        *,
        on_written: Callable[[str, Recording], None],
        on_failed: Callable[[str, str], None],
        on_image: Callable[[], None] = lambda: None,
    ) -> None:
        self._make = make
        self._on_written = on_written
        self._on_failed = on_failed
        self._on_image = on_image
        self._open: dict[str, Recording] = {}
        self._ending: list[tuple[str, Recording]] = []  # complete, but not all images are drawn

    @property
    def is_done(self) -> bool:
        """Whether no video is open."""
        return not self._open and not self._ending

    def is_open(self, session: str) -> bool:
        """Return whether a session's video still accepts frames."""
        return session in self._open

    def begin(self, session: str) -> None:
        """Open a session's video, unless it is already open."""
        if session in self._open:
            return
        try:
            self._open[session] = self._make(session)
        except (UserError, OSError) as error:
            self._on_failed(session, str(error))

    def add_frame(self, session: str, time_s: float, faps: Float32) -> None:
        """Add a FAP frame (68,), if the session is recorded."""
        if session in self._open:
            self._open[session].add_frame(time_s, faps)

    def add_sound(self, session: str, media_time: int, samples: Float32) -> None:
        """Add sound (n,), 16 kHz, if the session is recorded."""
        if session in self._open:
            try:
                self._open[session].add_sound(media_time, samples)
            except UserError as error:
                self._fail(session, self._open.pop(session), error)

    def end(self, session: str) -> None:
        """Finish a session's video with the frames that have arrived."""
        if session in self._open:
            self._ending.append((session, self._open.pop(session)))

    def draw_until(self, end_s: float) -> None:
        """Draw due images of all videos in turn, until a time of the monotonic clock."""
        due = list(self._open)
        while due and time.monotonic() < end_s:
            due = [session for session in due if self._draw_image(session)]
        while self._ending and time.monotonic() < end_s:
            self._finish_first()

    def close_early(self) -> list[str]:
        """Save the finished part of every video; return their sessions."""
        for session in list(self._open):
            self.end(session)
        cut_short = [session for session, _ in self._ending]
        for session, recording in self._ending:
            self._close(session, recording)
        self._ending.clear()
        return cut_short

    def _draw_image(self, session: str) -> bool:
        try:
            has_drawn = self._open[session].step()
        except UserError as error:
            self._fail(session, self._open.pop(session), error)
            return False
        if has_drawn:
            self._on_image()
        return has_drawn

    def _finish_first(self) -> None:
        session, recording = self._ending[0]
        try:
            if recording.step():
                self._on_image()
                return
        except UserError as error:
            self._fail(session, recording, error)
        else:
            self._close(session, recording)
        self._ending.pop(0)

    def _close(self, session: str, recording: Recording) -> None:
        try:
            recording.close()
        except UserError as error:
            self._fail(session, recording, error)
        else:
            self._on_written(session, recording)

    def _fail(self, session: str, recording: Recording, error: UserError) -> None:
        recording.discard()
        self._on_failed(session, str(error))
