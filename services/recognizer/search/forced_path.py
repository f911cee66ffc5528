"""Forced alignment: the best path of known phones through a recording, with optional pauses.

Source: the HTK book (Young et al. 2009), chapter 8; used in Li et al. 2011, section 3.2, scheme 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.search.decoder import Segment


@dataclass(slots=True, kw_only=True)
class UtteranceGraph:
    """The states of an utterance in order. Pauses are optional."""

    states: NDArray[np.int64]  # (nodes,) HMM state of each node
    skip_from: NDArray[np.int64]  # (nodes,) node before an optional pause, or -1
    phone_number: NDArray[np.int64]  # (nodes,) running number of the phone, pauses included
    phones: NDArray[np.int64]  # (running numbers,) indices into the inventory's phones
    num_last: int  # number of nodes of the last pause, which is optional too


def utterance_graph(
    phones: Sequence[int],
    syllables: Sequence[int],
    first_state: NDArray[np.int64],
    *,
    silence: int,
) -> UtteranceGraph:
    """Lay out the states of an utterance, with an optional pause at each syllable boundary.

    ``syllables`` are the numbers of phones; ``first_state`` is that of ``Topology``.
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
    position = 0
    for length in syllables:
        for phone in phones[position : position + length]:
            add(phone, before_pause)
            before_pause = -1
        position += length
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
    scores: NDArray[np.float32],
    graph: UtteranceGraph,
    log_stay: NDArray[np.float32],
    log_leave: NDArray[np.float32],
) -> tuple[NDArray[np.int64], float]:
    """Find the best path through a graph, given the scores of its nodes, (frames, nodes).

    ``log_stay`` and ``log_leave`` are those of ``Topology``. Returns the node of every frame,
    (frames,), and the path's log-likelihood. With too few frames: nothing and minus infinity.
    """
    path, log_likelihood = _viterbi(
        scores,
        graph.skip_from,
        log_stay[graph.states],
        log_leave[graph.states],
        graph.num_last,
        int((graph.phone_number == 0).sum()),
    )
    return path, float(log_likelihood)


@numba.njit(cache=True)
def _viterbi(
    scores: NDArray[np.float32],
    skip_from: NDArray[np.int64],
    stay: NDArray[np.float32],
    leave: NDArray[np.float32],
    num_last: int,
    num_first: int,
) -> tuple[NDArray[np.int64], float]:
    num_frames, num_nodes = scores.shape
    score = np.full(num_nodes, -np.inf)
    back = np.zeros((num_frames, num_nodes), dtype=np.int32)
    score[0] = scores[0, 0]
    score[num_first] = scores[0, num_first]  # the first pause is optional
    for frame in range(1, num_frames):
        for node in range(num_nodes - 1, -1, -1):
            best, origin = score[node] + stay[node], node
            if node > 0:
                value = score[node - 1] + leave[node - 1]
                if value > best:
                    best, origin = value, node - 1
            before = skip_from[node]
            if before >= 0:
                value = score[before] + leave[before]
                if value > best:
                    best, origin = value, before
            score[node] = best + scores[frame, node]
            back[frame, node] = origin
    # The last pause is optional too.
    node = num_nodes - 1
    before = num_nodes - num_last - 1
    if score[before] + leave[before] > score[node] + leave[node]:
        node = before
    total = score[node] + leave[node]
    path = np.zeros(num_frames, dtype=np.int64)
    if total == -np.inf:
        return path[:0], total
    for frame in range(num_frames - 1, -1, -1):
        path[frame] = node
        node = back[frame, node]
    return path, total


def segments_of_path(path: NDArray[np.int64], graph: UtteranceGraph) -> list[Segment]:
    """Return the phones with their frames, given the node of every frame."""
    runs = graph.phone_number[path]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(runs)) + 1])
    ends = np.concatenate([starts[1:], [len(path)]])
    return [
        Segment(int(graph.phones[runs[start]]), int(start), int(end))
        for start, end in zip(starts, ends, strict=True)
    ]
