"""Back-off n-grams as a tree, as a graph and in files, against the formula."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.model_file import Archive, phone_lm_arrays, phone_lm_from
from kouxing.services.recognizer.search.phone_lm import MAX_ORDER, PhoneLanguageModel
from tests.languages import NUM_PHONES, SIL, START, Gram, Table, flat_language, step

pytestmark = pytest.mark.unit

PHONES_IN_USE = (0, 7, 21, 30, 58, SIL)
Arrays = dict[str, NDArray[Any]]


def table(seed: int, order: int, kept: float) -> Table:
    return Table.draw(np.random.default_rng(seed), PHONES_IN_USE, order=order, kept=kept)


# --- the graph


@pytest.mark.parametrize(
    ("order", "kept"), [(2, 1.0), (3, 1.0), (2, 0.5), (3, 0.3), (5, 0.6), (6, 0.4)]
)
def test_graph_matches_the_formula(order: int, kept: float) -> None:
    wanted = table(order, order, kept)
    assert wanted.order == order
    graph = wanted.tree().graph
    rng = np.random.default_rng(0)
    for _ in range(100):
        before: tuple[int, ...] = (SIL,)
        context = START
        for phone in rng.choice(PHONES_IN_USE, 12).tolist():
            log_prob, context = step(graph, context, phone)
            assert log_prob == pytest.approx(wanted.after(before, phone), abs=1e-4)
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
    # shorter contexts come first, so that every chain of them ends in the empty one
    assert (graph.backoff_state[1:] < np.arange(1, len(graph.backoff_state))).all()


def test_unknown_contexts_back_off() -> None:
    """After 0 7 comes 21, but neither 7 21 nor 0 7 21 begins anything: the context is 21."""
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
    wanted = table(0, 3, 0.5)
    assert Table.of(wanted.tree()).log_prob == pytest.approx(wanted.log_prob, abs=1e-5)


# --- files


def changed(change: Callable[[Arrays], None]) -> PhoneLanguageModel:
    arrays = {
        name: array.copy() for name, array in phone_lm_arrays(table(0, 3, 0.5).tree()).items()
    }
    change(arrays)
    return phone_lm_from(Archive(arrays))


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


def root_without_a_child(arrays: Arrays) -> None:
    arrays["lm_children"][:2] = [NUM_PHONES - 1, arrays["lm_children"][1] + 1]


def one_child_more(arrays: Arrays) -> None:
    arrays["lm_children"][-1] += 1


def one_child_less(arrays: Arrays) -> None:
    arrays["lm_children"][1] -= 1


def negative_child(arrays: Arrays) -> None:
    children = arrays["lm_children"].astype(np.int64)
    children[-2:] = [-1, 1]
    arrays["lm_children"] = children


def child_of_itself(arrays: Arrays) -> None:
    """The numbers add up, but no level follows the first."""
    arrays["lm_children"] = np.array([NUM_PHONES, *[0] * NUM_PHONES, 1])


def child_before_its_parent(arrays: Arrays) -> None:
    arrays["lm_children"] = np.array([NUM_PHONES, *[0] * NUM_PHONES, 0, 3, 0])


def too_many_to_add_up(arrays: Arrays) -> None:
    children = np.zeros(1 + NUM_PHONES, np.int64)
    children[:5] = [NUM_PHONES, *[2**62] * 4]  # their sum is 60 in 64 bits
    arrays["lm_children"] = children


def no_list(arrays: Arrays) -> None:
    arrays["lm_children"] = arrays["lm_children"][None]


def too_few(arrays: Arrays) -> None:
    arrays["lm_children"] = np.zeros(NUM_PHONES, np.uint8)


def empty(arrays: Arrays) -> None:
    arrays["lm_children"] = np.zeros(0, np.uint8)


def no_counts(arrays: Arrays) -> None:
    arrays["lm_children"] = np.array(["many"] * 100)


def swapped_phones(arrays: Arrays) -> None:
    arrays["lm_phone"][[3, 4]] = arrays["lm_phone"][[4, 3]]


def phone_twice(arrays: Arrays) -> None:
    arrays["lm_phone"][4] = arrays["lm_phone"][3]


def phone_60(arrays: Arrays) -> None:
    arrays["lm_phone"][NUM_PHONES] = 60


def phone_below_none(arrays: Arrays) -> None:
    phones = arrays["lm_phone"].astype(np.int64)
    phones[1] = -1
    arrays["lm_phone"] = phones


def one_phone_less(arrays: Arrays) -> None:
    arrays["lm_phone"] = arrays["lm_phone"][:-1]


def one_log_prob_less(arrays: Arrays) -> None:
    arrays["lm_log_prob"] = arrays["lm_log_prob"][:-1]


def one_backoff_less(arrays: Arrays) -> None:
    arrays["lm_log_backoff"] = arrays["lm_log_backoff"][:-1]


def log_prob_that_is_not_finite(arrays: Arrays) -> None:
    arrays["lm_log_prob"] = np.full(arrays["lm_log_prob"].shape, np.nan)


def no_backoff(arrays: Arrays) -> None:
    del arrays["lm_log_backoff"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (root_without_a_child, "not a tree"),
        (one_child_more, "not a tree"),
        (one_child_less, "not a tree"),
        (negative_child, "not a tree"),
        (child_of_itself, "not a tree"),
        (child_before_its_parent, "not a tree"),
        (too_many_to_add_up, "not a tree"),
        (no_list, r"has shape \(1, "),
        (too_few, r"has shape \(60,\)"),
        (empty, r"has shape \(0,\)"),
        (no_counts, "many"),
        (swapped_phones, "not in order"),
        (phone_twice, "not in order"),
        (phone_60, "not in order"),
        (phone_below_none, "not in order"),
        (one_phone_less, "lm_phone has shape"),
        (one_log_prob_less, "lm_log_prob has shape"),
        (one_backoff_less, "lm_log_backoff has shape"),
        (log_prob_that_is_not_finite, "not finite"),
        (no_backoff, "lm_log_backoff is missing"),
    ],
)
def test_rejects_damaged_arrays(change: Callable[[Arrays], None], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        changed(change)


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
