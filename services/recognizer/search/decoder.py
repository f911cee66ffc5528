"""Streaming Viterbi search over a loop of phones.

Source: Li et al. 2011, section 2.2, eq. 1-3: the best phone string so far after every feature
frame; section 3.1: any phone may follow any phone. Token passing: Young, Russell and Thornton 1989.

Deviation: a phone's cost depends on the phones before it, as far as the phone language model goes.
So every context has a best path of its own, a token, whose current phone is the context's last.
Tokens far behind the best one are dropped (beam search).

======== ===================================================== =====================
symbol   meaning                                               shape
======== ===================================================== =====================
score    log score of the best path that ends in a state       (tokens, states)
top      best score of a token's states                        (tokens,)
link     record of the phone before                            (tokens, states)
record   (end, phone, link): a phone that ended there, and     (records, 3)
         the record of the phone before it
======== ===================================================== =====================

The best string may still change, but not the part that all live paths share. From time to time
that part is stored, and records that no path needs are dropped (partial traceback), so endless
speech needs no endless memory.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.search.phone_lm import MAX_ORDER

_NO_RECORD = -1
_NO_TOKEN = -1
_IMPOSSIBLE = np.float32(-1e30)
_BEAM = np.float32(20.0)  # of log scores; more changes nothing on development data
_MAX_TOKENS = 4096  # speech needs fewer; sound without any speech in it may need more
_RECORD_CAPACITY = 4 * _MAX_TOKENS  # at least
_MAX_CHAIN = MAX_ORDER + 1  # contexts from the longest to the empty one


@dataclass(frozen=True, slots=True)
class Segment:
    """One phone of the best string, in feature frames of the decoder."""

    phone: int  # index into the inventory's phones
    start: int  # first frame
    end: int  # one past the last frame


class Decoder:
    """Viterbi search, one frame at a time.

    Parameters
    ----------
    topology
        The phones' HMMs and the phone language model.
    """

    def __init__(self, topology: Topology) -> None:
        self._topology = topology
        self._graph = topology.phone_lm.graph
        self._silence = topology.inventory.index[topology.inventory.silence]
        self._max_states = int(np.diff(topology.first_state).max())
        self._records = np.empty((_RECORD_CAPACITY, 3), dtype=np.int32)
        self._context = np.empty(_MAX_TOKENS, dtype=np.int32)  # of each token
        self._top = np.empty(_MAX_TOKENS, dtype=np.float32)
        self._score = np.empty((_MAX_TOKENS, self._max_states), dtype=np.float32)
        self._link = np.empty(self._score.shape, dtype=np.int32)
        self.reset()

    def reset(self) -> None:
        """Begin a new stretch of speech at frame 0."""
        self.num_frames = 0
        self._shared: list[Segment] = []  # phones that no later frame can change
        self._last_shared = _NO_RECORD  # record of the last of them
        self._best = (0, 0)  # token, and state of its phone
        self._confidence = 0.0  # in the phone
        self._num_records = self._num_tokens = 0

    def go_on_from(self, other: Decoder) -> None:
        """Take over where another search of the same topology stands."""
        self.num_frames, self._best = other.num_frames, other._best
        self._shared, self._last_shared = list(other._shared), other._last_shared
        if len(self._records) != len(other._records):
            self._records = np.empty_like(other._records)
        self._records[: other._num_records] = other._records[: other._num_records]
        self._num_records, self._num_tokens = other._num_records, other._num_tokens
        for name in ("_context", "_top", "_score", "_link"):
            getattr(self, name)[: self._num_tokens] = getattr(other, name)[: self._num_tokens]

    def accept(self, scores: NDArray[np.float32]) -> tuple[int, int, float]:
        """Take the state scores of one frame, shape (states,).

        Returns
        -------
        tuple
            Last phone of the best string so far, the frame where it began, and a confidence in
            0 to 1: among the best paths of all contexts, the share of those in which the phone is
            the last or the last but one.
        """
        self.advance(scores[None])
        token, state = self._best
        phone = int(self._graph.last_phone[self._context[token]])
        return phone, self._end(self._link[token, state]), self._confidence

    def advance(self, scores: NDArray[np.float32]) -> None:
        """Take the state scores of frames that nobody asks about, shape (frames, states)."""
        topology, graph = self._topology, self._graph
        num_taken = 0
        while num_taken < len(scores):
            if self._num_records + _MAX_TOKENS > len(self._records):
                self._drop_records()
            num_new, self._num_tokens, self._num_records, token, state, self._confidence = _steps(
                self.num_frames,
                scores[num_taken:],
                self._num_tokens,
                self._context,
                _token_table(len(graph.last_phone)),
                self._top,
                self._score,
                self._link,
                self._records,
                self._num_records,
                self._silence,
                topology.first_state,
                topology.log_stay,
                topology.log_leave,
                np.float32(topology.lm_scale),
                np.float32(topology.phone_penalty),
                graph.first_arc,
                graph.arc_phone,
                graph.arc_log_prob,
                graph.arc_context,
                graph.backoff_state,
                graph.log_backoff,
                graph.last_phone,
            )
            self._best = (token, state)
            self.num_frames += num_new
            num_taken += num_new

    def path_since(self, frame: int) -> list[Segment]:
        """Phones of the best string so far after a frame, without its last phone.

        They may still change. The first is cut to begin at the frame, if less than half of it is
        cut off; else it counts as earlier. Earlier phones are forgotten.
        """
        self.forget_before(frame)
        path = self._trace(int(self._link[self._best]))
        return [*self._shared, *segments_after(path, frame)]

    def forget_before(self, frame: int) -> None:
        """Forget phones that all paths share before a frame; no answer will have them."""
        self._shared = segments_after(self._shared, frame)

    def finish(self) -> list[Segment]:
        """End the speech: the best string of all frames."""
        if self.num_frames == 0:
            return []
        tokens = np.arange(self._num_tokens)
        phones = self._graph.last_phone[self._context[tokens]].astype(np.int64)
        first, end = self._topology.first_state[phones], self._topology.first_state[phones + 1]
        ends = self._score[tokens, end - first - 1] + self._topology.log_leave[end - 1]
        best = int(ends.argmax())
        state = int((end - first - 1)[best])
        if ends[best] <= _IMPOSSIBLE:  # no phone has reached its last state
            best, state = self._best
        link = int(self._link[best, state])
        last = Segment(int(phones[best]), self._end(link), self.num_frames)
        return [*self._shared, *self._trace(link), last]

    def _drop_records(self) -> None:
        """Store the phones that all paths share; make room for new records."""
        live = self._score[: self._num_tokens] > _IMPOSSIBLE
        links = self._link[: self._num_tokens][live]
        paths = _paths_through(links, self._records[: self._num_records, 2])
        shared = int(np.flatnonzero(paths == len(links)).max(initial=_NO_RECORD))
        self._shared += self._trace(shared)
        kept = np.flatnonzero(paths)
        kept = kept[kept >= shared]
        new = np.full(self._num_records + 1, _NO_RECORD, dtype=np.int32)  # last: for _NO_RECORD
        new[kept] = np.arange(len(kept))
        records = self._records[kept]
        records[:, 2] = new[records[:, 2]]
        if len(kept) + _MAX_TOKENS > len(self._records) // 2:
            self._records = np.empty((len(kept) + _RECORD_CAPACITY, 3), dtype=np.int32)
        self._records[: len(kept)] = records
        self._num_records = len(kept)
        self._link[: self._num_tokens][live] = new[links]
        self._last_shared = int(new[shared])

    def _trace(self, record: int) -> list[Segment]:
        """Phones after the shared ones, up to and with a record's."""
        segments: list[Segment] = []
        while record not in (_NO_RECORD, self._last_shared):
            end, phone, before = self._records[record].tolist()
            segments.append(Segment(phone, self._end(before), end))
            record = before
        return segments[::-1]

    def _end(self, record: int) -> int:
        """First frame after a record's phone."""
        return 0 if record == _NO_RECORD else int(self._records[record, 0])


