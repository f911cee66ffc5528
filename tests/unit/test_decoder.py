"""The search against brute force on models small enough to try every path."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from services.recognizer import decoder as search
from services.recognizer.acoustic_model import NUM_POSITIONS, Topology
from services.recognizer.decoder import Decoder, Segment, segments_after
from services.recognizer.unit_language import NUM_UNITS, UnitLanguage
from tests.languages import SIL, Gram, Table, flat_language

pytestmark = pytest.mark.unit


def topology(
    states_per_unit: int, rng: np.random.Generator, language: UnitLanguage | None = None
) -> Topology:
    num_states = NUM_UNITS * states_per_unit
    stay = rng.uniform(0.2, 0.8, num_states)
    return Topology(
        first_state=np.arange(NUM_UNITS + 1) * states_per_unit,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        language=language or flat_language(),
        duration_mean_s=np.full((NUM_POSITIONS, NUM_UNITS), 0.1, np.float32),
        duration_spread_s=np.full((NUM_POSITIONS, NUM_UNITS), 0.1, np.float32),
    )


def only(units: list[int], states_per_unit: int, scores: NDArray[np.float32]) -> None:
    """Make all other units impossible."""
    for unit in range(NUM_UNITS):
        if unit not in units:
            scores[:, unit * states_per_unit : (unit + 1) * states_per_unit] = -1e4


@dataclass(frozen=True)
class Path:
    """A path up to a frame."""

    score: float
    ended: tuple[Segment, ...]
    unit: int
    state: int  # of the unit
    start: int  # of the unit


def brute_force(
    model: Topology, table: Table, scores: NDArray[np.float32], units: list[int]
) -> list[Segment]:
    """Try every path that the loop allows."""

    def cost(said: tuple[int, ...], unit: int) -> float:
        log_share = 0.0 if said == (SIL,) and unit == SIL else table.after(said, unit)
        return model.language_scale * log_share + model.unit_penalty

    paths = [Path(cost((SIL,), unit), (), unit, 0, 0) for unit in units]
    for frame, observed in enumerate(scores):
        longer = []
        for path in paths:
            place = int(model.first_state[path.unit]) + path.state
            score = path.score + float(observed[place])
            left = score + float(model.log_leave[place])
            longer.append(replace(path, score=score + float(model.log_stay[place])))
            if place + 1 < model.first_state[path.unit + 1]:
                longer.append(replace(path, score=left, state=path.state + 1))
                continue
            ended = (*path.ended, Segment(path.unit, path.start, frame + 1))
            said = (SIL, *(segment.unit for segment in ended))
            longer += [
                Path(left + (cost(said, unit) if frame + 1 < len(scores) else 0.0), ended, unit, 0,
                     frame + 1)
                for unit in units
            ]  # fmt: skip
        paths = longer
    complete = [path for path in paths if path.start == len(scores)]
    return list(max(complete, key=lambda path: path.score).ended)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("order", "kept", "states_per_unit", "num_frames"),
    [(2, 1.0, 2, 8), (2, 1.0, 3, 9), (3, 1.0, 2, 9), (3, 0.5, 2, 9), (4, 0.6, 1, 7)],
)
def test_same_as_trying_every_path(
    seed: int, order: int, kept: float, states_per_unit: int, num_frames: int
) -> None:
    rng = np.random.default_rng(seed)
    units = [3, 40, SIL]
    table = Table.draw(rng, units, order=order, kept=kept)
    model = replace(
        topology(states_per_unit, rng, table.tree()), language_scale=1.5, unit_penalty=1.25
    )
    scores = rng.normal(size=(num_frames, model.num_states)).astype(np.float32)
    only(units, states_per_unit, scores)
    decoder = Decoder(model)
    for row in scores:
        decoder.accept(row)
    assert decoder.finish() == brute_force(model, table, scores, units)


def clear_scores(
    sequence: list[int], model: Topology, frames_per_state: int, contrast: float = 50.0
) -> NDArray[np.float32]:
    """Scores that leave no doubt."""
    rows = []
    for unit in sequence:
        for state in range(model.first_state[unit], model.first_state[unit + 1]):
            row = np.full(model.num_states, -contrast, np.float32)
            row[state] = 0.0
            rows += [row] * frames_per_state
    return np.array(rows)


def test_clear_speech_is_read_off() -> None:
    model = topology(5, np.random.default_rng(0))
    sequence = [SIL, 3, 30, 12, 45, SIL]
    decoder = Decoder(model)
    scores = clear_scores(sequence, model, frames_per_state=2)
    last = [decoder.accept(row) for row in scores]
    assert [segment.unit for segment in decoder.finish()] == sequence
    assert [(s.start, s.end) for s in decoder.finish()] == [(t, t + 10) for t in range(0, 60, 10)]
    # the last unit of the best string, and where it began
    assert [unit for unit, _, _ in last[::10]] == sequence
    assert last[25][:2] == (30, 20)
    assert all(0 < confidence <= 1 for _, _, confidence in last)


def test_speech_cut_off_inside_a_unit_keeps_what_came_before() -> None:
    model = topology(5, np.random.default_rng(0))
    decoder = Decoder(model)
    for row in clear_scores([3, 30, 12], model, frames_per_state=2)[:23]:
        decoder.accept(row)
    assert decoder.finish() == [Segment(3, 0, 10), Segment(30, 10, 20), Segment(12, 20, 23)]


def test_what_was_said_tells_what_is_heard() -> None:
    """Of 30 and 31 nothing is heard; after 3 comes the one, after 4 the other."""
    units: dict[Gram, float] = {(unit,): -4.0 for unit in range(NUM_UNITS)}
    language = Table(units | {(3, 30): -0.1, (4, 31): -0.1}, {(3,): -3.0, (4,): -3.0}).tree()
    model = topology(3, np.random.default_rng(0), language)
    decoder = Decoder(model)
    scores = clear_scores([3, 30, 4, 30], model, frames_per_state=2)
    for unit in (30, 31):
        states = slice(model.first_state[unit], model.first_state[unit + 1])
        scores[6:12, states] = scores[18:, states] = 0.0
    for row in scores:
        decoder.accept(row)
    assert [segment.unit for segment in decoder.finish()] == [3, 30, 4, 31]


def test_endless_speech_keeps_its_memory_and_its_result() -> None:
    rng = np.random.default_rng(1)
    model = topology(5, rng)
    sequence = rng.permutation(np.arange(SIL)).tolist() * 8  # 472 units, 4720 frames
    decoder = Decoder(model)
    for row in clear_scores(sequence, model, frames_per_state=2, contrast=2.0):
        decoder.accept(row)
    assert len(decoder._settled) > 300
    assert len(decoder._records) < 2 * search._ROOM
    assert [segment.unit for segment in decoder.finish()] == sequence
    assert [segment.unit for segment in decoder.path_since(4000)] == sequence[400:-1]


def crowded_language() -> UnitLanguage:
    """Know all strings of three units but for pauses, and one more after each, all as likely."""
    units = [np.zeros(1, np.uint8)]
    children = [np.array([NUM_UNITS], np.uint8)]
    for num_children in (NUM_UNITS, NUM_UNITS, 1, 0):
        parents = children[-1]
        units.append(np.concatenate([np.arange(n) for n in parents]).astype(np.uint8))
        begins = (units[-1] != SIL) | (len(units) == 2)
        children.append(np.where(begins, num_children, 0).astype(np.uint8))
    unit = np.concatenate(units)
    return UnitLanguage(
        num_children=np.concatenate(children),
        unit=unit,
        log_share=np.full(len(unit), -np.log(NUM_UNITS), np.float32),
        log_back_off=np.zeros(len(unit), np.float32),
    )


def test_a_crowd_of_paths_stays_within_its_bound() -> None:
    language = crowded_language()
    assert len(language.graph.last_unit) > 200_000
    model = topology(1, np.random.default_rng(0), language)
    decoder = Decoder(model)
    most = 0
    for _ in range(60):
        unit, start, confidence = decoder.accept(np.zeros(model.num_states, np.float32))
        assert 0 <= unit < NUM_UNITS
        assert 0 <= start < decoder.num_frames
        assert 0 < confidence <= 1
        most = max(most, decoder._num_tokens)
        assert len(decoder._records) <= 2 * search._ROOM
        in_use = np.flatnonzero(decoder._token_of != search._NOWHERE)
        assert sorted(decoder._context[: decoder._num_tokens]) == in_use.tolist()
    assert most == search._MOST_TOKENS
    path = decoder.finish()
    assert (path[0].start, path[-1].end) == (0, 60)
    assert all(one.end == two.start for one, two in pairwise(path))


def test_path_since_gives_the_units_before_the_last() -> None:
    model = topology(5, np.random.default_rng(0))
    decoder = Decoder(model)
    for row in clear_scores([3, 30, 12, 45], model, frames_per_state=2)[:35]:
        decoder.accept(row)
    assert decoder.path_since(0) == [Segment(3, 0, 10), Segment(30, 10, 20), Segment(12, 20, 30)]
    assert decoder.path_since(14) == [Segment(30, 14, 20), Segment(12, 20, 30)]
    assert segments_after([Segment(1, 0, 4)], 4) == []


def test_reset_and_nothing_heard() -> None:
    rng = np.random.default_rng(0)
    model = topology(2, rng, Table.draw(rng, [1, 2, SIL], order=3).tree())
    decoder = Decoder(model)
    assert decoder.finish() == []
    first = [decoder.accept(row) for row in clear_scores([1, 2], model, 3)]
    decoder.reset()
    assert [decoder.accept(row) for row in clear_scores([1, 2], model, 3)] == first
