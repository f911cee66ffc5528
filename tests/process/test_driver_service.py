"""A driver with two sessions: one is shown, the other is recorded."""

import multiprocessing
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from kouxing_client import follower

from kouxing.services.driver import poses, recordings
from kouxing.services.driver.config import DriverConfig
from kouxing.services.driver.service import DriverService
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.wire.control import Event, SessionInput, SessionStarted
from kouxing.shared.wire.face import EndOfFaps
from kouxing.shared.wire.session import Error
from tests.fake_control import FakeControl
from tests.samples import fap_frame
from tests.system import wait_until


class Stage:
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
        num_started = len(self.control.of(SessionStarted))
        self.control.send_start(session, epoch=epoch, record=record)
        self.step_until(lambda: len(self.control.of(SessionStarted)) > num_started)

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
        return [event for event in self.control.of(Event) if event.name == name]

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


@pytest.fixture
def stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stage]:
    monkeypatch.setattr(follower, "CATCH_UP_S", 0.0)  # no frame is too old on a busy machine
    with FakeControl() as control:
        stage = Stage(tmp_path, control)
        yield stage
        stage.driver.on_shutdown()
        stage.driver.bus.close()
    for recorder in multiprocessing.active_children():  # it may still be ending
        recorder.join()


def test_shows_one_session_while_recording_another(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poses, "FADE_S", 1e-9)  # on a quick machine, the face would fade in
    monkeypatch.setattr(poses, "STALL_S", 60.0)  # on a busy one, it would fade out
    stage.start("filmed", record=True)
    stage.start("other")
    seen = set()
    for number in range(51):  # simultaneous frames
        stage.publish("filmed", number, 100.0)
        stage.publish("other", number, 200.0)
        if number % 10 == 9:
            stage.wait_for_frames(2 * (number + 1))
            seen.add(stage.shown())
    assert seen == {200.0}

    stage.driver.poses.switch(1)
    assert stage.shown() == 100.0
    stage.driver.poses.switch(1)
    stage.end("filmed")
    stage.control.stop_session("filmed")
    stage.step_until(lambda: stage.events("recorded"))
    (recorded,) = stage.events("recorded")
    assert recorded.session == "filmed"
    assert stage.num_images() == 26  # of 0 to 1 s at 25 Hz
    assert Path(recorded.detail).is_file()
    stage.step_until(lambda: stage.driver.session_inputs() == {"other": SessionInput()})
    assert stage.events("error") == []


def test_a_video_continues_after_a_restart(stage: Stage) -> None:
    for epoch, numbers in ((1, range(26)), (2, range(26, 51))):
        stage.start("film", epoch=epoch, record=True)
        for number in numbers:
            stage.publish("film", number, 100.0, epoch)
        stage.wait_for_frames(numbers.stop)
    stage.end("film", epoch=2)
    stage.step_until(lambda: stage.events("recorded"))
    assert stage.num_images() == 26


def test_a_reused_session_name_does_not_overwrite_a_video(stage: Stage) -> None:
    for epoch in (1, 2, 3):
        stage.start("film", epoch=epoch, record=True)
        stage.publish("film", 0, 100.0, epoch)
        stage.wait_for_frames(epoch)
        stage.end("film", epoch)
        stage.control.stop_session("film")
        stage.step_until(partial(stage.has_recorded, epoch))
    paths = [Path(recorded.detail) for recorded in stage.events("recorded")]
    assert [path.name for path in paths] == ["film.mp4", "film-2.mp4", "film-3.mp4"]
    assert all(path.stat().st_size > 0 for path in paths)


def test_reports_an_unwritable_video_to_control(tmp_path: Path, stage: Stage) -> None:
    (tmp_path / "film.mp4").mkdir()
    stage.start("film", record=True)
    stage.publish("film", 0, 100.0)
    stage.wait_for_frames(1)
    stage.end("film")
    stage.step_until(lambda: stage.events("error"))
    assert stage.events("error")[0].detail.startswith("no-video: ")


def test_refuses_more_videos_than_the_limit(stage: Stage) -> None:
    for number in range(4):
        stage.start(f"film-{number}", record=True)
    stage.control.send_start("one-more", record=True)
    stage.step_until(lambda: stage.control.of(Error))
    (refusal,) = stage.control.of(Error)
    assert (refusal.session, refusal.request) == ("one-more", "start-one-more-1")
    assert refusal.code == "busy"
    assert "max_videos" in refusal.text
    stage.start("unrecorded")
    stage.end("film-0")
    stage.step_until(lambda: len(stage.events("recorded")) == 1)
    stage.start("one-more", record=True)


def test_limits_the_videos_of_one_key(stage: Stage) -> None:
    videos = stage.driver.recordings
    for number in range(3):
        assert videos.rejection_reason("greedy") == ""
        videos.begin(f"film-{number}", "greedy")
    assert "your key has 3 unfinished videos, the maximum" in videos.rejection_reason("greedy")
    assert videos.rejection_reason("other") == ""


def test_a_killed_recorder_fails_its_videos_and_leaves_no_file(stage: Stage) -> None:
    stage.start("film", record=True)
    stage.publish("film", 0, 100.0)
    stage.step_until(stage.unfinished)
    recorder = stage.driver.recordings._recorder
    assert recorder is not None
    recorder.process.kill()
    stage.step_until(lambda: stage.events("error"))
    assert stage.events("error")[0].detail.startswith("no-video: ")
    assert stage.unfinished() == []
    stage.start("next", record=True)
    stage.publish("next", 0, 100.0)
    stage.end("next")
    stage.step_until(partial(stage.has_recorded, 1))


def test_the_recorder_ends_when_there_is_no_video(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "IDLE_S", 0.0)
    stage.start("film", record=True)
    stage.publish("film", 0, 100.0)
    stage.end("film")
    stage.step_until(partial(stage.has_recorded, 1))
    stage.step_until(lambda: not multiprocessing.active_children())


def test_a_stopping_driver_saves_the_finished_part_of_a_video(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recordings, "CLOSE_LIMIT_S", 60.0)
    stage.start("film", record=True)
    for number in range(26):
        stage.publish("film", number, 100.0)
    stage.step_until(lambda: stage.driver.metrics.counts["video_ms"])
    stage.driver.on_shutdown()
    assert [path.name for path in stage.folder.iterdir()] == ["film.mp4"]


def test_follows_only_sessions_that_it_shows_or_records(stage: Stage) -> None:
    stage.is_live = False
    stage.start("heard")
    assert not stage.driver.session_inputs()
    stage.start("filmed", record=True)
    assert [*stage.driver.session_inputs()] == ["filmed"]
