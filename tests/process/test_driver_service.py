"""A driver with two sessions: one is shown, the other is recorded."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path
from queue import SimpleQueue
from unittest.mock import Mock

import numpy as np
import pytest
from kouxing_client import follower
from kouxing_client.messages import EndOfFaps, Event

from kouxing.services.driver import pose_store, recorder_client
from kouxing.services.driver.config import DriverConfig
from kouxing.services.driver.recorder_client import _RecorderProcess
from kouxing.services.driver.service import DriverService
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.fast_record import replace
from kouxing.shared.wire.control import SessionProgress, SessionStarted
from kouxing.shared.wire.session import Error
from tests.fake_control import FakeControl
from tests.samples import START, fap_frame
from tests.system import wait_until

VIDEO_NUMBERS = count()  # a recorder never receives the same number twice


class DriverHarness:
    """A driver without a window, which this thread runs."""

    def __init__(self, folder: Path, control: FakeControl) -> None:
        self.control = control
        self.folder = folder
        self.driver = DriverService(
            DriverConfig(
                control=control.address,
                insecure=True,
                view="none",
                out=str(folder),
                size="64x48",
                max_videos=4,
            )
        )
        self.driver.view = self  # type: ignore[assignment]
        self.is_live = True
        self.step_until(lambda: control.heartbeats)

    def show(self, *_: object) -> None:
        """Show nothing, as a view."""

    def close(self) -> None:
        """Close nothing, as a view."""

    def step_until(self, condition: Callable[[], object]) -> None:
        wait_until(condition, step=lambda: self.driver.step(0.005))

    def start(self, session: str, *, epoch: int = 1, record: bool = False) -> None:
        num_started = len(self.control.messages_of(SessionStarted))
        self.control.send_start(session, epoch=epoch, record=record)
        self.step_until(lambda: len(self.control.messages_of(SessionStarted)) > num_started)

    def unfinished(self) -> list[Path]:
        return list(self.folder.glob(".*.part"))

    def publish(self, session: str, number: int, value: float, epoch: int = 1) -> None:
        values = np.full(NUM_FAPS, value, "<f4").tobytes()
        frame = fap_frame(session, number, values, epoch)
        self.control.publish(self.control.faps, frame)

    def end(self, session: str, epoch: int = 1) -> None:
        """End the frames of a session."""
        self.control.publish(self.control.faps, EndOfFaps(session=session, epoch=epoch))

    def events(self, name: str) -> list[Event]:
        return [event for event in self.control.messages_of(Event) if event.name == name]

    def has_recorded(self, num_videos: int) -> bool:
        return len(self.events("recorded")) == num_videos

    def wait_for_frames(self, number: int) -> None:
        """Run until the driver has received a number of frames."""
        self.step_until(
            lambda: self.driver.metrics.snapshot(time.monotonic()).get("in_fap_frame", 0) >= number
        )

    def num_images(self) -> int:
        """Return the number of images in all videos."""
        return round(self.driver.metrics.snapshot(time.monotonic())["video_ms"]) // 40

    def shown(self) -> float:
        """Return the shown value of FAP 1."""
        return float(self.driver.poses.faps(time.monotonic())[0])


@pytest.fixture(scope="module")
def idle_recorders() -> Iterator[list[_RecorderProcess]]:
    """The idle recorder of an earlier driver, if any, because starting a recorder takes long."""
    recorders: list[_RecorderProcess] = []
    yield recorders
    for recorder in recorders:
        recorder.kill()


@pytest.fixture
def harness(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, idle_recorders: list[_RecorderProcess]
) -> Iterator[DriverHarness]:
    def start_recorder(config: DriverConfig) -> _RecorderProcess:
        return idle_recorders.pop() if idle_recorders else _RecorderProcess(config)

    monkeypatch.setattr(follower, "CATCH_UP_S", 0.0)  # no frame is too old on a busy machine
    monkeypatch.setattr(recorder_client, "_RecorderProcess", start_recorder)
    monkeypatch.setattr(recorder_client, "count", lambda: VIDEO_NUMBERS)
    with FakeControl() as control:
        harness = DriverHarness(tmp_path, control)
        yield harness
        videos, recorder = harness.driver.recorder, harness.driver.recorder._recorder
        if recorder is not None and recorder.process.is_alive() and not videos.unfinished:
            videos._recorder = None
            idle_recorders.append(recorder)
        harness.driver.on_shutdown()
        harness.driver.bus.close()


@pytest.fixture
def no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let videos start no process, in a test that looks at no video."""
    process = Mock(commands=SimpleQueue())
    process.connection.poll.return_value = False
    monkeypatch.setattr(recorder_client, "_RecorderProcess", lambda _: process)


def test_shows_one_session_while_recording_another(
    harness: DriverHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pose_store, "FADE_S", 1e-9)  # on a quick machine, the face would fade in
    monkeypatch.setattr(pose_store, "STALL_S", 60.0)  # on a busy one, it would fade out
    harness.start("filmed", record=True)
    harness.start("other")
    values = set()
    for number in range(51):  # simultaneous frames
        harness.publish("filmed", number, 100.0)
        harness.publish("other", number, 200.0)
        if number % 10 == 9:
            harness.wait_for_frames(2 * (number + 1))
            values.add(harness.shown())
    assert values == {200.0}

    harness.driver.poses.switch(1)
    assert harness.shown() == 100.0
    harness.driver.poses.switch(1)
    harness.end("filmed")
    harness.control.stop_session("filmed")
    harness.step_until(lambda: harness.events("recorded"))
    (recorded,) = harness.events("recorded")
    assert recorded.session == "filmed"
    assert harness.num_images() == 26  # of 0 to 1 s at 25 Hz
    assert Path(recorded.detail).is_file()
    harness.step_until(lambda: harness.driver.session_progress() == {"other": SessionProgress()})
    assert harness.events("error") == []


