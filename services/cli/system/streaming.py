"""Streams audio to a running system, in real time or as fast as the system accepts it."""

import contextlib
import time
from dataclasses import dataclass

import numpy as np
from kouxing_client import Client, KouxingError, Phone, Refused, Session
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kouxing.shared.audio.audio_file import AudioSource
from kouxing.shared.audio.level_check import LevelCheck
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.command.terminal import open_progress, plural, print_message
from kouxing.shared.errors import UserError
from kouxing.shared.interrupt import clear_interrupt

PUSH_TIMEOUT_S = 30.0
STATUS_S = 1.0  # interval between status requests
DRIVER_TIMEOUT_S = 20.0  # time for a lost driver to restart, on a busy machine
PIPE_PAUSE_S = 0.2  # a pipe that is silent for longer has paused; its next audio is not late
PIPE_TEMPO = 0.999  # a device with a fast clock would fill the pipe
QUIET_PEAK = 1e-3  # a file whose peak is lower (-60 dBFS) is called silent


@dataclass(frozen=True, slots=True)
class StreamSummary:
    """Result of streaming one source."""

    session: str
    duration_s: float
    num_phones: int
    video: str  # path on the driver's host; empty if none was recorded


def stream(
    source: AudioSource,
    control: str,
    *,
    session: str = "",
    record: bool = False,
    paced: bool = True,
    mouth_profile: bytes = b"",
    language: str | None = None,
) -> StreamSummary:
    """Stream a source through a running system and wait for its last FAP frame.

    ``mouth_profile`` is the speaker's, if any. ``language`` is the language of the speech. Raises
    ``UserError`` if the system does not answer, rejects the session or stops answering.
    """
    with connect_client(control) as client:
        for notice in source.notices:
            _warn(notice)
        drawn_before_s = _drawn_s(client) if record else None
        opened = client.open_session(
            session,
            encoding="f32le",
            sample_rate_hz=source.sample_rate_hz,
            num_channels=source.num_channels,
            record=record,
            paced=paced,
            mouth_profile=mouth_profile or None,
            language=language,
        )
        try:
            streamer = _Streamer(client, opened, source, drawn_before_s)
            streamer.run(paced=paced)
        finally:
            with contextlib.suppress(KouxingError):  # closed already, or control is gone
                opened.close()
        return streamer.summarize()


def missed_warning(count: int, noun: str) -> str:
    """Return the message about results that did not arrive."""
    return (
        f"missed at least {plural(count, noun)}; close other programs or use a faster network,"
        " then try again"
    )


