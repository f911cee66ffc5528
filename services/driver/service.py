"""The driver service: shows FAP frames in a window, or writes a video."""

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from kouxing_client.messages import EndOfFaps, FapFrame, Message, Sound

from kouxing.services.driver.config import DriverConfig
from kouxing.services.driver.pose_store import PoseStore
from kouxing.services.driver.recorder_client import RecorderClient
from kouxing.services.driver.view import View
from kouxing.services.service_kinds import KINDS
from kouxing.shared.clock import to_seconds
from kouxing.shared.errors import Rejected
from kouxing.shared.face.idle_motion import STALL_S
from kouxing.shared.files.output_file import remove_unfinished
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.service.session_follower import SessionFollower
from kouxing.shared.service.session_service import SessionService
from kouxing.shared.wire.control import EventName, SessionProgress, StartSession
from kouxing.shared.wire.face import SetFace
from kouxing.shared.wire.session import ErrorCode

LAST_FRAME_TIMEOUT_S = 10.0  # wait for the last frames of a closed session
MAX_DRAIN_S = 3.0  # time to draw the remaining images when the driver stops
RETRY_AFTER_S = 5.0  # sent to a client whose session cannot be recorded now


class _FollowedSession(SessionFollower):
    """A session that the driver follows."""

    leave_by_s: float | None = None  # set once the session has closed


class DriverService(SessionService):
    """The driver process."""

    kind = KINDS["driver"]

    def __init__(self, config: DriverConfig) -> None:
        super().__init__(config)
        self._config = config
        self._sessions: dict[str, _FollowedSession] = {}
        self._was_stalled = False
        self._drain_until_s = math.inf
        self.poses = PoseStore(config.session, idle_motion=config.idle_motion)
        self.view = View(config, self.poses.switch)
        self.recorder = RecorderClient(
            config,
            on_written=self._report_written,
            on_error=self._report_error,
            on_image=lambda: self.metrics.count("video_ms", round(1000 / config.frame_rate_hz)),
        )

    def change_face(self, message: SetFace) -> None:
        """Change the face at rest; the frames of a session already have its settings."""
        if message.session == "" and message.face.expressions is not None:
            self.poses.express(message.face.expressions, message.face.hold_s)

    def start_session(self, start: StartSession) -> bool:
        """Follow a session's frames if they are shown or recorded.

        The session has started once the subscriptions are in effect.
        """
        session = self._sessions.get(start.session)
        if session is not None and session.session_start.token != start.token:
            self._unfollow(session)  # a different session with the same name
            session = None
        if session is None and not start.opening.record and not self.view.is_live:
            return True
        if session is None:
            key = start.client_key or ""
            if start.opening.record and (reason := self.recorder.rejection_reason(key)):
                raise Rejected(ErrorCode.BUSY, reason, RETRY_AFTER_S)
            handlers: dict[type[Message], Callable[[Any], None]] = {
                FapFrame: self._on_frame,
                EndOfFaps: self._on_end,
            }
            if start.opening.record:
                handlers[Sound] = self._on_sound
            session = _FollowedSession(self, start, handlers)
            self._sessions[start.session] = session
            self.poses.add(start.session, time.monotonic())
            if start.opening.record:
                self.recorder.begin(start)
        session.session_start = start
        session.follow()
        return False

    def stop_session(self, session: str) -> None:
        """Stop following a session; a recorded session continues until its last frame."""
        stopped = self._sessions.get(session)
        if stopped is None:
            return
        if not self.recorder.is_open(session):
            self._unfollow(stopped)
        elif stopped.leave_by_s is None:
            stopped.leave_by_s = time.monotonic() + LAST_FRAME_TIMEOUT_S

    def gauges(self) -> dict[str, float]:
        """Return the number of videos that are not written yet."""
        return {"unfinished_videos": len(self.recorder.unfinished)}

    def on_startup(self) -> None:
        """Delete the unfinished videos of a killed driver."""
        remove_unfinished(Path(self._config.out))

    def on_tick(self, now_s: float) -> float:
        """Draw what is due."""
        due_s = self.recorder.tick(now_s)
        for session in list(self._sessions.values()):
            if session.leave_by_s is not None and now_s >= session.leave_by_s:
                self._unfollow(session)
            elif session.leave_by_s is not None:
                due_s = min(due_s, session.leave_by_s)
        if self.view.is_live:
            self._warn_if_stalled(now_s)
            self.view.show(self.poses.faps(now_s), self.poses.caption(now_s), now_s)
            due_s = now_s
        return due_s

    def on_drain(self) -> bool:
        """Finish the open videos."""
        for session in list(self._sessions.values()):
            self._unfollow(session)
        now_s = time.monotonic()
        self.recorder.tick(now_s)
        self._drain_until_s = min(self._drain_until_s, now_s + MAX_DRAIN_S)
        return not self.recorder.unfinished or now_s > self._drain_until_s

    def on_shutdown(self) -> None:
        """Save the unfinished part of the remaining videos."""
        for session in self.recorder.unfinished:
            LOG.warning("the driver stopped, so the video ends early", extra={"session": session})
        self.recorder.close()
        self.view.close()

    def session_progress(self) -> dict[str, SessionProgress]:
        """Return the followed sessions; control answers which of them no longer exist."""
        return dict.fromkeys(self._sessions, SessionProgress())

    # --- sessions ------------------------------------------------------------------------------

    def _on_frame(self, frame: FapFrame) -> None:
        faps = np.frombuffer(frame.packed_values, "<f4").astype(np.float32)
        self.poses.update(frame.session, faps, time.monotonic())
        self.recorder.add_frame(frame.session, to_seconds(frame.media_time), frame.packed_values)

    def _on_sound(self, sound: Sound) -> None:
        self.recorder.add_audio(sound.session, sound.media_time, sound.pcm)

    def _on_end(self, end: EndOfFaps) -> None:
        self.poses.end(end.session)
        self.recorder.end(end.session)
        session = self._sessions[end.session]
        if session.leave_by_s is not None:
            self._unfollow(session)

    def _unfollow(self, session: _FollowedSession) -> None:
        """Close a session's subscriptions and finish its video with the frames received so far."""
        del self._sessions[session.session]
        session.close()
        self.poses.remove(session.session)
        self.recorder.end(session.session)

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

    def _report_written(self, start: StartSession, path: Path) -> None:
        self.metrics.count("videos")
        LOG.info("wrote %s", path, extra={"session": start.session})
        self.publish_event(EventName.RECORDED, start, str(path))

    def _report_error(self, code: ErrorCode, start: StartSession, reason: str) -> None:
        LOG.error(reason, extra={"session": start.session})
        self.publish_event(EventName.ERROR, start, f"{code}: {reason}")
