"""One pose for every session that is followed, and which of them is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.idle_motion import RestingFace

NEWEST = "newest"
STALL_S = 1.0  # a face goes to rest after so long without frames
FADE_S = 0.3  # time it takes to get there, and to come back

Faps = NDArray[np.float32]


@dataclass(slots=True)
class _Pose:
    updated_s: float  # when the newest frame came, or the session was opened
    faps: Faps | None = None  # (68,), FAP units; None: no frame has come
    has_ended: bool = False


class Poses:
    """The newest FAPs of each session; shows the newest session, a named one, or the user's choice.

    What the user switches to is shown until it closes, or until the user is back at the session
    that would be shown anyway.

    Parameters
    ----------
    session
        Name of the session to show; ``newest`` for the one that was opened last.
    idle_motion_seed
        Of the face at rest; 0: it stands still.
    """

    def __init__(self, session: str = NEWEST, idle_motion_seed: int = 0) -> None:
        self._configured = session
        self._switched_to = ""
        self._poses: dict[str, _Pose] = {}  # in the order in which the sessions were opened
        self._rest = RestingFace(idle_motion_seed)
        self._face = np.zeros(NUM_FAPS, np.float32)  # of a session, that was shown last,
        self._share, self._shown_s = 0.0, 0.0  # its share, and when that was

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
        """Take a session in, whose frames are to come."""
        self._poses[session] = _Pose(now_s)

    def remove(self, session: str) -> None:
        """Forget a session; if no other takes its place its face fades to rest."""
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
        """Return the FAPs (68,) to show: the newest, or while none come a fade to rest.

        Times must not decrease.
        """
        pose = self._poses.get(self.shown)
        step = (now_s - self._shown_s) / FADE_S
        self._shown_s = now_s
        if pose is not None and pose.faps is not None and now_s - pose.updated_s <= STALL_S:
            self._face = pose.faps
            self._share = min(self._share + step, 1.0)
        else:
            self._share = max(self._share - step, 0.0)
        rest = self._rest.at(now_s)
        return rest + np.float32(self._share) * (self._face - rest)

    def caption(self, now_s: float) -> str:
        """Say which session is shown, and what is to be known about it."""
        if not self.shown:
            return "" if self._configured == NEWEST else f"waiting for {self._configured}"
        names = list(self._poses)
        caption = self.shown
        if len(names) > 1:
            caption += f", {names.index(self.shown) + 1} of {len(names)} (Tab: the next)"
        return f"{caption} (no frames come)" if self.is_stalled(now_s) else caption
