"""What a fault does to a live face: how long it stood, what was lost, and how far it jumped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from corpora.scoring import count_errors
from evaluation.system.live import Seen
from shared.clock import MEDIA_RATE_HZ
from shared.face.faps import FAPS

UNSEEN = 1.0  # FAP units; a smaller step is none


@dataclass(frozen=True, slots=True, kw_only=True)
class Continuity:
    """Figures of one session against the same sound undisturbed."""

    stood_s: float  # longest time without a frame of a new media time, while sound came
    phones: int  # without the fault
    phones_lost: int
    phones_doubled: int
    phones_changed: int
    frames_lost: int
    frames_doubled: int  # whose media time had been shown before
    rest_frames: int  # that lead a silent client's face to rest; nobody was silent
    largest_step: float  # of all FAPs, each as a multiple of its largest step undisturbed
    largest_step_fap: str
    late_p50_ms: float  # after the sound that a frame needs was due
    late_p95_ms: float


def compare(seen: Seen, undisturbed: Seen, silence: str, delay_s: float) -> Continuity:
    """Compare what came with what comes of the same sound without a fault.

    Parameters
    ----------
    silence
        The phone that is no speech.
    delay_s
        How much later than its sound a frame is made.
    """
    arrived_s = np.array([arrival_s for arrival_s, _ in seen.frames])
    times = np.array([frame.media_time for _, frame in seen.frames], np.int64)
    newest = np.maximum.accumulate(np.concatenate([[-1], times]))[:-1]  # before each frame
    is_new = times > newest
    is_rest = np.diff(times, prepend=-1) == 0
    errors = count_errors(
        *([phone.symbol for phone in each.final_phones(silence)] for each in (undisturbed, seen))
    )
    due_s = seen.begin_s + delay_s + times / MEDIA_RATE_HZ
    is_live = is_new & (arrived_s < seen.live_until_s)
    late_s = (arrived_s - due_s)[is_live]
    steps = largest_steps(seen.faps)
    ratios = steps / np.maximum(largest_steps(undisturbed.faps), UNSEEN)
    return Continuity(
        stood_s=float(np.diff([seen.begin_s, *arrived_s[is_live], seen.live_until_s]).max()),
        phones=errors.reference,
        phones_lost=errors.deletions,
        phones_doubled=errors.insertions,
        phones_changed=errors.substitutions,
        frames_lost=len({frame.media_time for _, frame in undisturbed.frames} - {*times.tolist()}),
        frames_doubled=int((~is_new & ~is_rest).sum()),
        rest_frames=int((is_rest & (arrived_s < seen.live_until_s)).sum()),
        largest_step=float(ratios.max()),
        largest_step_fap=FAPS[int(ratios.argmax())].name,
        late_p50_ms=float(np.percentile(late_s, 50)) * 1e3,
        late_p95_ms=float(np.percentile(late_s, 95)) * 1e3,
    )


def largest_steps(faps: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the largest change of each FAP from one frame to the next, of shape (68,)."""
    steps: NDArray[np.float32] = np.abs(np.diff(faps, axis=0)).max(axis=0)
    return steps


def staleness(
    followed: Sequence[tuple[float, int]], seen: Seen, since_s: float
) -> NDArray[np.float64]:
    """Return how old frames were when another subscriber got them, in seconds.

    Parameters
    ----------
    followed
        Arrival and media time at that subscriber.
    seen
        What came in time.
    since_s
        Arrivals before this do not count.
    """
    in_time_s = {frame.media_time: arrival_s for arrival_s, frame in reversed(seen.frames)}
    return np.array(
        [
            arrival_s - in_time_s[media_time]
            for arrival_s, media_time in followed
            if arrival_s >= since_s and media_time in in_time_s
        ]
    )
