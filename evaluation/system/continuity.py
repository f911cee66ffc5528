"""What a fault does to a live face: how long it stood, what was lost, and how far it jumped."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.scoring import count_errors
from kouxing.evaluation.system.live import Seen
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.face.faps import FAPS

UNSEEN = 1.0  # FAP units; a smaller step is none
LATE_S = 0.06  # after the sound that a frame needs; one that comes later is not in time
CALM_S = 1.0  # in which no frame is late: then all are in time again


@dataclass(frozen=True, slots=True, kw_only=True)
class Continuity:
    """Figures of one session against the same sound undisturbed."""

    stood_s: float  # longest time without a frame of a new media time, while sound came
    late_s: float  # after the fault, until frames were in time again
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


def compare(
    seen: Seen, undisturbed: Seen, silence: str, delay_s: float, *, fault_s: float
) -> Continuity:
    """Compare what came with what comes of the same sound without a fault.

    Parameters
    ----------
    silence
        The phone that is no speech.
    delay_s
        How much later than its sound a frame is made.
    fault_s
        When it happened.
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
        late_s=_late_until_s(due_s[is_live], late_s, fault_s) - fault_s,
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


def worst(faces: Sequence[Continuity]) -> Continuity:
    """Return the worst of each figure of several sessions with the same sound."""
    largest = max(faces, key=lambda face: face.largest_step)
    numbers = {each.name for each in fields(Continuity)} - {"largest_step_fap"}
    return replace(
        largest, **{name: max(getattr(face, name) for face in faces) for name in numbers}
    )


def _late_until_s(due_s: NDArray[np.float64], late_s: NDArray[np.float64], fault_s: float) -> float:
    """Return when the last of the frames came that a fault has made late."""
    until_s = fault_s
    for due, late in sorted(zip(due_s, late_s, strict=True)):
        if due > until_s + CALM_S:
            break
        if late > LATE_S:
            until_s = max(until_s, float(due + late))
    return until_s


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
