"""The search against brute force on models small enough to try every path."""

import itertools

import numpy as np
import pytest
from numpy.typing import NDArray

from services.recognizer.acoustic_model import NUM_POSITIONS, Topology
from services.recognizer.decoder import NUM_UNITS, Decoder, Segment, segments_after
from shared.phones import UNIT_INDEX

pytestmark = pytest.mark.unit

SIL = UNIT_INDEX["sil"]


def topology(
    states_per_unit: int,
    rng: np.random.Generator,
    bigram_scale: float = 1.0,
    units_before: int = 1,
) -> Topology:
    num_states = NUM_UNITS * states_per_unit
    stay = rng.uniform(0.2, 0.8, num_states)
    return Topology(
        first_state=np.arange(NUM_UNITS + 1) * states_per_unit,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        log_bigram=(bigram_scale * rng.normal(size=(NUM_UNITS,) * (units_before + 1))).astype(
            np.float32
        ),
        duration_mean_s=np.full((NUM_POSITIONS, NUM_UNITS), 0.1, np.float32),
        duration_spread_s=np.full((NUM_POSITIONS, NUM_UNITS), 0.1, np.float32),
    )


def only(units: list[int], states_per_unit: int, scores: NDArray[np.float32]) -> None:
    """Make all other units impossible."""
    for unit in range(NUM_UNITS):
        if unit not in units:
            scores[:, unit * states_per_unit : (unit + 1) * states_per_unit] = -1e4


def brute_force(
    model: Topology, scores: NDArray[np.float32], units: list[int], states_per_unit: int
) -> tuple[float, list[Segment]]:
    """Score every sequence of states that the loop allows."""
    log_next = np.broadcast_to(model.log_bigram, (NUM_UNITS,) * 3)
    states = [u * states_per_unit + k for u in units for k in range(states_per_unit)]
    best = -np.inf
    path: tuple[int, ...] = ()
    for sequence in itertools.product(states, repeat=len(scores)):
        if sequence[0] % states_per_unit or sequence[-1] % states_per_unit != states_per_unit - 1:
            continue
        before, unit = SIL, sequence[0] // states_per_unit
        total = log_next[SIL, SIL, unit] + scores[0, sequence[0]]
        for t in range(1, len(scores)):
            a, b = sequence[t - 1], sequence[t]
            if a == b:
                # a unit of one state may also follow itself; staying is what this path means
                total += model.log_stay[a]
            elif b == a + 1 and b % states_per_unit:
                total += model.log_leave[a]
            elif a % states_per_unit == states_per_unit - 1 and b % states_per_unit == 0:
                total += model.log_leave[a]
                total += log_next[before, unit, b // states_per_unit]
                before, unit = unit, b // states_per_unit
            else:
                total = -np.inf
                break
            total += scores[t, b]
        total += model.log_leave[sequence[-1]]
        if total > best:
            best, path = total, sequence
    units_of_frames = [state // states_per_unit for state in path]
    starts = [0] + [
        t for t in range(1, len(path)) if path[t] % states_per_unit == 0 and path[t] != path[t - 1]
    ]
    ends = [*starts[1:], len(path)]
    return best, [Segment(units_of_frames[s], s, e) for s, e in zip(starts, ends, strict=True)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("states_per_unit", "num_frames", "units_before"), [(2, 5, 1), (3, 5, 1), (2, 7, 2)]
)
def test_same_as_trying_every_path(
    seed: int, states_per_unit: int, num_frames: int, units_before: int
) -> None:
    rng = np.random.default_rng(seed)
    units = [0, 7, SIL] if (states_per_unit, num_frames) == (2, 5) else [3, 40]
    model = topology(states_per_unit, rng, bigram_scale=units_before, units_before=units_before)
    scores = rng.normal(size=(num_frames, model.num_states)).astype(np.float32)
    only(units, states_per_unit, scores)
    decoder = Decoder(model)
    for row in scores:
        decoder.accept(row)
    _, expected = brute_force(model, scores, units, states_per_unit)
    assert decoder.finish() == expected


def clear_scores(
    sequence: list[int], model: Topology, frames_per_state: int
) -> NDArray[np.float32]:
    """Scores that leave no doubt."""
    rows = []
    for unit in sequence:
        for state in range(model.first_state[unit], model.first_state[unit + 1]):
            row = np.full(model.num_states, -50.0, np.float32)
            row[state] = 0.0
            rows += [row] * frames_per_state
    return np.array(rows)


def test_clear_speech_is_read_off() -> None:
    model = topology(5, np.random.default_rng(0), bigram_scale=0.0)
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


def test_endless_speech_keeps_its_memory_and_its_result() -> None:
    rng = np.random.default_rng(1)
    model = topology(5, rng, bigram_scale=0.0)
    sequence = rng.permutation(np.arange(SIL)).tolist() * 8  # 472 units, 4720 frames
    decoder = Decoder(model)
    for row in clear_scores(sequence, model, frames_per_state=2):
        decoder.accept(row)
    assert len(decoder._records) < 3 * NUM_UNITS**2
    assert [segment.unit for segment in decoder.finish()] == sequence


def test_path_since_gives_the_units_before_the_last() -> None:
    model = topology(5, np.random.default_rng(0), bigram_scale=0.0)
    decoder = Decoder(model)
    for row in clear_scores([3, 30, 12, 45], model, frames_per_state=2)[:35]:
        decoder.accept(row)
    assert decoder.path_since(0) == [Segment(3, 0, 10), Segment(30, 10, 20), Segment(12, 20, 30)]
    assert decoder.path_since(14) == [Segment(30, 14, 20), Segment(12, 20, 30)]
    assert segments_after([Segment(1, 0, 4)], 4) == []


def test_reset_and_nothing_heard() -> None:
    model = topology(2, np.random.default_rng(0))
    decoder = Decoder(model)
    assert decoder.finish() == []
    first = [decoder.accept(row) for row in clear_scores([1, 2], model, 3)]
    decoder.reset()
    assert [decoder.accept(row) for row in clear_scores([1, 2], model, 3)] == first
