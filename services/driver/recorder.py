"""Draws and writes the driver's videos, in a separate process.

OpenGL and the encoder hold the GIL for up to a second, which would delay the driver's
heartbeats. They also keep memory until their process ends.
"""

import contextlib
import os
import signal
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from kouxing.services.driver.config import DriverConfig
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.scene import open_renderer
from kouxing.services.driver.video.video_renderer import VideoRenderer
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG, configure

MAX_QUEUED_FRAMES = 180_000  # per video: an hour at 50 frames per second, 75 MB
MAX_COMMANDS = 500  # commands handled before the next image
ALIVE_S = 1.0  # interval between reports that the process runs


class Recorder:
    """Draws the images of all videos in turn, with the same number of images for each key.

    ``open_video`` opens a video. ``report`` is called with ``("image", number)``, ``("written",
    number, path)``, ``("failed", number, reason)`` or, if a video must end before its session,
    ``("short", number, reason)``.
    """

    def __init__(
        self, open_video: Callable[[Path], VideoRenderer], report: Callable[..., None]
    ) -> None:
        self._open_video = open_video
        self._report = report
        self._videos: dict[int, VideoRenderer] = {}  # least recently drawn first
        self._keys: dict[int, str] = {}
        self._newest_turn: Counter[str] = Counter()  # by key
        self._num_turns = 0
        self._ended: set[int] = set()

    def begin(self, number: int, key: str, path: Path) -> None:
        """Open a video for a client's key."""
        self._keys[number] = key
        with self._reports_failure(number):
            self._videos[number] = self._open_video(path)

    def add_frame(self, number: int, time_s: float, values: bytes) -> None:
        """Add a FAP frame (68,), unless the video has ended."""
        if not self._is_open(number):
            return
        video = self._videos[number]
        video.add_frame(time_s, np.frombuffer(values, "<f4"))
        if video.num_queued >= MAX_QUEUED_FRAMES:
            self.end(number)
            reason = (
                f"the video ends after {time_s / 60:.0f} minutes: {MAX_QUEUED_FRAMES} frames are"
                " queued, the maximum; send audio in real time, or use 'kouxing render'"
            )
            self._report("short", number, reason)

    def add_audio(self, number: int, media_time: int, pcm: bytes) -> None:
        """Add 16-bit audio, 16 kHz, unless the video has ended."""
        if self._is_open(number):
            samples = as_floats(np.frombuffer(pcm, "<i2"))
            with self._reports_failure(number):
                self._videos[number].add_audio(media_time, samples)

    def end(self, number: int) -> None:
        """Finish a video once the frames that have arrived are drawn."""
        if number in self._videos:
            self._ended.add(number)

    def draw_image(self) -> bool:
        """Draw the next due image, or complete a video; return whether anything was due."""
        for number in sorted(self._videos, key=lambda n: self._newest_turn[self._keys[n]]):
            with self._reports_failure(number):
                if self._videos[number].step():
                    self._videos[number] = self._videos.pop(number)  # moves to the end
                    self._num_turns += 1
                    self._newest_turn[self._keys[number]] = self._num_turns
                    self._report("image", number)
                    return True
                if number in self._ended:
                    self._close(number)
                    return True
        return False

    def close_early(self) -> None:
        """Save the finished part of every video."""
        for number in list(self._videos):
            with self._reports_failure(number):
                self._close(number)

    def _is_open(self, number: int) -> bool:
        return number in self._videos and number not in self._ended

    def _close(self, number: int) -> None:
        video = self._videos[number]
        video.close()
        self._forget(number)
        self._report("written", number, video.path)

    def _forget(self, number: int) -> None:
        """Drop all data of a video, and of its key if the key has no other video."""
        self._videos.pop(number, None)
        self._ended.discard(number)
        key = self._keys.pop(number)
        if key not in self._keys.values():
            self._newest_turn.pop(key, None)

    @contextmanager
    def _reports_failure(self, number: int) -> Iterator[None]:
        """Report an error as the failure of one video. The other videos continue."""
        try:
            yield
        except Exception as error:
            if not isinstance(error, UserError):
                LOG.exception("recording a video failed")
            if video := self._videos.get(number):
                video.discard()
            self._forget(number)
            self._report("failed", number, str(error))


def run(connection: Connection, config: DriverConfig) -> None:
    """Call the ``Recorder`` methods that the received commands name.

    None or the end of the connection ends the loop, and unfinished videos end early. Reports
    ``("alive",)`` about once a second.
    """
    os.setsid()  # Ctrl-C in the terminal reaches only the driver, which stops this process
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    configure("driver", config.log_level)
    renderers: list[Renderer] = []

    def open_video(path: Path) -> VideoRenderer:
        if not renderers:
            renderers.append(open_renderer(config))
        return VideoRenderer(path, renderers[0], config.frame_rate_hz, overwrite=False)

    def report(*result: object) -> None:
        with contextlib.suppress(OSError):  # the driver was killed
            connection.send(result)

    recorder = Recorder(open_video, report)
    is_drawing = False
    try:
        while True:
            for _ in range(MAX_COMMANDS):
                if not connection.poll(0.0 if is_drawing else ALIVE_S):
                    report("alive")
                    break
                command = connection.recv()
                if command is None:
                    return
                getattr(recorder, command[0])(*command[1:])
                is_drawing = True
            is_drawing = recorder.draw_image()
    except (EOFError, OSError):
        LOG.warning("the driver ended; its videos are incomplete")
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        recorder.close_early()
