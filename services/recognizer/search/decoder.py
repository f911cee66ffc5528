"""Streaming Viterbi search over a loop of phones.

Source: Li et al. 2011, section 2.2, eq. 1-3: the best phone string so far after every feature
frame; section 3.1: any phone may follow any phone. Token passing: Young, Russell and Thornton 1989.

Deviation: the cost of a phone depends on the phones before it, as far as the phone language model
looks back. So every context has its own best path, called a token. The token's current phone is the
last phone of the context. Tokens with a score far below the best one are dropped (beam search).

A fixed penalty for each phone deletes phones in fast speech and inserts phones in slow speech. The
penalty can therefore follow the rate at which the phones' scores change::

    change = 1 - sum over phones of sqrt(p(t) p(t - 1))
    rate = running mean of change over two seconds
    penalty = phone_penalty + rate_weight (rate - 1/60), at most 2 from phone_penalty

p(t) are the scores of frame t as probabilities. 1/60 is the rate of slow speech. The rate is lower
where scores are uncertain. There, insertions are more likely.

======== ===================================================== =====================
symbol   meaning                                               shape
======== ===================================================== =====================
score    log score of the best path that ends in a state       (tokens, states)
top      best score of a token's states                        (tokens,)
link     record of the previous phone                          (tokens, states)
record   (end, phone, link): a phone that ended there, and     (records, 3)
         the record of the phone before it
======== ===================================================== =====================

The best string may still change, except for the part that all live paths share. From time to time,
that part is stored and the records that no path needs are dropped (partial traceback). So the
memory stays bounded in endless speech. Phones in that part are final (``shared_end``).
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.search.path_records import (
    IMPOSSIBLE,
    NO_RECORD,
    Tokens,
    compact,
    count_paths,
)
from kouxing.services.recognizer.search.phone_lm import MAX_ORDER, Graph

_NO_TOKEN = -1
_BEAM = np.float32(20.0)  # in log scores; a wider beam changes nothing on development data
_MAX_TOKENS = 4096  # speech needs fewer; audio without any speech may need more
_SLOW_RATE = np.float32(1.0 / 60.0)
_RATE_FRAMES = np.float32(200.0)
_MAX_PENALTY_CHANGE = np.float32(2.0)
_MIN_RECORDS = 4 * _MAX_TOKENS
_MAX_CHAIN = MAX_ORDER + 1  # contexts from the longest to the empty one


@dataclass(frozen=True, slots=True)
class PathSegment:
    """One phone of the best string, in feature frames of the decoder."""

    phone: int  # index into the inventory's phones
    start: int  # first frame
    end: int  # one past the last frame


class LastPhone(NamedTuple):
    """The last phone of the best string so far."""

    phone: int
    start: int  # frame
    confidence: float  # fraction of the contexts' best paths where it is last or last but one


class _Hmms(NamedTuple):
    """The phones' HMMs and the search weights; see ``Topology``."""

    silence: int
    first_state: NDArray[np.int64]
    log_stay: NDArray[np.float32]
    log_leave: NDArray[np.float32]
    lm_scale: np.float32
    phone_penalty: np.float32
    rate_weight: np.float32


