"""Forced alignment: the best path of known phones through a recording, with optional pauses.

Source: the HTK book (Young et al. 2009), chapter 8; used in Li et al. 2011, section 3.2, scheme 1.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TypeAlias

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.search.decoder import PathSegment
from kouxing.shared.arrays import Doubles, Floats, Integers

# scores of its frames, and columns, stay, leave and skip of its nodes
_BlockInputs: TypeAlias = tuple[Floats, Integers, Doubles, Doubles, Doubles]
MAX_BAND_NODES = 2**15  # 14 minutes of fluent speech


@dataclass(slots=True, kw_only=True)
class UtteranceGraph:
    """The states of an utterance in order. Pauses are optional."""

    states: Integers  # (nodes,) HMM state of each node
    skip_from: Integers  # (nodes,) node before an optional pause, or -1
    phone_number: Integers  # (nodes,) running number of the phone, pauses included
    phones: Integers  # (running numbers,) indices into the inventory's phones
    num_last: int  # number of nodes of the last pause, which is optional too

    @property
    def num_needed(self) -> Integers:
        """Number of frames from each node to the end of the last phone, (nodes,)."""
        is_phone = self.phones[self.phone_number] != self.phones[0]
        return np.cumsum(is_phone[::-1])[::-1]


def build_utterance_graph(
    phones: Sequence[int], syllables: Sequence[int], first_state: Integers, *, silence: int
) -> UtteranceGraph:
    """Lay out the states of an utterance, with an optional pause at each syllable boundary.

    ``phones`` are indices into the inventory's phones, and ``syllables`` the number of phones in
    each syllable. ``first_state`` comes from ``Topology``.
    """
    states: list[int] = []
    skip_from: list[int] = []
    phone_number: list[int] = []
    numbered: list[int] = []

    def add(phone: int, before_pause: int) -> None:
        first, end = int(first_state[phone]), int(first_state[phone + 1])
        for state in range(first, end):
            skip_from.append(before_pause if state == first else -1)
            states.append(state)
            phone_number.append(len(numbered))
        numbered.append(phone)

    add(silence, -1)
    before_pause = -1  # last node before a pause
    rest = iter(phones)
    for length in syllables:
        for phone in islice(rest, length):
            add(phone, before_pause)
            before_pause = -1
        before_pause = len(states) - 1
        add(silence, -1)
    return UtteranceGraph(
        states=np.array(states),
        skip_from=np.array(skip_from),
        phone_number=np.array(phone_number),
        phones=np.array(numbered),
        num_last=int(first_state[silence + 1] - first_state[silence]),
    )


def viterbi_path(
    scores: Floats, columns: Integers, graph: UtteranceGraph, log_stay: Floats, log_leave: Floats
) -> tuple[Integers, float]:
    """Find the best path through a graph.

    ``scores`` (frames, columns) are the scores of the frames, and ``columns`` (nodes,) has the
    column of each node; ``log_stay`` and ``log_leave`` are those of ``Topology``. Returns the node
    of every frame, (frames,), and the path's log-likelihood. With too few frames, the path is empty
    and the log-likelihood minus infinity.

    Memory grows with the square root of the number of frames: only some rows of scores are kept,
    and each block between two of them is computed again to trace the path (Hirschberg 1975). A
    graph of more than ``MAX_BAND_NODES`` nodes is searched in a band around the best node.
    """
    num_frames, num_nodes = len(scores), len(graph.states)
    num_needed = graph.num_needed
    if num_frames < num_needed[0]:
        return np.empty(0, dtype=np.int64), -np.inf
    stay = log_stay[graph.states].astype(np.float64)
    leave = log_leave[graph.states].astype(np.float64)
    skip = np.where(graph.skip_from >= 0, leave[graph.skip_from], -np.inf)
    num_skipped = graph.num_last + 1
    width = min(num_nodes, MAX_BAND_NODES)
    first = np.full(width, -np.inf)
    num_first = int((graph.phone_number == 0).sum())
    for node in (0, num_first):  # the first pause is optional
        first[node] = scores[0, columns[node]]
    step = math.isqrt(num_frames) + 1
    starts = range(0, num_frames - 1, step)  # the frame before each block

    def block_of(start: int, low: int, end: int) -> _BlockInputs:
        """Return the inputs of a block for the nodes from ``low`` to ``end``."""
        band = slice(low, end)
        block = scores[start + 1 : start + 1 + step]
        return block, columns[band], stay[band], leave[band], skip[band]

    rows, lows = [first], [0]
    for start in starts:
        low = lows[-1]
        row = _advance(rows[-1], *block_of(start, low, low + width), num_skipped)
        num_left = num_frames - 1 - min(start + step, num_frames - 1)
        needed = int(np.searchsorted(-num_needed, -num_left))  # smaller nodes miss the end
        center = max(low + int(row.argmax()), needed)
        lows.append(max(low, min(center - width // 2, num_nodes - width)))
        rows.append(np.full(width, -np.inf))
        rows[-1][: width - (lows[-1] - low)] = row[lows[-1] - low :]
    # The last pause is optional too.
    ends = np.array([num_nodes - 1, num_nodes - 1 - graph.num_last])
    totals = rows[-1][ends - lows[-1]] + leave[ends]
    path = np.zeros(num_frames, dtype=np.int64)
    path[-1] = ends[totals.argmax()]
    if totals.max() == -np.inf:
        return path[:0], -np.inf
    for start, row, low in zip(starts[::-1], rows[-2::-1], lows[-2::-1], strict=True):
        piece = path[start : start + step + 1]
        end = int(piece[-1]) + 1
        first_node = max(low, end - step * num_skipped)  # the path cannot come from before
        inputs = block_of(start, first_node, end)
        back = _find_origins(row[first_node - low : end - low], *inputs, num_skipped)
        _backtrace(back, first_node, num_skipped, piece)
    return path, float(totals.max())


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _advance(
    row: Doubles,
    scores: Floats,
    columns: Integers,
    stay: Doubles,
    leave: Doubles,
    skip: Doubles,
    num_skipped: int,
) -> Doubles:
    """Return the row after a block, (nodes,), given the row before it."""
    num_nodes = len(row)
    # padding before the first node
    old = np.full(num_nodes + num_skipped, -np.inf)
    new = old.copy()
    old[num_skipped:] = row
    leave_before = np.full(num_nodes, 0.0)
    leave_before[1:] = leave[:-1]
    for frame in range(len(scores)):
        frame_scores = scores[frame]
        for node in range(num_nodes):
            best = old[node + num_skipped] + stay[node]
            best = max(best, old[node + num_skipped - 1] + leave_before[node])
            best = max(best, old[node] + skip[node])
            new[node + num_skipped] = best + frame_scores[columns[node]]
        old, new = new, old
    return old[num_skipped:].copy()


@numba.njit(cache=True, nogil=True)
def _find_origins(
    row: Doubles,
    scores: Floats,
    columns: Integers,
    stay: Doubles,
    leave: Doubles,
    skip: Doubles,
    num_skipped: int,
) -> NDArray[np.int8]:
    """Return where the best path to each node of a block comes from, (frames, nodes).

    0: the node itself, 1: the node before it, 2: the node before the pause.
    """
    origins = np.zeros((len(scores), len(row)), dtype=np.int8)
    old, new = row.copy(), np.empty_like(row)
    for frame in range(len(scores)):
        for node in range(len(row)):
            best = old[node] + stay[node]
            if node > 0:
                value = old[node - 1] + leave[node - 1]
                if value > best:
                    best = value
                    origins[frame, node] = 1
            if node >= num_skipped:
                value = old[node - num_skipped] + skip[node]
                if value > best:
                    best = value
                    origins[frame, node] = 2
            new[node] = best + scores[frame, columns[node]]
        old, new = new, old
    return origins


@numba.njit(cache=True, nogil=True)
def _backtrace(back: NDArray[np.int8], low: int, num_skipped: int, path: Integers) -> None:
    """Fill a block of the path, (frames + 1,), from its last node."""
    for frame in range(len(path) - 1, 0, -1):
        origin = back[frame - 1, path[frame] - low]
        path[frame - 1] = path[frame] - (0, 1, num_skipped)[origin]


def segments_of_path(path: Integers, graph: UtteranceGraph) -> list[PathSegment]:
    """Return the phones with their frames, given the node of every frame."""
    runs = graph.phone_number[path]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(runs)) + 1])
    ends = np.concatenate([starts[1:], [len(path)]])
    return [
        PathSegment(int(graph.phones[runs[start]]), int(start), int(end))
        for start, end in zip(starts, ends, strict=True)
    ]
