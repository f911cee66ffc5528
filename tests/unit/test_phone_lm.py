"""Back-off n-grams: the graph, compared with the formula, and the file."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.model_file import Archive, phone_lm_arrays, phone_lm_from
from kouxing.services.recognizer.search.phone_lm import MAX_ORDER
from tests.languages import NUM_PHONES, SIL, START, Gram, Table, flat_language, step

pytestmark = pytest.mark.unit

PHONES_IN_USE = (0, 7, 21, 30, 58, SIL)


def table(seed: int, order: int, kept: float) -> Table:
    return Table.draw(np.random.default_rng(seed), PHONES_IN_USE, order=order, kept=kept)


@pytest.mark.parametrize(
    ("order", "kept"), [(2, 1.0), (3, 1.0), (2, 0.5), (3, 0.3), (5, 0.6), (6, 0.4)]
)
def test_graph_matches_the_formula(order: int, kept: float) -> None:
    expected = table(order, order, kept)
    assert expected.order == order
    graph = expected.tree().graph
    rng = np.random.default_rng(0)
    for _ in range(100):
        before: tuple[int, ...] = (SIL,)
        context = START
        for phone in rng.choice(PHONES_IN_USE, 12).tolist():
            log_prob, context = step(graph, context, phone)
            assert log_prob == pytest.approx(expected.after(before, phone), abs=1e-4)
            before += (phone,)


@pytest.mark.parametrize("kept", [0.3, 1.0])
def test_every_phone_has_a_context(kept: float) -> None:
    graph = table(0, 4, kept).tree().graph
    assert graph.last_phone[1 : 1 + NUM_PHONES].tolist() == list(range(NUM_PHONES))
    assert (graph.backoff_state[: 1 + NUM_PHONES] == 0).all()
    np.testing.assert_array_equal(graph.last_phone[graph.arc_context], graph.arc_phone)
    assert (graph.arc_context[graph.arc_phone == SIL] == START).all()
    assert (graph.last_phone == SIL).sum() == 1
    assert len(graph.first_arc) == len(graph.last_phone) + 1
    assert graph.first_arc[-1] == len(graph.arc_phone)
    # shorter contexts precede longer ones, so every chain ends in the empty context
    assert (graph.backoff_state[1:] < np.arange(1, len(graph.backoff_state))).all()


def test_unknown_contexts_back_off() -> None:
    """No n-gram starts with 7 21 or 0 7 21. So after 0 7 21, the context is 21."""
    singles: dict[Gram, float] = {(phone,): -4.0 for phone in range(NUM_PHONES)}
    known = Table(singles | {(0, 7): -1.0, (0, 7, 21): -2.0}, {(0,): -0.5, (0, 7): -0.25})
    graph = known.tree().graph
    _, at = step(graph, 1 + 0, 7)
    assert at == 1 + NUM_PHONES  # the only context of two phones
    assert graph.backoff_state[at] == 1 + 7
    assert step(graph, at, 21) == (-2.0, 1 + 21)
    assert step(graph, at, 30) == (-0.25 - 4.0, 1 + 30)


def test_levels() -> None:
    assert flat_language().levels == [0, 1, 1 + NUM_PHONES]
    assert len(table(0, 5, 1.0).tree().levels) == 7
    expected = table(0, 3, 0.5)
    assert Table.of(expected.tree()).log_prob == pytest.approx(expected.log_prob, abs=1e-5)


def test_arrays_round_trip() -> None:
    phone_lm = table(1, 4, 0.6).tree()
    assert phone_lm.log_prob.min() >= -12.75
    assert np.abs(phone_lm.log_backoff).max() <= 6.35
    again = phone_lm_from(Archive(phone_lm_arrays(phone_lm)))
    np.testing.assert_array_equal(again.num_children, phone_lm.num_children)
    np.testing.assert_array_equal(again.phone, phone_lm.phone)
    np.testing.assert_allclose(again.log_prob, phone_lm.log_prob, atol=0.025 + 1e-5)
    np.testing.assert_allclose(again.log_backoff, phone_lm.log_backoff, atol=0.025 + 1e-5)
    stored = phone_lm_arrays(again)
    for name, array in phone_lm_arrays(phone_lm).items():
        np.testing.assert_array_equal(stored[name], array)


def test_clips_unlikely_n_grams() -> None:
    singles: dict[Gram, float] = {(phone,): -100.0 for phone in range(NUM_PHONES)}
    phone_lm = Table(singles, {(0,): -100.0, (1,): 100.0}).tree()
    again = phone_lm_from(Archive(phone_lm_arrays(phone_lm)))
    np.testing.assert_allclose(again.log_prob[1:], -12.75, rtol=1e-6)
    np.testing.assert_allclose(again.log_backoff[1:4], [-6.35, 6.35, 0.0], rtol=1e-6)


def with_values(array: NDArray[Any], values: dict[int, int]) -> NDArray[Any]:
    array = array.astype(np.int64)
    for index, value in values.items():
        array[index] = value
    return array


LEAVES = [0] * NUM_PHONES
Change = Callable[[NDArray[Any]], NDArray[Any]]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        # the numbers of children
        ("lm_children", lambda c: with_values(c, {0: c[0] - 1, 1: c[1] + 1}), "not a tree"),
        ("lm_children", lambda c: with_values(c, {-1: c[-1] + 1}), "not a tree"),
        ("lm_children", lambda c: with_values(c, {1: c[1] - 1}), "not a tree"),
        ("lm_children", lambda c: with_values(c, {-2: -1, -1: 1}), "not a tree"),
        # the sums are right: a node that is its own child, and a child before its parent
        ("lm_children", lambda _: np.array([NUM_PHONES, *LEAVES, 1]), "not a tree"),
        ("lm_children", lambda _: np.array([NUM_PHONES, *LEAVES, 0, 3, 0]), "not a tree"),
        # a sum that overflows to the right one
        ("lm_children", lambda _: np.array([NUM_PHONES, *[2**62] * 4, *LEAVES[4:]]), "not a tree"),
        ("lm_children", lambda c: c[None], r"has shape \(1, "),
        ("lm_children", lambda _: np.zeros(NUM_PHONES, np.uint8), r"has shape \(60,\)"),
        ("lm_children", lambda _: np.zeros(0, np.uint8), r"has shape \(0,\)"),
        ("lm_children", lambda _: np.array(["many"] * 100), "many"),
        ("lm_phone", lambda p: with_values(p, {3: p[4], 4: p[3]}), "not in order"),
        ("lm_phone", lambda p: with_values(p, {4: p[3]}), "not in order"),
        ("lm_phone", lambda p: with_values(p, {NUM_PHONES: 60}), "not in order"),
        ("lm_phone", lambda p: with_values(p, {1: -1}), "not in order"),
        ("lm_phone", lambda p: p[:-1], "lm_phone has shape"),
        ("lm_log_prob", lambda values: values[:-1], "lm_log_prob has shape"),
        ("lm_log_prob", lambda values: np.full(values.shape, np.nan), "not finite"),
        ("lm_log_backoff", lambda values: values[:-1], "lm_log_backoff has shape"),
    ],
)
def test_rejects_damaged_arrays(name: str, change: Change, message: str) -> None:
    arrays = phone_lm_arrays(table(0, 3, 0.5).tree())
    with pytest.raises(ValueError, match=message):
        phone_lm_from(Archive({**arrays, name: change(arrays[name])}))


def test_rejects_a_missing_array() -> None:
    arrays = phone_lm_arrays(table(0, 3, 0.5).tree())
    del arrays["lm_log_backoff"]
    with pytest.raises(ValueError, match="lm_log_backoff is missing"):
        phone_lm_from(Archive(arrays))


@pytest.mark.parametrize("num_phones", [MAX_ORDER, MAX_ORDER + 1])
def test_limits_the_order(num_phones: int) -> None:
    grams: dict[Gram, float] = {(phone,): -1.0 for phone in range(NUM_PHONES)}
    grams |= {(0,) * length: -1.0 for length in range(2, num_phones + 1)}
    arrays = phone_lm_arrays(Table(grams, {}).tree())
    if num_phones > MAX_ORDER:
        with pytest.raises(ValueError, match="more than 16 phones"):
            phone_lm_from(Archive(arrays))
    else:
        graph = phone_lm_from(Archive(arrays)).graph
        assert len(graph.last_phone) == NUM_PHONES + MAX_ORDER - 1