class Decoder:
    """Viterbi search, frame by frame, over the HMMs and the phone language model of a topology."""

    def __init__(self, topology: Topology) -> None:
        self._hmms = _Hmms(
            topology.inventory.index[topology.inventory.silence],
            topology.first_state,
            topology.log_stay,
            topology.log_leave,
            np.float32(topology.lm_scale),
            np.float32(topology.phone_penalty),
            np.float32(topology.rate_weight),
        )
        self._graph = topology.phone_lm.graph
        max_states = int(np.diff(topology.first_state).max())
        # rate of change, and the square roots of the phones' probabilities at the last frame
        self._rate = np.empty(len(topology.first_state), dtype=np.float32)
        self._records = np.empty((_MIN_RECORDS, 3), dtype=np.int32)
        self._tokens = Tokens(
            context=np.empty(_MAX_TOKENS, dtype=np.int32),
            top=np.empty(_MAX_TOKENS, dtype=np.float32),
            score=np.empty((_MAX_TOKENS, max_states), dtype=np.float32),
            link=np.empty((_MAX_TOKENS, max_states), dtype=np.int32),
        )
        self.reset()

    def reset(self) -> None:
        """Start a new stretch of speech at frame 0."""
        self.num_frames = 0
        self._shared: list[PathSegment] = []  # phones that no later frame can change; the latest
        self._last_shared = NO_RECORD  # record of the last of them
        self._best = (0, 0)  # token, and state of its phone
        self._confidence = 0.0  # confidence in the phone
        self._rate[:] = _SLOW_RATE
        self._num_records = self._num_tokens = 0

    def copy_state(self, other: Decoder) -> None:
        """Continue from the state of another search of the same topology."""
        self.num_frames, self._best = other.num_frames, other._best
        self._shared, self._last_shared = list(other._shared), other._last_shared
        self._rate[:] = other._rate
        if len(self._records) != len(other._records):
            self._records = np.empty_like(other._records)
        self._records[: other._num_records] = other._records[: other._num_records]
        self._num_records, self._num_tokens = other._num_records, other._num_tokens
        for values, new in zip(self._tokens, other._tokens, strict=True):
            values[: self._num_tokens] = new[: self._num_tokens]

    def advance(self, scores: NDArray[np.float32]) -> NDArray[np.float64]:
        """Search the next frames, given the scores of their states, (frames, states).

        Returns the confidence in the last phone after each frame, (frames,).
        """
        return self.advance_until(scores, 0, math.inf)[1]

    def advance_until(
        self, scores: NDArray[np.float32], known_phone: int, min_confidence: float
    ) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
        """Search the next frames until the last phone is confident and is not ``known_phone``.

        Returns the last phone and the confidence in it after each frame, (frames,) each.
        """
        phones, confidence = np.empty(len(scores), dtype=np.int32), np.empty(len(scores))
        num_advanced = 0
        while num_advanced < len(scores):
            if self._num_records + _MAX_TOKENS > len(self._records):
                self.drop_records()
            num_done, self._num_tokens, self._num_records, token, state = _steps(
                self.num_frames,
                scores[num_advanced:],
                phones[num_advanced:],
                confidence[num_advanced:],
                known_phone,
                min_confidence,
                self._rate,
                self._num_tokens,
                self._tokens,
                _token_table(len(self._graph.last_phone)),
                self._records,
                self._num_records,
                self._hmms,
                self._graph,
            )
            self._best = (token, state)
            self.num_frames += num_done
            num_advanced += num_done
            newest = num_advanced - 1
            self._confidence = float(confidence[newest])
            if phones[newest] != known_phone and confidence[newest] >= min_confidence:
                break
        return phones[:num_advanced], confidence[:num_advanced]

    @property
    def last_phone(self) -> LastPhone:
        """The last phone of the best string so far; undefined before the first frame."""
        token, _ = self._best
        phone = int(self._graph.last_phone[self._tokens.context[token]])
        return LastPhone(phone, self._end(self._tokens.link[self._best]), self._confidence)

    def path_since(self, frame: int) -> list[PathSegment]:
        """Return the phones of the best string that start at a frame or later, without the last.

        Those that end after ``shared_end`` may still change.
        """
        path = [*self._shared, *self._trace(int(self._tokens.link[self._best]))]
        return [segment for segment in path if segment.start >= frame]

    @property
    def shared_end(self) -> int:
        """Frame up to which all paths had the same phones when ``drop_records`` was last called."""
        return self._end(self._last_shared)

    def forget_before(self, frame: int) -> None:
        """Forget the phones before a frame; ``shared_end`` is not before it."""
        self._shared = [segment for segment in self._shared if segment.start >= frame]

    def final_path(self) -> list[PathSegment]:
        """Return the best string at the end of the speech, without phones that were forgotten."""
        if self.num_frames == 0:
            return []
        first_state, log_leave = self._hmms.first_state, self._hmms.log_leave
        tokens = np.arange(self._num_tokens)
        phones = self._graph.last_phone[self._tokens.context[tokens]].astype(np.int64)
        first, end = first_state[phones], first_state[phones + 1]
        ends = self._tokens.score[tokens, end - first - 1] + log_leave[end - 1]
        best = int(ends.argmax())
        state = int((end - first - 1)[best])
        if ends[best] <= IMPOSSIBLE:  # no phone has reached its last state
            best, state = self._best
        link = int(self._tokens.link[best, state])
        last = PathSegment(int(phones[best]), self._end(link), self.num_frames)
        return [*self._shared, *self._trace(link), last]

    def drop_records(self) -> None:
        """Store the phones that all paths share, and drop records that no path needs."""
        paths = np.zeros(self._num_records, dtype=np.int32)
        shared = count_paths(self._num_tokens, self._tokens, self._records, paths)
        self._shared += self._trace(shared)
        num_kept, self._last_shared = compact(
            shared, paths, self._num_tokens, self._tokens, self._records
        )
        if num_kept + _MAX_TOKENS > len(self._records) // 2:
            records = self._records
            self._records = np.empty((num_kept + _MIN_RECORDS, 3), dtype=np.int32)
            self._records[:num_kept] = records[:num_kept]
        self._num_records = num_kept

    def _trace(self, record: int) -> list[PathSegment]:
        """Return the phones after the shared phones, up to a record's phone."""
        segments: list[PathSegment] = []
        while record not in (NO_RECORD, self._last_shared):
            end, phone, before = self._records[record].tolist()
            segments.append(PathSegment(phone, self._end(before), end))
            record = before
        return segments[::-1]

    def _end(self, record: int) -> int:
        """First frame after the phone of a record."""
        return 0 if record == NO_RECORD else int(self._records[record, 0])