def test_a_video_continues_after_a_restart(harness: DriverHarness) -> None:
    for epoch, numbers in ((1, range(26)), (2, range(26, 51))):
        harness.start("film", epoch=epoch, record=True)
        for number in numbers:
            harness.publish("film", number, 100.0, epoch)
        harness.wait_for_frames(numbers.stop)
    harness.end("film", epoch=2)
    harness.step_until(lambda: harness.events("recorded"))
    assert harness.num_images() == 26


def test_a_reused_session_name_does_not_overwrite_a_video(harness: DriverHarness) -> None:
    for epoch in (1, 2, 3):
        harness.start("film", epoch=epoch, record=True)
        harness.publish("film", 0, 100.0, epoch)
        harness.wait_for_frames(epoch)
        harness.end("film", epoch)
        harness.control.stop_session("film")
        harness.step_until(partial(harness.has_recorded, epoch))
    paths = [Path(recorded.detail) for recorded in harness.events("recorded")]
    assert [path.name for path in paths] == ["film.mp4", "film-2.mp4", "film-3.mp4"]
    assert all(path.stat().st_size > 0 for path in paths)


def test_reports_an_unwritable_video_to_control(tmp_path: Path, harness: DriverHarness) -> None:
    (tmp_path / "film.mp4").mkdir()
    harness.start("film", record=True)
    harness.publish("film", 0, 100.0)
    harness.wait_for_frames(1)
    harness.end("film")
    harness.step_until(lambda: harness.events("error"))
    assert harness.events("error")[0].detail.startswith("no-video: ")


def test_reports_a_video_in_a_folder_whose_name_is_not_utf8(harness: DriverHarness) -> None:
    harness.driver._report_written(replace(START, session="film"), Path("\udce9/film.mp4"))
    harness.step_until(lambda: harness.has_recorded(1))
    assert harness.events("recorded")[0].detail == "\ufffd/film.mp4"


def test_reports_a_video_that_ends_early_before_it_is_written(harness: DriverHarness) -> None:
    harness.start("film", record=True)
    harness.publish("film", 0, 100.0)
    harness.wait_for_frames(1)
    videos = harness.driver.recorder
    number = videos._open["film"]
    videos._send("film", "end")
    videos._on_report("short", number, "too many frames")
    harness.step_until(partial(harness.has_recorded, 1))
    assert [event.detail for event in harness.events("error")] == ["short-video: too many frames"]


def test_refuses_more_videos_than_the_limit(harness: DriverHarness) -> None:
    for number in range(4):
        harness.start(f"film-{number}", record=True)
    harness.control.send_start("one-more", record=True)
    harness.step_until(lambda: harness.control.messages_of(Error))
    (refusal,) = harness.control.messages_of(Error)
    assert (refusal.session, refusal.request) == ("one-more", "start-one-more-1")
    assert refusal.code == "busy"
    assert "max_videos" in refusal.text
    harness.start("unrecorded")
    harness.publish("film-0", 0, 100.0)
    harness.wait_for_frames(1)
    harness.end("film-0")
    harness.step_until(lambda: len(harness.events("recorded")) == 1)
    harness.start("one-more", record=True)


@pytest.mark.usefixtures("no_process")
def test_limits_the_videos_of_one_key(harness: DriverHarness) -> None:
    videos = harness.driver.recorder
    for number in range(3):
        assert videos.rejection_reason("greedy") == ""
        videos.begin(replace(START, session=f"film-{number}", client_key="greedy"))
    assert "your key has 3 unfinished videos, the maximum" in videos.rejection_reason("greedy")
    assert videos.rejection_reason("other") == ""


def test_a_killed_recorder_fails_its_videos_and_leaves_no_file(harness: DriverHarness) -> None:
    harness.start("film", record=True)
    harness.publish("film", 0, 100.0)
    harness.step_until(harness.unfinished)
    recorder = harness.driver.recorder._recorder
    assert recorder is not None
    recorder.process.kill()
    harness.step_until(lambda: harness.events("error"))
    assert harness.events("error")[0].detail.startswith("no-video: ")
    assert harness.unfinished() == []
    harness.start("next", record=True)
    harness.publish("next", 0, 100.0)
    harness.end("next")
    harness.step_until(partial(harness.has_recorded, 1))


def test_the_recorder_ends_when_there_is_no_video(
    harness: DriverHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_client, "IDLE_S", 0.0)
    harness.start("film", record=True)
    harness.publish("film", 0, 100.0)
    harness.end("film")
    harness.step_until(partial(harness.has_recorded, 1))
    harness.step_until(lambda: not multiprocessing.active_children())


def test_a_stopping_driver_saves_the_finished_part_of_a_video(
    harness: DriverHarness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_client, "CLOSE_TIMEOUT_S", 60.0)
    harness.start("film", record=True)
    for number in range(26):
        harness.publish("film", number, 100.0)
    harness.step_until(lambda: harness.driver.metrics.counts["video_ms"])
    harness.driver.on_shutdown()
    wait_until(lambda: not multiprocessing.active_children())
    assert [path.name for path in harness.folder.iterdir()] == ["film.mp4"]


@pytest.mark.usefixtures("no_process")
def test_follows_only_sessions_that_it_shows_or_records(harness: DriverHarness) -> None:
    harness.is_live = False
    harness.start("heard")
    assert not harness.driver.session_progress()
    harness.start("filmed", record=True)
    assert [*harness.driver.session_progress()] == ["filmed"]
