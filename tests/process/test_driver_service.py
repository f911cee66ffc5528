"""A driver with two sessions: one is shown, the other is recorded."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.driver.config import DriverConfig
from kouxing.services.driver.service import DriverService
from kouxing.shared.bus import Bus
from kouxing.shared.face.faps import MASK_BYTES, NUM_FAPS
from kouxing.shared.keys import Peer
from kouxing.shared.wire.control import (
    Event,
    Heartbeat,
    SessionInput,
    SessionStarted,
    StartSession,
)
from kouxing.shared.wire.face import EndOfFaps, FapFrame
from kouxing.shared.wire.session import CloseSession, SessionFacts

pytestmark = pytest.mark.process

LOCAL = "tcp://127.0.0.1:*"
FRAME_SAMPLES = 320  # 20 ms


class Stage:
    """Control, publishers and a driver without a window, stepped in turn."""

    def __init__(self, folder: Path) -> None:
        self.bus = Bus()
        self.commands = self.bus.bind_router(LOCAL, "commands")
        self.phones = self.bus.bind_publisher(LOCAL, "phones")
        self.faps = self.bus.bind_publisher(LOCAL, "faps")
        self.driver = DriverService(
            DriverConfig(
                control=self.commands.endpoint,
                insecure=True,
                view="none",
                out=str(folder),
                width_px=64,
                height_px=48,
            )
        )
        self.address = Peer()
        self.started: list[str] = []
        self.recorded: list[Event] = []
        self.errors: list[Event] = []
        self.step_until(lambda: bool(self.address.address))

    def close(self) -> None:
        self.driver.bus.close()
        self.bus.close()

    def step_until(self, condition: Callable[[], bool]) -> None:
        end_s = time.monotonic() + 20
        while not condition():
            assert time.monotonic() < end_s
            for publisher in (self.phones, self.faps):
                list(publisher.receive())  # process subscriptions
            self.driver.step(0.005)
            for received in self.commands.receive():
                match received.message:
                    case Heartbeat():
                        self.address = received.sender
                    case SessionStarted() as started:
                        self.started.append(started.session)
                    case Event(name="recorded") as recorded:
                        self.recorded.append(recorded)
                    case Event(name="error") as error:
                        self.errors.append(error)

    def start(self, session: str, *, epoch: int = 1, record: bool = False) -> None:
        message = StartSession(
            session=session,
            epoch=epoch,
            request=f"start-{session}-{epoch}",
            token=f"token-{session}",
            encoding="s16le",
            sample_rate_hz=16000,
            num_channels=1,
            record=record,
            paced=True,
            facts=SessionFacts(language="mandarin"),
            endpoints={"phones": self.phones.endpoint, "faps": self.faps.endpoint},
        )
        num_started = len(self.started)
        self.commands.send(message, to=self.address)
        self.step_until(lambda: len(self.started) > num_started)
        assert self.started[-1] == session

    def stop(self, session: str) -> None:
        self.commands.send(CloseSession(session=session), to=self.address)

    def publish(self, session: str, number: int, value: float, epoch: int = 1) -> None:
        self.faps.send(
            FapFrame(
                session=session,
                epoch=epoch,
                sequence=number + 1,
                media_time=number * FRAME_SAMPLES,
                values=np.full(NUM_FAPS, value, "<f4").tobytes(),
                mask=bytes(MASK_BYTES),
            )
        )

    def num_images(self) -> int:
        """Return the number of images in all videos."""
        return round(self.driver.metrics.snapshot(time.monotonic())["video_ms"]) // 40

    def shown(self) -> float:
        """Return the shown value of FAP 1."""
        return float(self.driver.poses.faps(time.monotonic())[0])


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def test_shows_one_session_while_recording_another(stage: Stage) -> None:
    stage.start("filmed", record=True)
    stage.start("other")
    seen = set()
    for number in range(51):  # simultaneous frames
        stage.publish("filmed", number, 100.0)
        stage.publish("other", number, 200.0)
        if number % 10 == 9:
            stage.step_until(partial(all_in, stage, 2 * (number + 1)))
            seen.add(stage.shown())
    assert seen == {200.0}

    stage.driver.poses.switch(1)
    assert stage.shown() == 100.0
    stage.driver.poses.switch(1)
    stage.faps.send(EndOfFaps(session="filmed", epoch=1))
    stage.stop("filmed")
    stage.step_until(lambda: bool(stage.recorded))
    assert stage.recorded[0].session == "filmed"
    assert stage.num_images() == 26  # of 0 to 1 s at 25 Hz
    assert Path(stage.recorded[0].detail).is_file()
    stage.step_until(lambda: stage.driver.session_inputs() == {"other": SessionInput()})
    assert stage.errors == []


def has_recorded(stage: Stage, num_videos: int) -> bool:
    return len(stage.recorded) == num_videos


def all_in(stage: Stage, num_frames: int) -> bool:
    return stage.driver.metrics.snapshot(time.monotonic()).get("in_fap_frame", 0) >= num_frames


def test_a_video_continues_after_a_restart(stage: Stage) -> None:
    stage.start("film", record=True)
    for number in range(26):
        stage.publish("film", number, 100.0)
    stage.step_until(lambda: all_in(stage, 26))
    stage.start("film", epoch=2, record=True)
    for number in range(26, 51):
        stage.publish("film", number, 100.0, epoch=2)
    stage.faps.send(EndOfFaps(session="film", epoch=2))
    stage.step_until(lambda: bool(stage.recorded))
    assert stage.num_images() == 26


def test_a_reused_session_name_does_not_overwrite_a_video(stage: Stage) -> None:
    for epoch in (1, 2, 3):
        stage.start("film", epoch=epoch, record=True)
        stage.publish("film", 0, 100.0, epoch=epoch)
        stage.step_until(partial(all_in, stage, epoch))
        stage.faps.send(EndOfFaps(session="film", epoch=epoch))
        stage.stop("film")
        stage.step_until(partial(has_recorded, stage, epoch))
    paths = [Path(recorded.detail) for recorded in stage.recorded]
    assert [path.name for path in paths] == ["film.mp4", "film-2.mp4", "film-3.mp4"]
    assert all(path.stat().st_size > 0 for path in paths)


def test_reports_an_unwritable_video_to_control(tmp_path: Path, stage: Stage) -> None:
    (tmp_path / "film.mp4").mkdir()
    stage.start("film", record=True)
    stage.publish("film", 0, 100.0)
    stage.step_until(lambda: stage.shown() == 100.0)
    stage.faps.send(EndOfFaps(session="film", epoch=1))
    stage.step_until(lambda: bool(stage.errors))
    assert stage.errors[0].detail.startswith("no-video: ")
