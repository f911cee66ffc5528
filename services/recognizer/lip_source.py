"""What the recognizer needs from a model of lips that works on the sound itself.

It is told what the acoustic network computes at every position, 50 times a second while somebody
speaks, and makes lip frames of it. A model offers several delays; the recognizer asks for one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.phones.events import LipFrame

# Frames of the face are due every 20 ms of sound, and the network's positions end this long before:
# a window of 25 ms in steps of 20 ms can come no closer.
POSITION_LAG_S = 0.005


class LipFrameStream(Protocol):
    """The lips of one session, from one segment of speech to the next."""

    def accept(
        self,
        known_s: float,
        frames: NDArray[np.float32],
        values: NDArray[np.float32],
    ) -> list[LipFrame]:
        """Take what the network computes at a position; return the lip frames that follow.

        Parameters
        ----------
        known_s
            Media time of the last sample that the position has seen, seconds.
        frames
            Its two newest log-mel frames, shape (2, 80).
        values
            Of its layers, shape (layers, heads, size).
        """

    def reset(self) -> None:
        """Forget the segment; the next speech starts a new one."""


class LipsFromSound(Protocol):
    """A trained model, shared by any number of streams."""

    @property
    def delays_s(self) -> Sequence[float]:
        """Delays that it offers, seconds, rising."""

    def stream(self, delays_s: Sequence[float]) -> LipFrameStream:
        """Start a session's lips with these of the delays."""

    def with_mouth_profile(self, content: bytes) -> Self:
        """Adapt the model to the speaker of a mouth profile; ``UserError`` if it does not fit."""


def delay_for(delays_s: Sequence[float], face_delay_s: float) -> float:
    """Choose the longest delay whose lip frames come before a face that is due.

    Parameters
    ----------
    delays_s
        Delays of the lips to choose from, seconds, rising; one below 0 is a forecast.
    face_delay_s
        How much later than its sound a frame of the face is made.
    """
    in_time = [each for each in delays_s if each + POSITION_LAG_S <= face_delay_s + 1e-6]
    return max(in_time, default=min(delays_s))
