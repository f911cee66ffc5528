"""Streaming Viterbi search over a loop of units.

Source: Li et al. 2011, section 2.2, eq. 1-3: after every feature frame the best unit string so
far; section 3.1: any unit may follow any unit. Token passing is Young, Russell and Thornton 1989.

======== ==================================================== ==============
symbol   meaning                                              shape
======== ==================================================== ==============
score    log score of the best path that ends in a state      (states,)
link     where that path's last unit began, as a record       (states,)
record   (frame, unit): a unit that ended there, and the      (frames, 60)
         record before it
======== ==================================================== ==============

The string "so far" may change in the future, but not the past that all live paths share: that part
is settled from time to time and its records are dropped (partial traceback), so endless speech
needs no endless memory.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import Topology
from shared.phones import UNIT_INDEX, UNITS

NUM_UNITS = len(UNITS)
_SIL = UNIT_INDEX["sil"]
_NO_RECORD = -1
_IMPOSSIBLE = -1e30
_ROOM_FRAMES = 256


@dataclass(frozen=True, slots=True)
class Segment:
    """One unit of the best string, in feature frames of the decoder."""

    unit: int  # index into shared.phones.UNITS
    start: int  # first frame
    end: int  # one past the last frame


class Decoder:
    """Viterbi search, one frame at a time.

    Parameters
    ----------
    topology
        The units' HMMs and what it costs to go from one to the next.
    """

    def __init__(self, topology: Topology) -> None:
        self._topology = topology
        self._arcs = np.ascontiguousarray(topology.log_bigram.T)  # (to, from)
        self.reset()

    def reset(self) -> None:
        """Begin a new piece of speech at frame 0."""
        self._frame = 0
        self._settled: list[Segment] = []
        self._settled_until = _NO_RECORD  # the record that ends them
        self._best_state = 0
        self._base = 0  # frame of the first row of records
        self._records = np.full((_ROOM_FRAMES, NUM_UNITS), _NO_RECORD, dtype=np.int64)
        self._score = np.full(self._topology.num_states, _IMPOSSIBLE, dtype=np.float32)
        self._link = np.full(self._topology.num_states, _NO_RECORD, dtype=np.int64)

    def accept(self, scores: NDArray[np.float32]) -> tuple[int, int, float]:
        """Take the state scores of one frame, shape (states,).

        Returns
        -------
        tuple
            Last unit of the best string so far, the frame where it began, and a confidence in
            0 to 1 (share of the unit among all units' best paths).
        """
        if self._frame - self._base == len(self._records):
            self._settle()
        row = self._frame - self._base
        topology = self._topology
        unit, state, confidence = _step(
            self._frame,
            scores,
            self._score,
            self._link,
            self._records[row],
            topology.first_state,
            topology.log_stay,
            topology.log_leave,
            self._arcs,
        )
        self._frame += 1
        self._best_state = state
        return unit, _frame_after(self._link[state]), confidence

    def path_since(self, frame: int) -> list[Segment]:
        """Units of the best string so far that end after a frame, without its last unit.

        They may still change; the first is cut to begin at the frame. Settled units before the
        frame are forgotten: they are not in later answers.
        """
        self._settled = segments_after(self._settled, frame)
        path = self._trace(int(self._link[self._best_state]))
        return [*self._settled, *segments_after(path, frame)]

    def _settle(self) -> None:
        """Take the units that no later frame can change; make room for new records."""
        shared = _common_record(self._link, self._records, self._base)
        self._settled += self._trace(shared)
        self._settled_until = shared
        if shared != _NO_RECORD:
            row = shared // NUM_UNITS - self._base
            self._records, self._base = self._records[row:], self._base + row
        room = np.full((_ROOM_FRAMES, NUM_UNITS), _NO_RECORD, dtype=np.int64)
        self._records = np.concatenate([self._records, room])

    def finish(self) -> list[Segment]:
        """End the speech: the best string of all frames."""
        if self._frame == 0:
            return []
        last_states = self._topology.first_state[1:] - 1
        ends = self._score[last_states] + self._topology.log_leave[last_states]
        unit = int(ends.argmax())
        link = int(self._link[last_states[unit]])
        return [*self._settled, *self._trace(link), Segment(unit, _frame_after(link), self._frame)]

    def _trace(self, record: int) -> list[Segment]:
        """Units from the last settled record to this one."""
        segments: list[Segment] = []
        while record not in (_NO_RECORD, self._settled_until):
            frame, unit = divmod(record, NUM_UNITS)
            before = int(self._records[frame - self._base, unit])
            segments.append(Segment(unit, _frame_after(before), frame + 1))
            record = before
        return segments[::-1]


def segments_after(segments: list[Segment], frame: int) -> list[Segment]:
    """Segments that end after a frame; the first is cut to begin there."""
    return [
        Segment(segment.unit, max(segment.start, frame), segment.end)
        for segment in segments
        if segment.end > frame
    ]


def _frame_after(record: int) -> int:
    """First frame after the unit that a record ends."""
    return 0 if record == _NO_RECORD else int(record) // NUM_UNITS + 1


@numba.njit(cache=True, nogil=True)
def _step(  # noqa: PLR0912 (one pass over the states; numba takes positions)
    frame: int,
    observed: NDArray[np.float32],
    score: NDArray[np.float32],
    link: NDArray[np.int64],
    records: NDArray[np.int64],
    first_state: NDArray[np.int64],
    log_stay: NDArray[np.float32],
    log_leave: NDArray[np.float32],
    arcs: NDArray[np.float32],
) -> tuple[int, int, float]:
    """Advance all paths by one frame; return the best unit, its best state and a confidence.

    ``records`` is the row of this frame: it receives, per unit, the record before the unit if the
    unit ends here.
    """
    num_units = len(first_state) - 1
    leaving = np.empty(num_units, dtype=np.float32)
    for unit in range(num_units):
        last = first_state[unit + 1] - 1
        leaving[unit] = score[last] + log_leave[last]
    best_unit, best_state, best = 0, 0, np.float32(-np.inf)
    unit_best = np.empty(num_units, dtype=np.float32)
    for unit in range(num_units):
        if frame == 0:
            entry, entry_link = arcs[unit, _SIL], _NO_RECORD
        else:
            before = 0
            entry = np.float32(-np.inf)
            for other in range(num_units):
                candidate = leaving[other] + arcs[unit, other]
                if candidate > entry:
                    entry, before = candidate, other
            entry_link = (frame - 1) * num_units + before
        first, end = first_state[unit], first_state[unit + 1]
        top = np.float32(-np.inf)
        for state in range(end - 1, first - 1, -1):
            value, from_link = score[state] + log_stay[state], link[state]
            if state > first:
                moved, moved_link = score[state - 1] + log_leave[state - 1], link[state - 1]
            else:
                moved, moved_link = entry, entry_link
            if moved > value:
                value, from_link = moved, moved_link
            score[state] = value + observed[state]
            link[state] = from_link
            if score[state] > top:
                top = score[state]
                if top > best:
                    best, best_unit, best_state = top, unit, state
        unit_best[unit] = top
        records[unit] = link[end - 1]
    total = 0.0
    for unit in range(num_units):
        total += np.exp(unit_best[unit] - best)
    for state in range(len(score)):  # keep numbers small in endless speech
        score[state] -= best
        score[state] = max(score[state], np.float32(_IMPOSSIBLE))
    return best_unit, best_state, 1.0 / total


@numba.njit(cache=True)
def _common_record(links: NDArray[np.int64], records: NDArray[np.int64], base: int) -> int:
    """Newest record that every path goes through, or -1."""
    paths = np.unique(links)
    while len(paths) > 1:
        newest = paths[-1]
        row = newest // NUM_UNITS - base
        if newest < 0 or row < 0:
            return _NO_RECORD
        paths[-1] = records[row, newest % NUM_UNITS]
        paths = np.unique(paths)
    return int(paths[0])
