"""Keeps the newest pose of each followed session, and chooses the session to show."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from kouxing.shared.arrays import Floats
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.idle_motion import FADE_S, STALL_S, RestingFace

NEWEST = "newest"

Faps = Floats


@dataclass(slots=True)
class _Pose:
    updated_s: float  # arrival of the newest frame, or opening of the session
    faps: Faps | None = None  # (68,), FAP units; None before the first frame
    has_ended: bool = False


class PoseStore:
    """Keeps the newest FAPs of each session, and chooses the session to show.

    The shown session is the user's choice, a configured session, or the newest session. The user's
    choice is valid until that session closes, or until the user returns to the default.
    """

    def __init__(self, session: str = NEWEST, *, idle_motion: bool = False) -> None:
        self._configured = session
        self._switched_to = ""
        self._poses: dict[str, _Pose] = {}  # in order of opening
        self._rest = RestingFace(idle_motion=idle_motion)
        self._face = np.zeros(NUM_FAPS, np.float32)  # the last session frame that was shown
        self._weight, self._shown_s = 0.0, 0.0  # weight of the face in the picture, and its time

    @property
    def shown(self) -> str:
        """Name of the session that is shown; empty if no session is shown."""
        return self._switched_to or self._default

    @property
    def _default(self) -> str:
        if self._configured == NEWEST:
            return next(reversed(self._poses), "")
        return self._configured if self._configured in self._poses else ""

    def add(self, session: str, now_s: float) -> None:
        """Add a session."""
        self._poses[session] = _Pose(now_s)

    def remove(self, session: str) -> None:
        """Remove a session. Its face fades to rest unless another session replaces it."""
        if session == self._switched_to:
            self._switched_to = ""
        del self._poses[session]

    def update(self, session: str, faps: Faps, now_s: float) -> None:
        """Set a session's newest FAPs (68,)."""
        self._poses[session].faps = faps
        self._poses[session].updated_s = now_s

    def end(self, session: str) -> None:
        """Mark a session that will send no more frames."""
        self._poses[session].has_ended = True

    def switch(self, step: int) -> None:
        """Show the session that was opened after (step 1) or before (step -1) the current one."""
        names = list(self._poses)
        if names:
            start = names.index(self.shown) if self.shown else (-1 if step > 0 else 0)
            picked = names[(start + step) % len(names)]
            self._switched_to = "" if picked == self._default else picked

    def express(self, strengths: Mapping[str, float], hold_s: float) -> None:
        """Show expressions on the face at rest."""
        self._rest.express(strengths, hold_s)

    def is_stalled(self, now_s: float) -> bool:
        """Return whether the shown session has stopped sending frames."""
        pose = self._poses.get(self.shown)
        return pose is not None and not pose.has_ended and now_s - pose.updated_s > STALL_S

    def faps(self, now_s: float) -> Faps:
        """Return the FAPs (68,) to show. Without new frames, the face fades to rest.

        Times must not decrease.
        """
        pose = self._poses.get(self.shown)
        step = (now_s - self._shown_s) / FADE_S
        self._shown_s = now_s
        if pose is not None and pose.faps is not None and now_s - pose.updated_s <= STALL_S:
            self._face = pose.faps
            self._weight = min(self._weight + step, 1.0)
        else:
            self._weight = max(self._weight - step, 0.0)
        return self._rest.blend(self._face, self._weight, now_s)

    def caption(self, now_s: float) -> str:
        """Describe the shown session for the window title."""
        if not self.shown:
            return "" if self._configured == NEWEST else f"waiting for {self._configured}"
        names = list(self._poses)
        caption = self.shown
        if len(names) > 1:
            caption += f", {names.index(self.shown) + 1} of {len(names)} (Tab: next)"
        return f"{caption} (no frames)" if self.is_stalled(now_s) else caption