_tables = threading.local()


def _token_table(num_contexts: int) -> NDArray[np.int16]:
    """Return a table of no tokens by context, for one search at a time; it is left as it was.

    All searches of a thread share it: it is larger than all else that a search keeps.
    """
    table: NDArray[np.int16] | None = getattr(_tables, "token_of", None)
    if table is None or len(table) < num_contexts:
        table = _tables.token_of = np.full(num_contexts, _NO_TOKEN, dtype=np.int16)
    return table


def segments_after(segments: list[Segment], frame: int) -> list[Segment]:
    """Return the segments that lie after a frame, at least with the larger part; cut to there."""
    return [
        Segment(segment.phone, max(segment.start, frame), segment.end)
        for segment in segments
        if segment.end - frame > max(frame - segment.start, 0)
    ]


@numba.njit(cache=True, nogil=True)
def _steps(
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
    *constants: Any,
) -> tuple[int, int, int, int, int, float]:
    """Advance all paths by the observed frames, or as many as there is room for their records.

    Returns
    -------
    tuple
        Number of frames; numbers of tokens and of records; the best token and its best state; the
        confidence.
    """
    num_done, token, state, confidence = 0, 0, 0, 0.0
    for number in range(num_tokens):
        token_of[context[number]] = number
    while num_done < len(observed) and num_records + len(context) <= len(records):
        num_tokens, num_records, token, state, confidence = _step(
            frame + num_done,
            observed[num_done],
            num_tokens,
            context,
            token_of,
            top,
            score,
            link,
            records,
            num_records,
            *constants,
        )
        num_done += 1
    for number in range(num_tokens):
        token_of[context[number]] = _NO_TOKEN
    return num_done, num_tokens, num_records, token, state, confidence


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
    silence: int,
    first_state: NDArray[np.int64],
    log_stay: NDArray[np.float32],
    log_leave: NDArray[np.float32],
    scale: np.float32,
    penalty: np.float32,
    first_arc: NDArray[np.int32],
    arc_phone: NDArray[np.uint8],
    arc_log_prob: NDArray[np.float32],
    arc_context: NDArray[np.int32],
    backoff_state: NDArray[np.int32],
    log_backoff: NDArray[np.float32],
    last_phone: NDArray[np.uint8],
) -> tuple[int, int, int, int, float]:
    """Advance all paths by one frame; add records of the phones that end before it.

    Returns
    -------
    tuple
        Numbers of tokens and of records; the best token and its best state; the confidence.
    """
    num_phones, max_tokens, max_states = len(first_state) - 1, len(context), score.shape[1]
    token = 0
    while token < num_tokens:  # the last token takes the place of a dropped one
        if top[token] >= -_BEAM:
            token += 1
            continue
        token_of[context[token]] = _NO_TOKEN
        num_tokens -= 1
        if token < num_tokens:
            context[token], top[token] = context[num_tokens], top[num_tokens]
            score[token], link[token] = score[num_tokens], link[num_tokens]
            token_of[context[token]] = token
    entry = np.full(max_tokens, _IMPOSSIBLE)
    entry_link = np.full(max_tokens, np.int32(_NO_RECORD))
    log_prob = np.empty(num_phones, np.float32)
    next_context = np.empty(num_phones, np.int32)
    chain = np.empty(_MAX_CHAIN, np.int32)
    for token in range(num_tokens if frame else 1):
        if frame:
            here = context[token]
            phone = last_phone[here]
            last = first_state[phone + 1] - first_state[phone] - 1
            leaving = score[token, last] + log_leave[first_state[phone + 1] - 1]
            if leaving < -_BEAM:
                continue
            record = num_records
            records[record, 0] = frame
            records[record, 1] = phone
            records[record, 2] = link[token, last]
            num_records += 1
        else:  # speech begins after a pause
            here, leaving, record = arc_context[silence], np.float32(0.0), _NO_RECORD
        length = 0
        while True:
            chain[length] = here
            length += 1
            if here == 0:
                break
            here = backoff_state[here]
        for number in range(length - 1, -1, -1):  # longer contexts overwrite shorter ones
            here = chain[number]
            log_prob += log_backoff[here] if here else np.float32(0.0)
            for arc in range(first_arc[here], first_arc[here + 1]):
                log_prob[arc_phone[arc]] = arc_log_prob[arc]
                next_context[arc_phone[arc]] = arc_context[arc]
        if frame == 0:  # before speech there is silence
            log_prob[silence] = 0.0
        for phone in range(num_phones):
            candidate = leaving + scale * log_prob[phone] + penalty
            if candidate < -_BEAM:
                continue
            following = token_of[next_context[phone]]
            if following == _NO_TOKEN:
                if num_tokens == max_tokens:
                    continue
                following = num_tokens
                num_tokens += 1
                context[following], token_of[next_context[phone]] = next_context[phone], following
                score[following], link[following] = _IMPOSSIBLE, _NO_RECORD
            if candidate > entry[following]:
                entry[following] = candidate
                entry_link[following] = record
    best, best_token, best_state = _IMPOSSIBLE, 0, 0
    for token in range(num_tokens):
        phone = last_phone[context[token]]
        first = first_state[phone]
        top[token] = _IMPOSSIBLE
        for state in range(first_state[phone + 1] - first - 1, -1, -1):
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
    best_phone = last_phone[context[best_token]]
    share, total = 0.0, 0.0
    for token in range(num_tokens):
        before = _NO_RECORD
        for state in range(max_states):
            if score[token, state] == top[token]:
                before = link[token, state]
            if score[token, state] > _IMPOSSIBLE:
                score[token, state] -= best  # keeps numbers small in endless speech
        top[token] -= best
        if top[token] > -_BEAM:
            total += np.exp(top[token])
            if last_phone[context[token]] == best_phone or (
                before != _NO_RECORD and records[before, 1] == best_phone
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
