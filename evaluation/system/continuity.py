"""Effects of a fault on a live face: how long it stopped, what was lost, how far it jumped."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from kouxing.corpora.scoring import count_errors
from kouxing.evaluation.system.live import ReceivedResults
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.clock import MEDIA_RATE_HZ

MIN_STEP = 1.0  # FAP units; a smaller step is invisible
LATE_S = 0.06  # a frame is late if it arrives more than this after its audio
ON_TIME_S = 1.0  # frames are on time again after this time without late frames


@dataclass(frozen=True, slots=True, kw_only=True)
class Continuity:
    """One session compared with the same audio without a fault."""

    stood_s: float  # longest time without a new frame while there was audio
    late_s: float  # after the fault, until frames were on time again
    phones: int  # without the fault
    phones_lost: int
    phones_doubled: int
    phones_changed: int
    frames_lost: int
    frames_doubled: int  # frames whose media time had been received before
    largest_step: float  # maximum over all FAPs, relative to the largest step without a fault
    late_p95_ms: float  # after the audio of a frame was due


def compare(
    received: ReceivedResults, undisturbed: ReceivedResults, delay_s: float, *, fault_s: float
) -> Continuity:
    """Compare results with a fault at ``fault_s`` with those without; ``delay_s`` is the face's."""
    arrived_s = np.array([arrival_s for arrival_s, _ in received.frames])
    times = np.array([frame.media_time for _, frame in received.frames], np.int64)
    newest = np.maximum.accumulate(np.concatenate([[-1], times]))[:-1]  # before each frame
    is_new = times > newest
    is_rest = np.diff(times, prepend=-1) == 0  # frames of a silent client
    reference, recognized = (
        [phone.symbol for phone in record.spoken_phones()] for record in (undisturbed, received)
    )
    errors = count_errors(reference, recognized)
    due_s = received.start_s + delay_s + times / MEDIA_RATE_HZ
    is_live = is_new & (arrived_s < received.live_until_s)
    late_s = (arrived_s - due_s)[is_live]
    steps = largest_steps(received.faps)
    ratios = steps / np.maximum(largest_steps(undisturbed.faps), MIN_STEP)
    return Continuity(
        stood_s=float(
            np.diff([received.start_s, *arrived_s[is_live], received.live_until_s]).max()
        ),
        late_s=_late_until_s(due_s[is_live], late_s, fault_s) - fault_s,
        phones=errors.reference,
        phones_lost=errors.deletions,
        phones_doubled=errors.insertions,
        phones_changed=errors.substitutions,
        frames_lost=len({frame.media_time for _, frame in undisturbed.frames} - {*times.tolist()}),
        frames_doubled=int((~is_new & ~is_rest).sum()),
        largest_step=float(ratios.max()),
        late_p95_ms=float(np.percentile(late_s, 95)) * 1e3,
    )


def worst(faces: Sequence[Continuity]) -> Continuity:
    """Return the worst value of each figure of several sessions."""
    names = [field.name for field in fields(Continuity)]
    return Continuity(**{name: max(getattr(face, name) for face in faces) for name in names})


def _late_until_s(due_s: Doubles, late_s: Doubles, fault_s: float) -> float:
    """Return when the last frame arrived that the fault made late."""
    until_s = fault_s
    for due, late in sorted(zip(due_s, late_s, strict=True)):
        if due > until_s + ON_TIME_S:
            break
        if late > LATE_S:
            until_s = max(until_s, float(due + late))
    return until_s


def largest_steps(faps: Floats) -> Floats:
    """Return the largest change of each FAP from one frame to the next, shape (68,)."""
    steps: Floats = np.abs(np.diff(faps, axis=0)).max(axis=0)
    return steps
