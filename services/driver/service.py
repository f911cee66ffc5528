"""The driver as a service: FAP frames in, a head in a window or a video out.

Reacts to: start, stop (control), fap, end (synthesizer), sound (recognizer).
Emits: recorded (control).
"""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from services.driver.recording import Recording
from services.driver.render import Renderer
from services.driver.scene import Framing, background, camera, load_head
from services.driver.virtual_camera import VirtualCamera
from services.driver.window import Window
from shared.bus import Socket
from shared.clock import to_seconds
from shared.config import DriverConfig
from shared.errors import UserError
from shared.faps import NUM_FAPS
from shared.logs import LOG
from shared.messages import (
    EndOfFaps,
    Error,
    FapFrame,
    Joined,
    Recorded,
    Sound,
    StartSession,
)
from shared.service import Service

RENDER_BUDGET_S = 0.2  # of recording in one turn of the loop, so that heartbeats go on
NUM_PUBLISHERS = 2  # recognizer and synthesizer
LAST_FRAME_LIMIT_S = 10.0  # for a closed session's last frames to arrive
STALL_S = 1.0  # without frames the window says so


@dataclass(slots=True)
class _Follower:
    """What the driver knows of one session."""

    start: StartSession
    socket: Socket
    publishers: set[str] = field(default_factory=set)  # that confirmed the subscriptions
    sequence: int = 0
    recording: Recording | None = None
    ended: bool = False  # its last frame has come
    leave_by_s: float | None = None  # the session is closed; the last frames are on their way