_tables = threading.local()


def _token_table(num_contexts: int) -> NDArray[np.int16]:
    """Return a table from contexts to tokens, without tokens; each search empties it again.

    All searches of a thread share it, because it is larger than the rest of a search's memory.
    """
    table: NDArray[np.int16] | None = getattr(_tables, "token_of", None)
    if table is None or len(table) < num_contexts:
        table = _tables.token_of = np.full(num_contexts, _NO_TOKEN, dtype=np.int16)
    return table


@numba.njit(cache=True, nogil=True)
def _steps(
    frame: int,
    observed: NDArray[np.float32],
    phones: NDArray[np.int32],
    confidence: NDArray[np.float64],
    known_phone: int,
    min_confidence: float,
    rate: NDArray[np.float32],
    num_tokens: int,
    tokens: Tokens,
    token_of: NDArray[np.int16],
    records: NDArray[np.int32],
    num_records: int,
    hmms: _Hmms,
    graph: Graph,
) -> tuple[int, int, int, int, int]:
    """Advance all paths as in `Decoder.advance_until`, or as far as there is room for records.

    Fills in the last phone and the confidence after each frame. Returns the numbers of frames,
    tokens and records; the best token, and its best state.
    """
    num_done, token, state = 0, 0, 0
    for number in range(num_tokens):
        token_of[tokens.context[number]] = number
    while num_done < len(observed) and num_records + len(tokens.context) <= len(records):
        num_tokens = _prune(num_tokens, tokens, token_of)
        penalty = _phone_penalty(frame + num_done, observed[num_done], rate, hmms)
        num_tokens, num_records, entry, entry_link = _start_phones(
            frame + num_done,
            penalty,
            num_tokens,
            tokens,
            token_of,
            records,
            num_records,
            hmms,
            graph,
        )
        token, state = _advance_states(
            observed[num_done], num_tokens, tokens, entry, entry_link, hmms, graph
        )
        confidence[num_done] = _normalize_scores(token, state, num_tokens, tokens, records, graph)
        phones[num_done] = graph.last_phone[tokens.context[token]]
        num_done += 1
        if phones[num_done - 1] != known_phone and confidence[num_done - 1] >= min_confidence:
            break
    for number in range(num_tokens):
        token_of[tokens.context[number]] = _NO_TOKEN
    return num_done, num_tokens, num_records, token, state


@numba.njit(cache=True, nogil=True)
def _phone_penalty(
    frame: int, observed: NDArray[np.float32], rate: NDArray[np.float32], hmms: _Hmms
) -> np.float32:
    """Update the rate of change by a frame's scores; return the penalty of phones that start."""
    if hmms.rate_weight == 0.0:
        return hmms.phone_penalty
    probabilities = np.exp(observed - observed.max())
    total = probabilities.sum()
    overlap = np.float32(0.0)
    for phone in range(len(hmms.first_state) - 1):
        states = probabilities[hmms.first_state[phone] : hmms.first_state[phone + 1]]
        root = np.sqrt(states.sum() / total)
        overlap += root * rate[1 + phone]
        rate[1 + phone] = root
    if frame:
        rate[0] += (np.float32(1.0) - overlap - rate[0]) / _RATE_FRAMES
    change = hmms.rate_weight * (rate[0] - _SLOW_RATE)
    change = min(max(change, -_MAX_PENALTY_CHANGE), _MAX_PENALTY_CHANGE)
    return np.float32(hmms.phone_penalty + change)


@numba.njit(cache=True, nogil=True)
def _prune(num_tokens: int, tokens: Tokens, token_of: NDArray[np.int16]) -> int:
    """Drop the tokens outside the beam; return the number of tokens."""
    context, top, score, link = tokens
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
    return num_tokens


