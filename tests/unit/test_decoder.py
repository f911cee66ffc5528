"""The search against brute force on models small enough to try every path."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import NUM_POSITIONS, Topology
from kouxing.services.recognizer.search import decoder as search
from kouxing.services.recognizer.search.decoder import Decoder, LastPhone, Segment, segments_after
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from tests.languages import MANDARIN, NUM_PHONES, SIL, Gram, Table, flat_language

pytestmark = pytest.mark.unit


def topology(
    states_per_phone: int, rng: np.random.Generator, language: PhoneLanguageModel | None = None
) -> Topology:
    num_states = NUM_PHONES * states_per_phone
    stay = rng.uniform(0.2, 0.8, num_states)
    return Topology(
        first_state=np.arange(NUM_PHONES + 1) * states_per_phone,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        phone_lm=language or flat_language(),
        duration_mean_s=np.full((NUM_POSITIONS, NUM_PHONES), 0.1, np.float32),
        duration_spread_s=np.full((NUM_POSITIONS, NUM_PHONES), 0.1, np.float32),
    )


def only(phones: list[int], states_per_phone: int, scores: NDArray[np.float32]) -> None:
    """Make all other phones impossible."""
    for phone in range(NUM_PHONES):
        if phone not in phones:
            scores[:, phone * states_per_phone : (phone + 1) * states_per_phone] = -1e4


def last_phone_after(decoder: Decoder, scores: NDArray[np.float32]) -> LastPhone:
    decoder.advance(scores[None])
    return decoder.last_phone


@dataclass(frozen=True)
class Path:
    """A path up to a frame."""

    score: float
    ended: tuple[Segment, ...]
    phone: int
    state: int  # of the phone
    start: int  # of the phone


def brute_force(
    model: Topology, table: Table, scores: NDArray[np.float32], phones: list[int]
) -> list[Segment]:
    """Try every path that the loop allows."""

    def cost(before: tuple[int, ...], phone: int) -> float:
        log_prob = 0.0 if before == (SIL,) and phone == SIL else table.after(before, phone)
        return model.lm_scale * log_prob + model.phone_penalty

    paths = [Path(cost((SIL,), phone), (), phone, 0, 0) for phone in phones]
    for frame, observed in enumerate(scores):
        longer = []
        for path in paths:
            at = int(model.first_state[path.phone]) + path.state
            score = path.score + float(observed[at])
            left = score + float(model.log_leave[at])
            longer.append(replace(path, score=score + float(model.log_stay[at])))
            if at + 1 < model.first_state[path.phone + 1]:
                longer.append(replace(path, score=left, state=path.state + 1))
                continue
            ended = (*path.ended, Segment(path.phone, path.start, frame + 1))
            before = (SIL, *(segment.phone for segment in ended))
            is_last = frame + 1 == len(scores)
            longer += [
                Path(left + (0.0 if is_last else cost(before, phone)), ended, phone, 0, frame + 1)
                for phone in phones
            ]
        paths = longer
    complete = [path for path in paths if path.start == len(scores)]
    return list(max(complete, key=lambda path: path.score).ended)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("order", "kept", "states_per_phone", "num_frames"),
    [(2, 1.0, 2, 8), (2, 1.0, 3, 9), (3, 1.0, 2, 9), (3, 0.5, 2, 9), (4, 0.6, 1, 7)],
)
def test_finds_the_best_of_all_paths(
    seed: int, order: int, kept: float, states_per_phone: int, num_frames: int
) -> None:
    rng = np.random.default_rng(seed)
    phones = [3, 40, SIL]
    table = Table.draw(rng, phones, order=order, kept=kept)
    model = replace(topology(states_per_phone, rng, table.tree()), lm_scale=1.5, phone_penalty=1.25)
    scores = rng.normal(size=(num_frames, model.num_states)).astype(np.float32)
    only(phones, states_per_phone, scores)
    decoder = Decoder(model)
    decoder.advance(scores)
    assert decoder.final_path() == brute_force(model, table, scores, phones)


def clear_scores(
    sequence: list[int], model: Topology, frames_per_state: int, contrast: float = 50.0
) -> NDArray[np.float32]:
    """Scores that leave no doubt."""
    rows = []
    for phone in sequence:
        for state in range(model.first_state[phone], model.first_state[phone + 1]):
            row = np.full(model.num_states, -contrast, np.float32)
            row[state] = 0.0
            rows += [row] * frames_per_state
    return np.array(rows)


def test_decodes_clear_speech() -> None:
    model = topology(5, np.random.default_rng(0))
    sequence = [SIL, 3, 30, 12, 45, SIL]
    decoder = Decoder(model)
    scores = clear_scores(sequence, model, frames_per_state=2)
    last = [last_phone_after(decoder, row) for row in scores]
    assert [segment.phone for segment in decoder.final_path()] == sequence
    assert [(s.start, s.end) for s in decoder.final_path()] == [
        (t, t + 10) for t in range(0, 60, 10)
    ]
    # the last phone of the best string, and where it began
    assert [phone for phone, _, _ in last[::10]] == sequence
    assert last[25][:2] == (30, 20)
    assert all(0 < confidence <= 1 for _, _, confidence in last)


def test_speech_that_ends_within_a_phone_keeps_the_earlier_phones() -> None:
    model = topology(5, np.random.default_rng(0))
    decoder = Decoder(model)
    decoder.advance(clear_scores([3, 30, 12], model, frames_per_state=2)[:23])
    assert decoder.final_path() == [Segment(3, 0, 10), Segment(30, 10, 20), Segment(12, 20, 23)]


def test_the_language_model_decides_between_equal_scores() -> None:
    """30 and 31 score the same; after 3 comes the one, after 4 the other."""
    singles: dict[Gram, float] = {(phone,): -4.0 for phone in range(NUM_PHONES)}
    language = Table(singles | {(3, 30): -0.1, (4, 31): -0.1}, {(3,): -3.0, (4,): -3.0}).tree()
    model = topology(3, np.random.default_rng(0), language)
    decoder = Decoder(model)
    scores = clear_scores([3, 30, 4, 30], model, frames_per_state=2)
    for phone in (30, 31):
        states = slice(model.first_state[phone], model.first_state[phone + 1])
        scores[6:12, states] = scores[18:, states] = 0.0
    decoder.advance(scores)
    assert [segment.phone for segment in decoder.final_path()] == [3, 30, 4, 31]


def test_long_speech_needs_bounded_memory() -> None:
    rng = np.random.default_rng(1)
    model = topology(5, rng)
    sequence = rng.permutation(np.arange(SIL)).tolist() * 8  # 472 phones, 4720 frames
    decoder = Decoder(model)
    decoder.advance(clear_scores(sequence, model, frames_per_state=2, contrast=2.0))
    assert len(decoder._shared) > 300
    assert len(decoder._records) < 2 * search._MIN_RECORDS
    assert [segment.phone for segment in decoder.final_path()] == sequence
    assert [segment.phone for segment in decoder.path_since(4000)] == sequence[400:-1]


def crowded_language() -> PhoneLanguageModel:
    """Know all strings of three phones but for pauses, and one more after each, all as likely."""
    levels = [np.zeros(1, np.uint8)]
    children = [np.array([NUM_PHONES], np.uint8)]
    for num_children in (NUM_PHONES, NUM_PHONES, 1, 0):
        parents = children[-1]
        levels.append(np.concatenate([np.arange(n) for n in parents]).astype(np.uint8))
        begins = (levels[-1] != SIL) | (len(levels) == 2)
        children.append(np.where(begins, num_children, 0).astype(np.uint8))
    phone = np.concatenate(levels)
    return PhoneLanguageModel(
        inventory=MANDARIN,
        num_children=np.concatenate(children),
        phone=phone,
        log_prob=np.full(len(phone), -np.log(NUM_PHONES), np.float32),
        log_backoff=np.zeros(len(phone), np.float32),
    )


def test_limits_the_number_of_tokens() -> None:
    language = crowded_language()
    assert len(language.graph.last_phone) > 200_000
    model = topology(1, np.random.default_rng(0), language)
    decoder = Decoder(model)
    most = 0
    for _ in range(60):
        phone, start, confidence = last_phone_after(decoder, np.zeros(model.num_states, np.float32))
        assert 0 <= phone < NUM_PHONES
        assert 0 <= start < decoder.num_frames
        assert 0 < confidence <= 1
        most = max(most, decoder._num_tokens)
        assert len(decoder._records) <= 2 * search._MIN_RECORDS
        contexts = decoder._tokens.context[: decoder._num_tokens]
        assert len(np.unique(contexts)) == len(contexts)
        table = search._token_table(len(language.graph.last_phone))
        assert (table == search._NO_TOKEN).all(), "another search would find these tokens"
    assert most == search._MAX_TOKENS
    path = decoder.final_path()
    assert (path[0].start, path[-1].end) == (0, 60)
    assert all(one.end == two.start for one, two in pairwise(path))


def test_interleaved_searches_are_independent() -> None:
    model = topology(3, np.random.default_rng(0), crowded_language())
    scores = np.random.default_rng(1).normal(scale=4.0, size=(2, 40, model.num_states))
    together = [Decoder(model), Decoder(model)]
    for rows in scores.astype(np.float32).transpose(1, 0, 2):
        for decoder, row in zip(together, rows, strict=True):
            decoder.advance(row[None])
    for decoder, rows in zip(together, scores.astype(np.float32), strict=True):
        alone = Decoder(model)
        alone.advance(rows)
        assert decoder.final_path() == alone.final_path()


def test_path_since_returns_the_phones_before_the_last() -> None:
    model = topology(5, np.random.default_rng(0))
    decoder = Decoder(model)
    decoder.advance(clear_scores([3, 30, 12, 45], model, frames_per_state=2)[:35])
    assert decoder.path_since(0) == [Segment(3, 0, 10), Segment(30, 10, 20), Segment(12, 20, 30)]
    assert decoder.path_since(14) == [Segment(30, 14, 20), Segment(12, 20, 30)]
    assert segments_after([Segment(1, 0, 4)], 4) == []


def test_reset_and_no_frames() -> None:
    rng = np.random.default_rng(0)
    model = topology(2, rng, Table.draw(rng, [1, 2, SIL], order=3).tree())
    decoder = Decoder(model)
    assert decoder.final_path() == []
    first = [last_phone_after(decoder, row) for row in clear_scores([1, 2], model, 3)]
    decoder.reset()
    assert [last_phone_after(decoder, row) for row in clear_scores([1, 2], model, 3)] == first