class DriverService(Service):
    """The driver process."""

    name = "driver"

    def __init__(self, config: DriverConfig) -> None:
        super().__init__(config)
        self._config = config
        self._followers: dict[str, _Follower] = {}
        self._unfinished: list[tuple[str, Recording]] = []
        self._head = load_head(config.head)
        self._background = background(config.background)
        if self._background is None:
            raise UserError(
                "driver.background: a window and MP4 have no transparency; give a colour"
            )
        if config.camera not in list(Framing):
            raise UserError(f"driver.camera: one of {', '.join(Framing)}")
        self._camera = camera(self._head, Framing(config.camera))
        self._renderer: Renderer | None = None
        self._faps = np.zeros(NUM_FAPS, np.float32)
        self._frame_s = time.monotonic()
        self._stalled = False
        self._window = self._open_window()
        self._visible = self._window is not None
        self._virtual_camera: VirtualCamera | None = None
        if config.virtual_camera:
            self._virtual_camera = VirtualCamera(self._own_renderer(), config.frame_rate_hz)
            LOG.info("the virtual camera is %s", self._virtual_camera.device)

    def start_session(self, start: StartSession) -> bool:
        """Follow a session's frames; confirm once the subscriptions are in effect."""
        recording = None
        old = self._followers.get(start.session)
        if old is not None:
            if old.start.token == start.token:  # the same after a crash: its video goes on
                recording, old.recording = old.recording, None
            self._leave(old)
        socket = self.bus.connect_subscriber(start.phones, start.faps)
        follower = _Follower(start=start, socket=socket)
        self.listen(
            socket,
            {
                Joined: lambda message, _: self._on_joined(follower, message),
                FapFrame: lambda message, _: self._on_frame(follower, message),
                Sound: lambda message, _: self._on_sound(follower, message),
                EndOfFaps: lambda message, _: self._on_end(follower),
            },
        )
        kinds = (FapFrame, EndOfFaps, Sound) if start.record else (FapFrame, EndOfFaps)
        socket.subscribe_session(kinds, start.session)
        if start.record:
            follower.recording = recording or self._begin_recording(start.session)
        self._followers[start.session] = follower
        return False

    def stop_session(self, session: str) -> None:
        """Follow a session no longer; one that is recorded only after its last frame."""
        follower = self._followers.get(session)
        if follower is None:
            return
        if follower.recording is None:
            self._leave(follower)
        elif follower.leave_by_s is None:
            follower.leave_by_s = time.monotonic() + LAST_FRAME_LIMIT_S

    def on_tick(self, now_s: float) -> None:
        """Draw what is due."""
        for follower in list(self._followers.values()):
            if follower.leave_by_s is not None and now_s > follower.leave_by_s:
                self._leave(follower)
        if self._window is not None and self._visible:
            self._visible = self._window.draw(self._shown(now_s))
            if not self._visible:
                LOG.info("the window was closed")
                self._window.hide()  # videos under way go on drawing in its context
        if self._virtual_camera is not None:
            self._virtual_camera.draw(self._shown(now_s), now_s)
        self._render_until(time.monotonic() + RENDER_BUDGET_S)

    def on_drain(self) -> bool:
        """Finish the videos that are under way."""
        for follower in list(self._followers.values()):
            self._leave(follower)
        self._render_until(time.monotonic() + RENDER_BUDGET_S)
        return not self._unfinished

    def on_stopped(self) -> None:
        """Keep what was drawn of the videos that could not be finished in time."""
        for session, recording in self._unfinished:
            LOG.warning("the video ends early", extra={"session": session})
            self._finish(session, recording)
        if self._virtual_camera is not None:
            self._virtual_camera.close()

    def idle_s(self) -> dict[str, float]:
        """Name the sessions followed, so that control can say which of them are no more."""
        return dict.fromkeys(self._followers, 0.0)

    # --- from the publishers -------------------------------------------------------------------

    def _on_joined(self, follower: _Follower, joined: Joined) -> None:
        follower.publishers.add(joined.publisher)
        if len(follower.publishers) == NUM_PUBLISHERS:
            self.session_started(follower.start)

    def _on_frame(self, follower: _Follower, frame: FapFrame) -> None:
        missed = frame.sequence - follower.sequence - 1
        if follower.sequence and missed > 0:
            self.metrics.count("frames_missed", missed)
        follower.sequence = frame.sequence
        self._faps = np.frombuffer(frame.values, "<f4").astype(np.float32)
        self._frame_s = time.monotonic()
        if follower.recording is not None:
            follower.recording.accept_frame(to_seconds(frame.media_time), self._faps)

    def _on_sound(self, follower: _Follower, sound: Sound) -> None:
        if follower.recording is not None:
            samples = np.frombuffer(sound.pcm, "<i2").astype(np.float32) / np.float32(32768)
            try:
                follower.recording.accept_sound(sound.media_time, samples)
            except UserError as error:
                self._give_up(follower.start.session, follower.recording, error)
                follower.recording = None

    def _on_end(self, follower: _Follower) -> None:
        follower.ended = True
        self._end_recording(follower)
        if follower.leave_by_s is not None:
            self._leave(follower)

    def _leave(self, follower: _Follower) -> None:
        """Close a session's subscriptions and finish its video with what has come."""
        del self._followers[follower.start.session]
        self.unlisten(follower.socket)
        self._end_recording(follower)

    # --- the window ----------------------------------------------------------------------------

    def _open_window(self) -> Window | None:
        has_display = bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        if self._config.view == "none" or (self._config.view == "auto" and not has_display):
            return None
        config = self._config
        head = load_head(config.head, "coarse")  # live, smooth motion is worth more than outlines
        try:
            return Window(
                head,
                config.width_px,
                config.height_px,
                background=self._background,
                camera=self._camera,
            )
        except UserError as error:
            if self._config.view == "window":
                raise
            LOG.warning("no window: %s", error)
            return None

    def _shown(self, now_s: float) -> np.ndarray[tuple[int], np.dtype[np.float32]]:
        """Return the newest frame, or while none comes one that fades to rest."""
        silent_s = now_s - self._frame_s
        stalled = silent_s > STALL_S
        if stalled != self._stalled:
            live = any(not follower.ended for follower in self._followers.values())
            lost = stalled and live
            if lost:
                LOG.warning("no FAP frames for %g s: the face goes to rest", STALL_S)
            if self._window is not None:
                self._window.say("no frames come" if lost else "")
            self._stalled = stalled
        fade = np.float32(np.clip(1.0 - (silent_s - STALL_S) / 0.3, 0.0, 1.0))
        return self._faps * fade

    # --- recording -----------------------------------------------------------------------------

    def _own_renderer(self) -> Renderer:
        """Make what draws beside the window, once."""
        if self._renderer is None:
            self._renderer = Renderer(
                self._head,
                self._config.width_px,
                self._config.height_px,
                background=self._background,
                camera=self._camera,
                context=None if self._window is None else self._window.context,
            )
        return self._renderer

    def _begin_recording(self, session: str) -> Recording | None:
        config = self._config
        try:
            renderer = self._own_renderer()
            path = Path(config.out) / f"{session}.mp4"
            path.parent.mkdir(parents=True, exist_ok=True)
            return Recording(path, renderer, config.frame_rate_hz)
        except (UserError, OSError) as error:
            self._report(session, "no-video", str(error))
            return None

    def _end_recording(self, follower: _Follower) -> None:
        if follower.recording is not None:
            self._unfinished.append((follower.start.session, follower.recording))
            follower.recording = None

    def _render_until(self, end_s: float) -> None:
        for follower in self._followers.values():
            while follower.recording is not None and time.monotonic() < end_s:
                try:
                    if not follower.recording.step():
                        break
                except UserError as error:
                    self._give_up(follower.start.session, follower.recording, error)
                    follower.recording = None
        while self._unfinished and time.monotonic() < end_s:
            session, recording = self._unfinished[0]
            try:
                if recording.step():
                    continue
                self._unfinished.pop(0)
                self._finish(session, recording)
            except UserError as error:
                self._unfinished = [
                    entry for entry in self._unfinished if entry[1] is not recording
                ]
                self._give_up(session, recording, error)

    def _finish(self, session: str, recording: Recording) -> None:
        recording.close()
        self.metrics.count("videos")
        LOG.info("wrote %s", recording.path, extra={"session": session})
        if self.control is not None:
            self.control.send(
                Recorded(
                    session=session,
                    path=str(recording.path),
                    num_images=recording.num_images,
                    duration_s=recording.duration_s,
                )
            )

    def _give_up(self, session: str, recording: Recording, error: UserError) -> None:
        recording.discard()
        self._report(session, "no-video", str(error))

    def _report(self, session: str, code: str, text: str) -> None:
        LOG.error(text, extra={"session": session})
        if self.control is not None:
            self.control.send(Error(session=session, code=code, text=text))
