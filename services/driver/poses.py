"""One pose for every session that is followed, and which of them is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shared.face.faps import NUM_FAPS

NEWEST = "newest"
STALL_S = 1.0  # a face goes to rest after so long without frames
FADE_S = 0.3  # time it takes to get there

Faps = NDArray[np.float32]


@dataclass(slots=True)
class _Pose:
    faps: Faps  # (68,), FAP units
    updated_s: float
    has_ended: bool = False


class Poses:
    """The newest FAPs of each session; shows the newest session, a named one, or the user's choice.

    What the user switches to is shown until it closes, or until the user is back at the session
    that would be shown anyway.

    Parameters
    ----------
    session
        Name of the session to show; ``newest`` for the one that was opened last.
    """

    def __init__(self, session: str = NEWEST) -> None:
        self._configured = session
        self._switched_to = ""
        self._poses: dict[str, _Pose] = {}  # in the order in which the sessions were opened
        self._last = _Pose(np.zeros(NUM_FAPS, np.float32), 0.0)  # the pose that was shown last

    @property
    def shown(self) -> str:
        """Name of the session that is shown; empty if there is none."""
        return self._switched_to or self._default

    @property
    def _default(self) -> str:
        if self._configured == NEWEST:
            return next(reversed(self._poses), "")
        return self._configured if self._configured in self._poses else ""

    def add(self, session: str, now_s: float) -> None:
        """Take a session in, with its face at rest."""
        self._poses[session] = _Pose(np.zeros(NUM_FAPS, np.float32), now_s)

    def remove(self, session: str) -> None:
        """Forget a session; if no other takes its place its face fades to rest."""
        if session == self.shown:
            self._last = self._poses[session]
        if session == self._switched_to:
            self._switched_to = ""
        del self._poses[session]

    def accept_frame(self, session: str, faps: Faps, now_s: float) -> None:
        """Take a session's newest FAPs, shape ``(68,)``, FAP units."""
        self._poses[session].faps = faps
        self._poses[session].updated_s = now_s

    def end(self, session: str) -> None:
        """Expect no more frames of a session."""
        self._poses[session].has_ended = True

    def switch(self, step: int) -> None:
        """Show the session that was opened after (1) or before (-1) the one that is shown."""
        names = list(self._poses)
        if names:
            start = names.index(self.shown) if self.shown else (-1 if step > 0 else 0)
            picked = names[(start + step) % len(names)]
            self._switched_to = "" if picked == self._default else picked

    def is_stalled(self, now_s: float) -> bool:
        """Return whether frames of the shown session are missing."""
        pose = self._poses.get(self.shown)
        return pose is not None and not pose.has_ended and now_s - pose.updated_s > STALL_S

    def faps(self, now_s: float) -> Faps:
        """Return the FAPs (68,) to show: the newest, or while none come a fade to rest."""
        pose = self._poses.get(self.shown, self._last)
        silent_s = now_s - pose.updated_s
        weight = np.float32(np.clip(1.0 - (silent_s - STALL_S) / FADE_S, 0.0, 1.0))
        return pose.faps * weight

    def caption(self, now_s: float) -> str:
        """Say which session is shown, and what is to be known about it."""
        if not self.shown:
            return "" if self._configured == NEWEST else f"waiting for {self._configured}"
        names = list(self._poses)
        caption = self.shown
        if len(names) > 1:
            caption += f", {names.index(self.shown) + 1} of {len(names)} (Tab: the next)"
        return f"{caption} (no frames come)" if self.is_stalled(now_s) else caption
