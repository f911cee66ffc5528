"""The driver as a service: FAP frames in, a face in a window or a video out.

Reacts to: start-session, close-session (control), fap-frame, end-of-faps (synthesizer), sound
(recognizer).
Emits: recorded, error (control).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from kouxing.services.driver.config import DriverConfig
from kouxing.services.driver.kind import KIND
from kouxing.services.driver.poses import Poses
from kouxing.services.driver.recordings import Recordings
from kouxing.services.driver.video.recording import Recording
from kouxing.services.driver.view import View
from kouxing.shared.clock import to_seconds
from kouxing.shared.face.idle_motion import STALL_S
from kouxing.shared.keys import Peer
from kouxing.shared.logs import LOG
from kouxing.shared.message_loop import Handler
from kouxing.shared.service import Service
from kouxing.shared.service_follower import ServiceFollower
from kouxing.shared.wire.audio import Sound
from kouxing.shared.wire.control import EventName, SessionInput, StartSession
from kouxing.shared.wire.face import EndOfFaps, FapFrame, SetFace
from kouxing.shared.wire.message import Message
from kouxing.shared.wire.session import ErrorCode

DRAW_BUDGET_S = 0.2  # time for videos per loop iteration; heartbeats must continue
LAST_FRAME_LIMIT_S = 10.0  # wait for the last frames of a closed session


@dataclass(slots=True)
class _FollowedSession:
    """One session that the driver follows."""

    start: StartSession
    follower: ServiceFollower
    leave_by_s: float | None = None  # set once the session has closed


class DriverService(Service):
    """The driver process."""

    kind = KIND

    def __init__(self, config: DriverConfig) -> None:
        super().__init__(config)
        self._config = config
        self._sessions: dict[str, _FollowedSession] = {}
        self._was_stalled = False
        self.poses = Poses(config.session, config.idle_motion_seed)
        self.view = View(config, self.poses.switch)
        self._recordings = Recordings(
            self._make_recording,
            on_written=self._report_written,
            on_failed=self._report_failure,
            on_image=lambda: self.metrics.count("video_ms", round(1000 / config.frame_rate_hz)),
        )

    def control_handlers(self) -> dict[type[Message], Handler]:
        """Return the handlers of control's messages."""
        return super().control_handlers() | {SetFace: self._on_set_face}

    def _on_set_face(self, message: SetFace, _sender: Peer) -> None:
        """Change the face at rest; the frames of a session already have its settings."""
        if message.session == "" and message.face.expressions is not None:
            self.poses.express(message.face.expressions, message.face.hold_s)

    def start_session(self, start: StartSession) -> bool:
        """Follow a session's frames; confirm once the subscriptions are in effect."""
        session = self._sessions.get(start.session)
        if session is not None and session.start.token != start.token:
            self._leave(session)  # a different session with the same name
            session = None
        if session is None:
            session = self._sessions[start.session] = self._make_session(start)
            self.poses.add(start.session, time.monotonic())
        session.start = start
        if start.record:  # after a crash the same video continues
            self._recordings.begin(start.session)
        session.follower.start(start.epoch, start.endpoints)
        return False

    def stop_session(self, session: str) -> None:
        """Stop following a session; a recorded session continues until its last frame."""
        left = self._sessions.get(session)
        if left is None:
            return
        if not self._recordings.is_open(session):
            self._leave(left)
        elif left.leave_by_s is None:
            left.leave_by_s = time.monotonic() + LAST_FRAME_LIMIT_S

    def on_tick(self, now_s: float) -> None:
        """Draw what is due."""
        for session in list(self._sessions.values()):
            if session.leave_by_s is not None and now_s > session.leave_by_s:
                self._leave(session)
        if self.view.is_live:
            self._warn_if_stalled(now_s)
            self.view.show(self.poses.faps(now_s), self.poses.caption(now_s), now_s)
        self._recordings.draw_until(time.monotonic() + DRAW_BUDGET_S)

    def on_drain(self) -> bool:
        """Finish the open videos."""
        for session in list(self._sessions.values()):
            self._leave(session)
        self._recordings.draw_until(time.monotonic() + DRAW_BUDGET_S)
        return self._recordings.is_done

    def on_shutdown(self) -> None:
        """Save the unfinished part of the remaining videos."""
        for session in self._recordings.close_early():
            LOG.warning("the driver stopped, so the video ends early", extra={"session": session})
        self.view.close()

    def session_inputs(self) -> dict[str, SessionInput]:
        """Return the followed sessions; control answers which of them no longer exist."""
        return dict.fromkeys(self._sessions, SessionInput())

    # --- sessions ------------------------------------------------------------------------------

    def _make_session(self, start: StartSession) -> _FollowedSession:
        handlers: dict[type[Message], Callable[[Any], None]] = {
            FapFrame: self._on_frame,
            EndOfFaps: self._on_end,
        }
        if start.record:
            handlers[Sound] = self._on_sound
        follower = ServiceFollower(
            self, start.session, handlers, live=start.paced,
            on_complete=lambda: self.session_started(session.start),
        )  # fmt: skip
        session = _FollowedSession(start, follower)
        return session

    def _on_frame(self, frame: FapFrame) -> None:
        faps = np.frombuffer(frame.values, "<f4").astype(np.float32)
        self.poses.update(frame.session, faps, time.monotonic())
        self._recordings.add_frame(frame.session, to_seconds(frame.media_time), faps)

    def _on_sound(self, sound: Sound) -> None:
        samples = np.frombuffer(sound.pcm, "<i2").astype(np.float32) / np.float32(32768)
        self._recordings.add_sound(sound.session, sound.media_time, samples)

    def _on_end(self, end: EndOfFaps) -> None:
        self.poses.end(end.session)
        self._recordings.end(end.session)
        session = self._sessions[end.session]
        if session.leave_by_s is not None:
            self._leave(session)

    def _leave(self, session: _FollowedSession) -> None:
        """Close a session's subscriptions and finish its video with the frames received so far."""
        name = session.start.session
        del self._sessions[name]
        session.follower.close()
        self.poses.remove(name)
        self._recordings.end(name)

    def _warn_if_stalled(self, now_s: float) -> None:
        is_stalled = self.poses.is_stalled(now_s)
        if is_stalled and not self._was_stalled:
            LOG.warning(
                "no FAP frames for %g s: the face returns to rest",
                STALL_S,
                extra={"session": self.poses.shown},
            )
        self._was_stalled = is_stalled

    # --- videos --------------------------------------------------------------------------------

    def _make_recording(self, session: str) -> Recording:
        path = Path(self._config.out) / f"{session}.mp4"
        path.parent.mkdir(parents=True, exist_ok=True)
        return Recording(path, self.view.renderer(), self._config.frame_rate_hz, overwrite=False)

    def _report_written(self, session: str, recording: Recording) -> None:
        self.metrics.count("videos")
        LOG.info("wrote %s", recording.path, extra={"session": session})
        self.publish_event(EventName.RECORDED, session, str(recording.path))

    def _report_failure(self, session: str, reason: str) -> None:
        LOG.error(reason, extra={"session": session})
        self.publish_event(EventName.ERROR, session, f"{ErrorCode.NO_VIDEO}: {reason}")
