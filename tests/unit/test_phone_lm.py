"""Back-off n-grams: the graph, compared with the formula, and the file."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.model_file import Archive, parse_phone_lm, phone_lm_arrays
from tests.languages import NUM_PHONES, SIL, START, Table, step

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


def test_arrays_round_trip() -> None:
    phone_lm = table(1, 4, 0.6).tree()
    assert phone_lm.log_prob.min() >= -12.75
    assert np.abs(phone_lm.log_backoff).max() <= 6.35
    again = parse_phone_lm(Archive(phone_lm_arrays(phone_lm)))
    np.testing.assert_array_equal(again.num_children, phone_lm.num_children)
    np.testing.assert_array_equal(again.phone, phone_lm.phone)
    np.testing.assert_allclose(again.log_prob, phone_lm.log_prob, atol=0.025 + 1e-5)
    np.testing.assert_allclose(again.log_backoff, phone_lm.log_backoff, atol=0.025 + 1e-5)
    stored = phone_lm_arrays(again)
    for name, array in phone_lm_arrays(phone_lm).items():
        np.testing.assert_array_equal(stored[name], array)


def with_values(array: NDArray[Any], values: dict[int, int]) -> NDArray[Any]:
    array = array.astype(np.int64)
    for index, value in values.items():
        array[index] = value
    return array


NO_CHILDREN = [0] * NUM_PHONES
ArrayChange = Callable[[NDArray[Any]], NDArray[Any]]


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("lm_children", lambda c: with_values(c, {0: c[0] - 1, 1: c[1] + 1}), "not form a tree"),
        # the sum is right, but a child is before its parent
        ("lm_children", lambda _: np.array([NUM_PHONES, *NO_CHILDREN, 0, 3, 0]), "not form a tree"),
        # a sum that overflows to the right one
        (
            "lm_children",
            lambda _: np.array([NUM_PHONES, *[2**62] * 4, *NO_CHILDREN[4:]]),
            "not form a tree",
        ),
        ("lm_phone", lambda p: with_values(p, {3: p[4], 4: p[3]}), "not in order"),
        ("lm_phone", lambda p: with_values(p, {NUM_PHONES: 60}), "not in order"),
        ("lm_log_prob", lambda values: np.full(values.shape, np.nan), "not finite"),
        ("lm_log_backoff", lambda values: values[:-1], "lm_log_backoff has shape"),
    ],
)
def test_rejects_damaged_arrays(name: str, change: ArrayChange, message: str) -> None:
    arrays = phone_lm_arrays(table(0, 3, 0.5).tree())
    with pytest.raises(ValueError, match=message):
        parse_phone_lm(Archive({**arrays, name: change(arrays[name])}))
