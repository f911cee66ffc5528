"""Streaming Viterbi search over a loop of units.

Source: Li et al. 2011, section 2.2, eq. 1-3: after every feature frame the best unit string so
far; section 3.1: any unit may follow any unit. Token passing is Young, Russell and Thornton 1989.

Deviation: what a unit costs depends on the two units before it, so there is a best path for every
last unit and every unit before that one, a pair; pairs far behind the best one are given up (beam).

======== ==================================================== =====================
symbol   meaning                                              shape
======== ==================================================== =====================
score    log score of the best path that ends in a state,     (60 units, states)
         by the unit before the state's unit
top      the best of a pair's states                          (60 units, 60 units)
link     the record of the unit before                        (60 units, states)
record   (end, unit, before): a unit that ended there, and    (records, 3)
         the record of the unit before it
======== ==================================================== =====================

The string "so far" may change in the future, but not the past that all live paths share: that part
is settled from time to time and records that no path needs are dropped (partial traceback), so
endless speech needs no endless memory.
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
_IMPOSSIBLE = np.float32(-1e30)
_BEAM = np.float32(20.0)  # of log scores; twice as much changes nothing on development data
_MOST_ENDS = NUM_UNITS * NUM_UNITS  # records of one frame
_ROOM = 2 * _MOST_ENDS


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
        shape = (NUM_UNITS, NUM_UNITS, NUM_UNITS)
        self._log_next = np.ascontiguousarray(np.broadcast_to(topology.log_bigram, shape))
        self.reset()

    def reset(self) -> None:
        """Begin a new piece of speech at frame 0."""
        self.num_frames = 0
        self._settled: list[Segment] = []
        self._settled_until = _NO_RECORD  # the record that ends them
        self._best = (0, 0)  # unit before and state
        self._records = np.empty((_ROOM, 3), dtype=np.int32)
        self._num_records = 0
        self._top = np.full((NUM_UNITS, NUM_UNITS), _IMPOSSIBLE, dtype=np.float32)
        self._score = np.full((NUM_UNITS, self._topology.num_states), _IMPOSSIBLE, np.float32)
        self._link = np.full(self._score.shape, _NO_RECORD, dtype=np.int32)

    def accept(self, scores: NDArray[np.float32]) -> tuple[int, int, float]:
        """Take the state scores of one frame, shape (states,).

        Returns
        -------
        tuple
            Last unit of the best string so far, the frame where it began, and a confidence in
            0 to 1: the share, among the best paths of all pairs, of those in which the unit is
            the last or the one before.
        """
        if self._num_records + _MOST_ENDS > len(self._records):
            self._settle()
        topology = self._topology
        self._num_records, before, unit, state, confidence = _step(
            self.num_frames,
            scores,
            self._score,
            self._link,
            self._top,
            self._records,
            self._num_records,
            topology.first_state,
            topology.log_stay,
            topology.log_leave,
            self._log_next,
        )
        self.num_frames += 1
        self._best = (before, state)
        return unit, self._end(self._link[before, state]), confidence

    def path_since(self, frame: int) -> list[Segment]:
        """Units of the best string so far that end after a frame, without its last unit.

        They may still change; the first is cut to begin at the frame. Settled units before the
        frame are forgotten: they are not in later answers.
        """
        self._settled = segments_after(self._settled, frame)
        path = self._trace(int(self._link[self._best]))
        return [*self._settled, *segments_after(path, frame)]

    def _settle(self) -> None:
        """Take the units that no later frame can change; make room for new records."""
        live = self._score > _IMPOSSIBLE
        links = self._link[live]
        paths = _paths_through(links, self._records[: self._num_records, 2])
        shared = int(np.flatnonzero(paths == len(links)).max(initial=_NO_RECORD))
        self._settled += self._trace(shared)
        kept = np.flatnonzero(paths)
        kept = kept[kept >= shared]
        new = np.full(self._num_records + 1, _NO_RECORD, dtype=np.int32)  # the last: of no record
        new[kept] = np.arange(len(kept))
        records = np.empty((len(kept) + _ROOM, 3), dtype=np.int32)
        records[: len(kept)] = self._records[kept]
        records[: len(kept), 2] = new[records[: len(kept), 2]]
        self._records, self._num_records = records, len(kept)
        self._link[live] = new[links]
        self._settled_until = int(new[shared])

    def finish(self) -> list[Segment]:
        """End the speech: the best string of all frames."""
        if self.num_frames == 0:
            return []
        last_states = self._topology.first_state[1:] - 1
        ends = self._score[:, last_states] + self._topology.log_leave[last_states]
        before, unit = divmod(int(ends.argmax()), NUM_UNITS)
        link = int(self._link[before, last_states[unit]])
        last = Segment(unit, self._end(link), self.num_frames)
        return [*self._settled, *self._trace(link), last]

    def _trace(self, record: int) -> list[Segment]:
        """Units from the last settled record to this one."""
        segments: list[Segment] = []
        while record not in (_NO_RECORD, self._settled_until):
            end, unit, before = self._records[record].tolist()
            segments.append(Segment(unit, self._end(before), end))
            record = before
        return segments[::-1]

    def _end(self, record: int) -> int:
        """First frame after the unit of a record."""
        return 0 if record == _NO_RECORD else int(self._records[record, 0])


def segments_after(segments: list[Segment], frame: int) -> list[Segment]:
    """Segments that end after a frame; the first is cut to begin there."""
    return [
        Segment(segment.unit, max(segment.start, frame), segment.end)
        for segment in segments
        if segment.end > frame
    ]


@numba.njit(cache=True, nogil=True)
def _step(  # noqa: PLR0912, PLR0915 (one pass over the states; numba takes positions)
    frame: int,
    observed: NDArray[np.float32],
    score: NDArray[np.float32],
    link: NDArray[np.int32],
    top: NDArray[np.float32],
    records: NDArray[np.int32],
    num_records: int,
    first_state: NDArray[np.int64],
    log_stay: NDArray[np.float32],
    log_leave: NDArray[np.float32],
    log_next: NDArray[np.float32],
) -> tuple[int, int, int, int, float]:
    """Advance all paths by one frame; add records of the units that end before it.

    Returns
    -------
    tuple
        Number of records; of the best path the unit before the last, the last and its state; the
        confidence.
    """
    num_units = len(top)
    entry = np.full((num_units, num_units), _IMPOSSIBLE)  # into a unit (second) after a unit
    entry_link = np.full((num_units, num_units), np.int32(_NO_RECORD))
    if frame == 0:
        entry[_SIL] = log_next[_SIL, _SIL]
    for before in range(num_units):
        for unit in range(num_units):
            state = first_state[unit + 1] - 1
            leaving = score[before, state] + log_leave[state]
            if top[before, unit] < -_BEAM or leaving < -_BEAM:
                continue
            records[num_records, 0] = frame
            records[num_records, 1] = unit
            records[num_records, 2] = link[before, state]
            for following in range(num_units):
                candidate = leaving + log_next[before, unit, following]
                if candidate > entry[unit, following]:
                    entry[unit, following] = candidate
                    entry_link[unit, following] = num_records
            num_records += 1
    best, best_before, best_unit, best_state = _IMPOSSIBLE, 0, 0, 0
    for before in range(num_units):
        for unit in range(num_units):
            first, end = first_state[unit], first_state[unit + 1]
            if top[before, unit] < -_BEAM:
                if top[before, unit] > _IMPOSSIBLE:
                    score[before, first:end] = _IMPOSSIBLE
                    top[before, unit] = _IMPOSSIBLE
                if entry[before, unit] < -2 * _BEAM:
                    continue
            top[before, unit] = _IMPOSSIBLE
            for state in range(end - 1, first - 1, -1):
                value, from_link = score[before, state] + log_stay[state], link[before, state]
                if state > first:
                    moved = score[before, state - 1] + log_leave[state - 1]
                    moved_link = link[before, state - 1]
                else:
                    moved, moved_link = entry[before, unit], entry_link[before, unit]
                if moved > value:
                    value, from_link = moved, moved_link
                score[before, state] = max(value + observed[state], _IMPOSSIBLE)
                link[before, state] = from_link
                if score[before, state] > top[before, unit]:
                    top[before, unit] = score[before, state]
                    if top[before, unit] > best:
                        best = top[before, unit]
                        best_before, best_unit, best_state = before, unit, state
    share, total = 0.0, 0.0
    for before in range(num_units):
        for unit in range(num_units):
            if top[before, unit] > _IMPOSSIBLE:
                top[before, unit] -= best  # keeps numbers small in endless speech
                for state in range(first_state[unit], first_state[unit + 1]):
                    if score[before, state] > _IMPOSSIBLE:
                        score[before, state] -= best
                if top[before, unit] > -_BEAM:
                    total += np.exp(top[before, unit])
                    if best_unit in (before, unit):
                        share += np.exp(top[before, unit])
    return num_records, best_before, best_unit, best_state, share / total


@numba.njit(cache=True)
def _paths_through(links: NDArray[np.int32], before: NDArray[np.int32]) -> NDArray[np.int64]:
    """Count the paths, given by their links, that go through each record."""
    paths = np.zeros(len(before), dtype=np.int64)
    for link in links:
        if link != _NO_RECORD:
            paths[link] += 1
    for record in range(len(before) - 1, -1, -1):  # a record comes after the one before it
        if paths[record] and before[record] != _NO_RECORD:
            paths[before[record]] += paths[record]
    return paths
