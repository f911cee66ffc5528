"""Streaming Viterbi search over a loop of phones.

Source: Li et al. 2011, section 2.2, eq. 1-3: the best phone string so far after every feature
frame; section 3.1: any phone may follow any phone. Token passing: Young, Russell and Thornton 1989.

Deviation: the cost of a phone depends on the phones before it, as far as the phone language model
looks back. So every context has its own best path, called a token. The token's current phone is the
last phone of the context. Tokens with a score far below the best score are dropped (beam search).

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

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.search.frame_search import (
    MAX_TOKENS,
    NO_TOKEN,
    SLOW_RATE,
    Hmms,
    SearchState,
    advance_frames,
)
from kouxing.services.recognizer.search.path_records import (
    IMPOSSIBLE,
    NO_RECORD,
    Tokens,
    compact_records,
    count_record_paths,
)
from kouxing.shared.arrays import Doubles, Floats, Int16

_MIN_RECORDS = 4 * MAX_TOKENS


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


class Decoder:
    """Viterbi search, frame by frame, over the HMMs and the phone language model of a topology."""

    def __init__(self, topology: Topology) -> None:
        self._hmms = Hmms(
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
        self._rate = np.empty(len(topology.first_state), dtype=np.float32)
        self._records = np.empty((_MIN_RECORDS, 3), dtype=np.int32)
        self._tokens = Tokens(
            context=np.empty(MAX_TOKENS, dtype=np.int32),
            top=np.empty(MAX_TOKENS, dtype=np.float32),
            score=np.empty((MAX_TOKENS, max_states), dtype=np.float32),
            link=np.empty((MAX_TOKENS, max_states), dtype=np.int32),
        )
        self.reset()

    def reset(self) -> None:
        """Start a new segment of speech at frame 0."""
        self.num_frames = 0
        self._shared: list[PathSegment] = []  # recent phones that no later frame can change
        self._last_shared = NO_RECORD  # record of the last of them
        self._best = (0, 0)  # token, and state of its phone
        self._confidence = 0.0  # confidence in the phone
        self._rate[:] = SLOW_RATE
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

    def advance(self, scores: Floats) -> Doubles:
        """Search the next frames, given the scores of their states, (frames, states).

        Returns the confidence in the last phone after each frame, (frames,).
        """
        return self.advance_until(scores, 0, math.inf)[1]

    def advance_until(
        self, scores: Floats, known_phone: int, min_confidence: float
    ) -> tuple[NDArray[np.int32], Doubles]:
        """Search the next frames until the last phone is confident and is not ``known_phone``.

        Returns the last phone and the confidence in it after each frame, (frames,) each.
        """
        phones, confidence = np.empty(len(scores), dtype=np.int32), np.empty(len(scores))
        token_of = _token_table(len(self._graph.last_phone))
        num_advanced = 0
        while num_advanced < len(scores):
            if self._num_records + MAX_TOKENS > len(self._records):
                self.drop_records()
            search = SearchState(self._tokens, token_of, self._records, self._rate)
            num_done, self._num_tokens, self._num_records, token, state = advance_frames(
                self.num_frames,
                scores[num_advanced:],
                phones[num_advanced:],
                confidence[num_advanced:],
                known_phone,
                min_confidence,
                search,
                self._num_tokens,
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
        return LastPhone(phone, self._end_of(self._tokens.link[self._best]), self._confidence)

    def path_since(self, frame: int) -> list[PathSegment]:
        """Return the phones of the best string that start at a frame or later, without the last.

        Phones that end after ``shared_end`` may still change.
        """
        path = [*self._shared, *self._trace(int(self._tokens.link[self._best]))]
        return [segment for segment in path if segment.start >= frame]

    @property
    def shared_end(self) -> int:
        """Frame up to which all paths had the same phones when ``drop_records`` was last called."""
        return self._end_of(self._last_shared)

    def forget_before(self, frame: int) -> None:
        """Forget the phones before a frame; ``shared_end`` is not before it."""
        self._shared = [segment for segment in self._shared if segment.start >= frame]

    def final_path(self) -> list[PathSegment]:
        """Return the best string at the end of the speech, without forgotten phones."""
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
        last = PathSegment(int(phones[best]), self._end_of(link), self.num_frames)
        return [*self._shared, *self._trace(link), last]

    def drop_records(self) -> None:
        """Store the phones that all paths share, and drop records that no path needs."""
        paths = np.zeros(self._num_records, dtype=np.int32)
        shared = count_record_paths(self._num_tokens, self._tokens, self._records, paths)
        self._shared += self._trace(shared)
        num_kept, self._last_shared = compact_records(
            shared, paths, self._num_tokens, self._tokens, self._records
        )
        if num_kept + MAX_TOKENS > len(self._records) // 2:
            records = self._records
            self._records = np.empty((num_kept + _MIN_RECORDS, 3), dtype=np.int32)
            self._records[:num_kept] = records[:num_kept]
        self._num_records = num_kept

    def _trace(self, record: int) -> list[PathSegment]:
        """Return the phones after the shared phones, up to a record's phone."""
        segments: list[PathSegment] = []
        while record not in (NO_RECORD, self._last_shared):
            end, phone, before = self._records[record].tolist()
            segments.append(PathSegment(phone, self._end_of(before), end))
            record = before
        return segments[::-1]

    def _end_of(self, record: int) -> int:
        """First frame after the phone of a record."""
        return 0 if record == NO_RECORD else int(self._records[record, 0])


_tables = threading.local()


def _token_table(num_contexts: int) -> Int16:
    """Return an empty table from contexts to tokens. Each search empties it again.

    All searches of a thread share it, because it is larger than the rest of a search's memory.
    """
    table: Int16 | None = getattr(_tables, "token_of", None)
    if table is None or len(table) < num_contexts:
        table = _tables.token_of = np.full(num_contexts, NO_TOKEN, dtype=np.int16)
    return table