class _Streamer:
    """Streams one source into a session.

    ``drawn_before_s`` is the duration of the video that the driver had drawn before the session,
    seconds; None if the session is not recorded.
    """

    def __init__(
        self, client: Client, session: Session, source: AudioSource, drawn_before_s: float | None
    ) -> None:
        self._client = client
        self._session = session
        self._source = source
        self._drawn_before_s = drawn_before_s
        self._awaits_video = drawn_before_s is not None
        self._video = ""  # path of the written video
        self._duration_s = self._peak = 0.0  # of the sent audio
        self._level = LevelCheck()
        self._num_phones = 0
        self._events = session.events()
        self._frames = session.frames()
        self._phones = session.results(Phone, keep_all=True)
        self._progress = _new_progress()
        self._task = self._progress.add_task(f"speaking {source.name}", total=source.duration_s)

    def run(self, *, paced: bool) -> None:
        """Stream the source and wait for the last frame."""
        try:
            with self._progress:
                self._send_all(paced=paced)
                self._session.finish()
                self._wait_for_end()
        except KeyboardInterrupt:
            if self._drawn_before_s is not None:
                self._end_video()
            raise

    def _end_video(self) -> None:
        """Close the session after Ctrl-C, and print the path of its video."""
        clear_interrupt()
        print_message("stopping; press Ctrl-C again to exit without waiting for the video")
        with contextlib.suppress(KouxingError):  # closed already, or control is gone
            self._session.close()
        self._wait_for_video()
        print_message(f"wrote {self._video}" if self._video else "no video was written")

    def summarize(self) -> StreamSummary:
        """Wait for the video, if any; print warnings, and return the summary."""
        source = self._source
        self._wait_for_video()
        if not self._num_phones:
            reason = "; it is silent" if self._peak < QUIET_PEAK else ""
            _warn(f"{source.name}: no speech was found{reason}")
        if self._phones.num_missed:
            _warn(missed_warning(self._phones.num_missed, "phone"))
        for warning in (*source.warnings, *self._level.warnings(source.name)):
            _warn(warning)
        return StreamSummary(self._session.name, self._duration_s, self._num_phones, self._video)

    def _update(self, timeout_s: float) -> None:
        """Process received results, waiting up to the timeout for a phone."""
        self._num_phones += sum(phone.is_spoken for phone in self._phones.available(timeout_s))
        for frame in self._frames.available():
            self._progress.update(self._task, completed=frame.time_s)

    def _send_all(self, *, paced: bool) -> None:
        source = self._source
        num_sent = 0
        is_pipe = source.duration_s is None
        due_s = time.monotonic()  # when the next block is spoken
        try:
            for block in source.blocks:
                self._check_errors()
                with contextlib.suppress(Refused):  # `_check_errors` reports the next one
                    self._session.push(block.astype("<f4").tobytes(), PUSH_TIMEOUT_S)
                num_sent += len(block)
                self._level.add(block)
                self._peak = max(self._peak, float(np.abs(block).max()))
                self._update(0.0)
                if paced and not source.is_live:
                    if is_pipe and time.monotonic() > due_s + PIPE_PAUSE_S:
                        due_s = time.monotonic()  # the source resumes after a pause
                    due_s += len(block) / source.sample_rate_hz * (PIPE_TEMPO if is_pipe else 1.0)
                    time.sleep(max(0.0, due_s - time.monotonic()))
        except KeyboardInterrupt:
            if not source.is_live:
                raise
            clear_interrupt()
            print_message("stopping; press Ctrl-C again to drop the last words")
        self._duration_s = num_sent / source.sample_rate_hz

    def _wait_for_end(self) -> None:
        """Wait for the last frame, which may take long if much audio is queued."""
        ask_s = time.monotonic() + STATUS_S
        while not self._phones.has_ended:
            self._update(0.2)
            self._check_errors()
            if time.monotonic() > ask_s:
                self._client.status()  # fails if control is gone
                ask_s = time.monotonic() + STATUS_S
        self._update(0.0)

    def _check_errors(self) -> None:
        """Print the errors that the services report."""
        try:
            errors = self._session.take_errors()
        except Refused as refusal:
            errors = [refusal]
        for error in errors:
            _warn(str(error))
            if error.code in ("unknown-session", "bad-token", "finished"):
                raise UserError("the session was lost; run the command again")
        self._read_events(0.0)

    def _read_events(self, timeout_s: float) -> None:
        """Print the errors among the events, and keep the path of the video."""
        for event in self._events.available(timeout_s):
            if event.name == "recorded":
                self._video, self._awaits_video = event.detail, False
            elif event.name == "error":
                _warn(event.detail)
                self._awaits_video &= not event.detail.startswith("no-video")

    def _wait_for_video(self) -> None:
        """Wait for the driver's video, unless it is written or has failed."""
        try:
            with _new_progress() as progress:
                task = progress.add_task("writing the video", total=self._duration_s or None)
                drawn_before_s = newest_s = self._drawn_before_s or 0.0
                while self._awaits_video:
                    drawn_s = _drawn_s(self._client, DRIVER_TIMEOUT_S)
                    if drawn_s < newest_s:
                        raise UserError(
                            "the driver restarted, so the video is incomplete; try again"
                        )
                    newest_s = drawn_s
                    progress.update(task, completed=drawn_s - drawn_before_s)
                    self._read_events(STATUS_S)
        except KeyboardInterrupt:
            print_message(f"the driver is still writing the video of session {self._session.name}")
            raise


def _new_progress() -> Progress:
    return open_progress(TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())


def _drawn_s(client: Client, timeout_s: float = 0.0) -> float:
    """Return how many seconds of video the driver has drawn since it started."""
    end_s = time.monotonic() + timeout_s
    while True:
        drivers = [state for state in client.status().services if state.service == "driver"]
        if drivers:
            return max(state.metrics.get("video_ms", 0.0) for state in drivers) / 1000
        if time.monotonic() >= end_s:
            raise UserError("no driver is running to write the video; start 'kouxing driver'")
        time.sleep(STATUS_S)


def _warn(text: str) -> None:
    print_message(text, style="yellow")