@numba.njit(cache=True, nogil=True)
def _start_phones(
    frame: int,
    penalty: np.float32,
    num_tokens: int,
    tokens: Tokens,
    token_of: NDArray[np.int16],
    records: NDArray[np.int32],
    num_records: int,
    hmms: _Hmms,
    graph: Graph,
) -> tuple[int, int, NDArray[np.float32], NDArray[np.int32]]:
    """Record the phones that may end before the frame, and start the phones that may follow.

    Returns the numbers of tokens and records; the best score that enters each token, and its
    record, (tokens,) each.
    """
    num_phones, max_tokens = len(hmms.first_state) - 1, len(tokens.context)
    entry = np.full(max_tokens, IMPOSSIBLE)
    entry_link = np.full(max_tokens, np.int32(NO_RECORD))
    log_prob = np.empty(num_phones, np.float32)
    next_context = np.empty(num_phones, np.int32)
    for token in range(num_tokens if frame else 1):
        if frame:
            here = tokens.context[token]
            phone = graph.last_phone[here]
            last = hmms.first_state[phone + 1] - hmms.first_state[phone] - 1
            leaving = tokens.score[token, last] + hmms.log_leave[hmms.first_state[phone + 1] - 1]
            if leaving < -_BEAM:
                continue
            record = num_records
            records[record, 0] = frame
            records[record, 1] = phone
            records[record, 2] = tokens.link[token, last]
            num_records += 1
        else:  # speech starts after a pause
            here, leaving, record = graph.arc_context[hmms.silence], np.float32(0.0), NO_RECORD
        _look_up_phones(here, graph, log_prob, next_context)
        if frame == 0:  # before speech there is silence
            log_prob[hmms.silence] = 0.0
        for phone in range(num_phones):
            candidate = leaving + hmms.lm_scale * log_prob[phone] + penalty
            if candidate < -_BEAM:
                continue
            following = token_of[next_context[phone]]
            if following == _NO_TOKEN:
                if num_tokens == max_tokens:
                    continue
                following = num_tokens
                num_tokens += 1
                tokens.context[following] = next_context[phone]
                token_of[next_context[phone]] = following
                tokens.score[following], tokens.link[following] = IMPOSSIBLE, NO_RECORD
            if candidate > entry[following]:
                entry[following] = candidate
                entry_link[following] = record
    return num_tokens, num_records, entry, entry_link


@numba.njit(cache=True, nogil=True)
def _look_up_phones(
    context: int, graph: Graph, log_prob: NDArray[np.float32], next_context: NDArray[np.int32]
) -> None:
    """Fill in the log-probability of each phone after a context, and the context it leads to."""
    chain = np.empty(_MAX_CHAIN, np.int32)
    length = 0
    while True:
        chain[length] = context
        length += 1
        if context == 0:
            break
        context = graph.backoff_state[context]
    for number in range(length - 1, -1, -1):  # longer contexts overwrite shorter ones
        context = chain[number]
        log_prob += graph.log_backoff[context] if context else np.float32(0.0)
        for arc in range(graph.first_arc[context], graph.first_arc[context + 1]):
            log_prob[graph.arc_phone[arc]] = graph.arc_log_prob[arc]
            next_context[graph.arc_phone[arc]] = graph.arc_context[arc]


@numba.njit(cache=True, nogil=True)
def _advance_states(
    observed: NDArray[np.float32],
    num_tokens: int,
    tokens: Tokens,
    entry: NDArray[np.float32],
    entry_link: NDArray[np.int32],
    hmms: _Hmms,
    graph: Graph,
) -> tuple[int, int]:
    """Advance the paths within the phones by one frame; return the best token and its state."""
    context, top, score, link = tokens
    best, best_token, best_state = IMPOSSIBLE, 0, 0
    for token in range(num_tokens):
        phone = graph.last_phone[context[token]]
        first = hmms.first_state[phone]
        top[token] = IMPOSSIBLE
        for state in range(hmms.first_state[phone + 1] - first - 1, -1, -1):
            value = score[token, state] + hmms.log_stay[first + state]
            from_link = link[token, state]
            if state:
                moved = score[token, state - 1] + hmms.log_leave[first + state - 1]
                moved_link = link[token, state - 1]
            else:
                moved, moved_link = entry[token], entry_link[token]
            if moved > value:
                value, from_link = moved, moved_link
            score[token, state] = max(value + observed[first + state], IMPOSSIBLE)
            link[token, state] = from_link
            if score[token, state] > top[token]:
                top[token] = score[token, state]
                if top[token] > best:
                    best, best_token, best_state = top[token], token, state
    return best_token, best_state


@numba.njit(cache=True, nogil=True)
def _normalize_scores(
    best_token: int,
    best_state: int,
    num_tokens: int,
    tokens: Tokens,
    records: NDArray[np.int32],
    graph: Graph,
) -> float:
    """Subtract the best score, so that numbers stay small; return the last phone's confidence."""
    context, top, score, link = tokens
    best = score[best_token, best_state]
    best_phone = graph.last_phone[context[best_token]]
    agreeing, total = 0.0, 0.0
    for token in range(num_tokens):
        before = NO_RECORD
        for state in range(score.shape[1]):
            if score[token, state] == top[token]:
                before = link[token, state]
            if score[token, state] > IMPOSSIBLE:
                score[token, state] -= best
        top[token] -= best
        if top[token] > -_BEAM:
            total += np.exp(top[token])
            if graph.last_phone[context[token]] == best_phone or (
                before != NO_RECORD and records[before, 1] == best_phone
            ):
                agreeing += np.exp(top[token])
    return agreeing / total
