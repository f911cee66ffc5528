"""Streaming Viterbi search over a loop of units.

Source: Li et al. 2011, section 2.2, eq. 1-3: after every feature frame the best unit string so
far; section 3.1: any unit may follow any unit. Token passing is Young, Russell and Thornton 1989.

Deviation: what a unit costs depends on the units before it, as many as the language knows. So
there is a best path, a token, for every such context, with the unit being said as its last; tokens
far behind the best one are given up (beam).

======== ===================================================== =====================
symbol   meaning                                               shape
======== ===================================================== =====================
score    log score of the best path that ends in a state       (tokens, states)
top      the best of a token's states                          (tokens,)
link     the record of the unit before                         (tokens, states)
record   (end, unit, before): a unit that ended there, and     (records, 3)
         the record of the unit before it
======== ===================================================== =====================

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
from services.recognizer.unit_language import MOST_UNITS
from shared.phones import UNIT_INDEX

_SIL = UNIT_INDEX["sil"]
_NO_RECORD = -1
_NOWHERE = -1
_IMPOSSIBLE = np.float32(-1e30)
_BEAM = np.float32(20.0)  # of log scores; more changes nothing on development data
_MOST_TOKENS = 4096  # more than speech ever needs; without sense in the sound there might be more
_ROOM = 4 * _MOST_TOKENS  # records
_MOST_CHAIN = MOST_UNITS + 1  # contexts from the longest to the empty one


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
        self._graph = topology.language.graph
        self._most_states = int(np.diff(topology.first_state).max())
        self.reset()

    def reset(self) -> None:
        """Begin a new piece of speech at frame 0."""
        self.num_frames = 0
        self._settled: list[Segment] = []
        self._settled_until = _NO_RECORD  # the record that ends them
        self._best = (0, 0)  # token and state of its unit
        self._records = np.empty((_ROOM, 3), dtype=np.int32)
        self._num_records = 0
        self._context = np.zeros(_MOST_TOKENS, dtype=np.int32)  # of each token
        self._token_of = np.full(len(self._graph.last_unit), _NOWHERE, dtype=np.int16)
        self._num_tokens = 0
        self._top = np.full(_MOST_TOKENS, _IMPOSSIBLE, dtype=np.float32)
        self._score = np.full((_MOST_TOKENS, self._most_states), _IMPOSSIBLE, dtype=np.float32)
        self._link = np.full(self._score.shape, _NO_RECORD, dtype=np.int32)

    def accept(self, scores: NDArray[np.float32]) -> tuple[int, int, float]:
        """Take the state scores of one frame, shape (states,).

        Returns
        -------
        tuple
            Last unit of the best string so far, the frame where it began, and a confidence in
            0 to 1: the share, among the best paths of all contexts, of those in which the unit is
            the last or the one before.
        """
        if self._num_records + _MOST_TOKENS > len(self._records):
            self._settle()
        topology, graph = self._topology, self._graph
        self._num_tokens, self._num_records, token, state, confidence = _step(
            self.num_frames,
            scores,
            self._num_tokens,
            self._context,
            self._token_of,
            self._top,
            self._score,
            self._link,
            self._records,
            self._num_records,
            topology.first_state,
            topology.log_stay,
            topology.log_leave,
            np.float32(topology.language_scale),
            np.float32(topology.unit_penalty),
            graph.first_arc,
            graph.arc_unit,
            graph.arc_log_share,
            graph.arc_context,
            graph.shorter,
            graph.log_back_off,
            graph.last_unit,
        )
        self.num_frames += 1
        self._best = (token, state)
        unit = int(graph.last_unit[self._context[token]])
        return unit, self._end(self._link[token, state]), confidence

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
        live = self._score[: self._num_tokens] > _IMPOSSIBLE
        links = self._link[: self._num_tokens][live]
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
        self._link[: self._num_tokens][live] = new[links]
        self._settled_until = int(new[shared])

    def finish(self) -> list[Segment]:
        """End the speech: the best string of all frames."""
        if self.num_frames == 0:
            return []
        tokens = np.arange(self._num_tokens)
        units = self._graph.last_unit[self._context[tokens]].astype(np.int64)
        first, end = self._topology.first_state[units], self._topology.first_state[units + 1]
        ends = self._score[tokens, end - first - 1] + self._topology.log_leave[end - 1]
        best = int(ends.argmax())
        state = int((end - first - 1)[best])
        if ends[best] <= _IMPOSSIBLE:  # no unit has come to its last state
            best, state = self._best
        link = int(self._link[best, state])
        last = Segment(int(units[best]), self._end(link), self.num_frames)
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
def _step(  # noqa: PLR0912, PLR0915 (one pass over the tokens; numba takes positions)
    frame: int,
    observed: NDArray[np.float32],
    num_tokens: int,
    context: NDArray[np.int32],
    token_of: NDArray[np.int16],
    top: NDArray[np.float32],
    score: NDArray[np.float32],
    link: NDArray[np.int32],
    records: NDArray[np.int32],
    num_records: int,
    first_state: NDArray[np.int64],
    log_stay: NDArray[np.float32],
    log_leave: NDArray[np.float32],
    scale: np.float32,
    penalty: np.float32,
    first_arc: NDArray[np.int32],
    arc_unit: NDArray[np.uint8],
    arc_log_share: NDArray[np.float32],
    arc_context: NDArray[np.int32],
    shorter: NDArray[np.int32],
    log_back_off: NDArray[np.float32],
    last_unit: NDArray[np.uint8],
) -> tuple[int, int, int, int, float]:
    """Advance all paths by one frame; add records of the units that end before it.

    Returns
    -------
    tuple
        Numbers of tokens and of records; the best token and state of its unit; the confidence.
    """
    num_units, most_tokens, most_states = len(first_state) - 1, len(context), score.shape[1]
    token = 0
    while token < num_tokens:  # the last token takes the place of one that is given up
        if top[token] >= -_BEAM:
            token += 1
            continue
        token_of[context[token]] = _NOWHERE
        num_tokens -= 1
        if token < num_tokens:
            context[token], top[token] = context[num_tokens], top[num_tokens]
            score[token], link[token] = score[num_tokens], link[num_tokens]
            token_of[context[token]] = token
    entry = np.full(most_tokens, _IMPOSSIBLE)
    entry_link = np.full(most_tokens, np.int32(_NO_RECORD))
    log_share = np.empty(num_units, np.float32)
    next_context = np.empty(num_units, np.int32)
    chain = np.empty(_MOST_CHAIN, np.int32)
    for token in range(num_tokens if frame else 1):
        if frame:
            here = context[token]
            unit = last_unit[here]
            last = first_state[unit + 1] - first_state[unit] - 1
            leaving = score[token, last] + log_leave[first_state[unit + 1] - 1]
            if leaving < -_BEAM:
                continue
            record = num_records
            records[record, 0] = frame
            records[record, 1] = unit
            records[record, 2] = link[token, last]
            num_records += 1
        else:  # as after a pause
            here, leaving, record = arc_context[_SIL], np.float32(0.0), _NO_RECORD
        length = 0
        while True:
            chain[length] = here
            length += 1
            if here == 0:
                break
            here = shorter[here]
        for place in range(length - 1, -1, -1):  # what a longer context knows replaces the rest
            here = chain[place]
            log_share += log_back_off[here] if here else np.float32(0.0)
            for arc in range(first_arc[here], first_arc[here + 1]):
                log_share[arc_unit[arc]] = arc_log_share[arc]
                next_context[arc_unit[arc]] = arc_context[arc]
        if frame == 0:  # before speech there is silence
            log_share[_SIL] = 0.0
        for unit in range(num_units):
            candidate = leaving + scale * log_share[unit] + penalty
            if candidate < -_BEAM:
                continue
            following = token_of[next_context[unit]]
            if following == _NOWHERE:
                if num_tokens == most_tokens:
                    continue
                following = num_tokens
                num_tokens += 1
                context[following], token_of[next_context[unit]] = next_context[unit], following
                score[following], link[following] = _IMPOSSIBLE, _NO_RECORD
            if candidate > entry[following]:
                entry[following] = candidate
                entry_link[following] = record
    best, best_token, best_state = _IMPOSSIBLE, 0, 0
    for token in range(num_tokens):
        unit = last_unit[context[token]]
        first = first_state[unit]
        top[token] = _IMPOSSIBLE
        for state in range(first_state[unit + 1] - first - 1, -1, -1):
            value, from_link = score[token, state] + log_stay[first + state], link[token, state]
            if state:
                moved = score[token, state - 1] + log_leave[first + state - 1]
                moved_link = link[token, state - 1]
            else:
                moved, moved_link = entry[token], entry_link[token]
            if moved > value:
                value, from_link = moved, moved_link
            score[token, state] = max(value + observed[first + state], _IMPOSSIBLE)
            link[token, state] = from_link
            if score[token, state] > top[token]:
                top[token] = score[token, state]
                if top[token] > best:
                    best, best_token, best_state = top[token], token, state
    best_unit = last_unit[context[best_token]]
    share, total = 0.0, 0.0
    for token in range(num_tokens):
        before = _NO_RECORD
        for state in range(most_states):
            if score[token, state] == top[token]:
                before = link[token, state]
            if score[token, state] > _IMPOSSIBLE:
                score[token, state] -= best  # keeps numbers small in endless speech
        top[token] -= best
        if top[token] > -_BEAM:
            total += np.exp(top[token])
            if last_unit[context[token]] == best_unit or (
                before != _NO_RECORD and records[before, 1] == best_unit
            ):
                share += np.exp(top[token])
    return num_tokens, num_records, best_token, best_state, share / total


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
