"""One frame after another of the Viterbi search, compiled; `decoder` describes the search."""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.search.path_records import IMPOSSIBLE, NO_RECORD, Tokens
from kouxing.services.recognizer.search.phone_lm import MAX_ORDER, ContextGraph
from kouxing.shared.arrays import Doubles, Floats, Int16, Integers

NO_TOKEN = -1
MAX_TOKENS = 4096  # speech needs fewer; audio without any speech may need more
SLOW_RATE = np.float32(1.0 / 60.0)
_BEAM = np.float32(20.0)  # in log scores; a wider beam changes nothing on development data
_RATE_FRAMES = np.float32(200.0)
_MAX_PENALTY_CHANGE = np.float32(2.0)
_MAX_CHAIN = MAX_ORDER + 1  # contexts from the longest to the empty one


class Hmms(NamedTuple):
    """The phones' HMMs and the search weights; see ``Topology``."""

    silence: int
    first_state: Integers
    log_stay: Floats
    log_leave: Floats
    lm_scale: np.float32
    phone_penalty: np.float32
    rate_weight: np.float32


class SearchState(NamedTuple):
    """The arrays that the search changes."""

    tokens: Tokens
    token_of: Int16  # token of each context, or NO_TOKEN; (contexts,)
    records: NDArray[np.int32]  # (records, 3)
    # rate of change, and the square roots of the phones' probabilities at the last frame
    rate: Floats  # (1 + phones,)


@numba.njit(cache=True, nogil=True)
def advance_frames(
    frame: int,
    scores: Floats,
    phones: NDArray[np.int32],
    confidence: Doubles,
    known_phone: int,
    min_confidence: float,
    search: SearchState,
    num_tokens: int,
    num_records: int,
    hmms: Hmms,
    graph: ContextGraph,
) -> tuple[int, int, int, int, int]:
    """Advance all paths like `Decoder.advance_until`, but stop when the records are full.

    Fills in the last phone and the confidence after each frame. Returns the numbers of frames,
    tokens and records; the best token, and its best state.
    """
    tokens, token_of, records, rate = search
    num_done, token, state = 0, 0, 0
    for number in range(num_tokens):
        token_of[tokens.context[number]] = number
    while num_done < len(scores) and num_records + len(tokens.context) <= len(records):
        num_tokens = _prune(num_tokens, tokens, token_of)
        penalty = _phone_penalty(frame + num_done, scores[num_done], rate, hmms)
        num_tokens, num_records, entry, entry_link = _start_phones(
            frame + num_done, penalty, search, num_tokens, num_records, hmms, graph
        )
        token, state = _advance_states(
            scores[num_done], num_tokens, tokens, entry, entry_link, hmms, graph
        )
        confidence[num_done] = _normalize_scores(token, state, num_tokens, tokens, records, graph)
        phones[num_done] = graph.last_phone[tokens.context[token]]
        num_done += 1
        if phones[num_done - 1] != known_phone and confidence[num_done - 1] >= min_confidence:
            break
    for number in range(num_tokens):
        token_of[tokens.context[number]] = NO_TOKEN
    return num_done, num_tokens, num_records, token, state


@numba.njit(cache=True, nogil=True)
def _phone_penalty(frame: int, frame_scores: Floats, rate: Floats, hmms: Hmms) -> np.float32:
    """Update the rate of change by a frame's scores; return the penalty of phones that start."""
    if hmms.rate_weight == 0.0:
        return hmms.phone_penalty
    probabilities = np.exp(frame_scores - frame_scores.max())
    total = probabilities.sum()
    overlap = np.float32(0.0)
    for phone in range(len(hmms.first_state) - 1):
        states = probabilities[hmms.first_state[phone] : hmms.first_state[phone + 1]]
        root = np.sqrt(states.sum() / total)
        overlap += root * rate[1 + phone]
        rate[1 + phone] = root
    if frame:
        rate[0] += (np.float32(1.0) - overlap - rate[0]) / _RATE_FRAMES
    change = hmms.rate_weight * (rate[0] - SLOW_RATE)
    change = min(max(change, -_MAX_PENALTY_CHANGE), _MAX_PENALTY_CHANGE)
    return np.float32(hmms.phone_penalty + change)


@numba.njit(cache=True, nogil=True)
def _prune(num_tokens: int, tokens: Tokens, token_of: Int16) -> int:
    """Drop the tokens outside the beam; return the number of tokens."""
    context, top, score, link = tokens
    token = 0
    while token < num_tokens:  # the last token takes the place of a dropped one
        if top[token] >= -_BEAM:
            token += 1
            continue
        token_of[context[token]] = NO_TOKEN
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
    search: SearchState,
    num_tokens: int,
    num_records: int,
    hmms: Hmms,
    graph: ContextGraph,
) -> tuple[int, int, Floats, NDArray[np.int32]]:
    """Record the phones that may end before the frame, and start the phones that may follow.

    Returns the numbers of tokens and records; the best score that enters each token, and its
    record, (tokens,) each.
    """
    tokens, token_of, records, _ = search
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
            if following == NO_TOKEN:
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
    context: int, graph: ContextGraph, log_prob: Floats, next_context: NDArray[np.int32]
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
    frame_scores: Floats,
    num_tokens: int,
    tokens: Tokens,
    entry: Floats,
    entry_link: NDArray[np.int32],
    hmms: Hmms,
    graph: ContextGraph,
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
            score[token, state] = max(value + frame_scores[first + state], IMPOSSIBLE)
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
    graph: ContextGraph,
) -> float:
    """Subtract the best score, to keep numbers small; return the last phone's confidence."""
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
