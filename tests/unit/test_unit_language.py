"""Back-off n-grams as a tree, as a graph and in files, against the formula."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from services.recognizer.model_file import Archive, language_arrays, language_from
from services.recognizer.unit_language import MOST_UNITS, NUM_UNITS, UnitLanguage
from tests.languages import SIL, START, Gram, Table, flat_language, step

pytestmark = pytest.mark.unit

UNITS_IN_USE = (0, 7, 21, 30, 58, SIL)
Arrays = dict[str, NDArray[Any]]


def table(seed: int, order: int, kept: float) -> Table:
    return Table.draw(np.random.default_rng(seed), UNITS_IN_USE, order=order, kept=kept)


# --- the graph


@pytest.mark.parametrize(
    ("order", "kept"), [(2, 1.0), (3, 1.0), (2, 0.5), (3, 0.3), (5, 0.6), (6, 0.4)]
)
def test_the_graph_says_what_the_formula_says(order: int, kept: float) -> None:
    wanted = table(order, order, kept)
    assert wanted.order == order
    graph = wanted.tree().graph
    rng = np.random.default_rng(0)
    for _ in range(100):
        said: tuple[int, ...] = (SIL,)
        context = START
        for unit in rng.choice(UNITS_IN_USE, 12).tolist():
            log_share, context = step(graph, context, unit)
            assert log_share == pytest.approx(wanted.after(said, unit), abs=1e-4)
            said += (unit,)


@pytest.mark.parametrize("kept", [0.3, 1.0])
def test_every_unit_has_a_context_and_a_pause_has_one_only(kept: float) -> None:
    graph = table(0, 4, kept).tree().graph
    assert graph.last_unit[1 : 1 + NUM_UNITS].tolist() == list(range(NUM_UNITS))
    assert (graph.shorter[: 1 + NUM_UNITS] == 0).all()
    np.testing.assert_array_equal(graph.last_unit[graph.arc_context], graph.arc_unit)
    assert (graph.arc_context[graph.arc_unit == SIL] == START).all()
    assert (graph.last_unit == SIL).sum() == 1
    assert len(graph.first_arc) == len(graph.last_unit) + 1
    assert graph.first_arc[-1] == len(graph.arc_unit)
    # shorter contexts come first, so that every chain of them ends in the empty one
    assert (graph.shorter[1:] < np.arange(1, len(graph.shorter))).all()


def test_a_context_with_unknown_ends_falls_back_to_what_is_known() -> None:
    """After 0 7 comes 21, but neither 7 21 nor 0 7 21 begins anything: the context is 21."""
    singles: dict[Gram, float] = {(unit,): -4.0 for unit in range(NUM_UNITS)}
    known = Table(singles | {(0, 7): -1.0, (0, 7, 21): -2.0}, {(0,): -0.5, (0, 7): -0.25})
    graph = known.tree().graph
    _, at = step(graph, 1 + 0, 7)
    assert at == 1 + NUM_UNITS  # the only context of two units
    assert graph.shorter[at] == 1 + 7
    assert step(graph, at, 21) == (-2.0, 1 + 21)
    assert step(graph, at, 30) == (-0.25 - 4.0, 1 + 30)


def test_levels() -> None:
    assert flat_language().levels == [0, 1, 1 + NUM_UNITS]
    assert len(table(0, 5, 1.0).tree().levels) == 7
    wanted = table(0, 3, 0.5)
    assert Table.of(wanted.tree()).log_share == pytest.approx(wanted.log_share, abs=1e-5)


# --- files


def changed(change: Callable[[Arrays], None]) -> UnitLanguage:
    arrays = {
        name: array.copy() for name, array in language_arrays(table(0, 3, 0.5).tree()).items()
    }
    change(arrays)
    return language_from(Archive(arrays))


def test_a_language_comes_back_from_its_arrays() -> None:
    language = table(1, 4, 0.6).tree()
    assert language.log_share.min() >= -12.75
    assert np.abs(language.log_back_off).max() <= 6.35
    again = language_from(Archive(language_arrays(language)))
    np.testing.assert_array_equal(again.num_children, language.num_children)
    np.testing.assert_array_equal(again.unit, language.unit)
    np.testing.assert_allclose(again.log_share, language.log_share, atol=0.025 + 1e-5)
    np.testing.assert_allclose(again.log_back_off, language.log_back_off, atol=0.025 + 1e-5)
    stored = language_arrays(again)
    for name, array in language_arrays(language).items():
        np.testing.assert_array_equal(stored[name], array)


def test_what_is_hardly_likely_is_kept_as_that() -> None:
    singles: dict[Gram, float] = {(unit,): -100.0 for unit in range(NUM_UNITS)}
    language = Table(singles, {(0,): -100.0, (1,): 100.0}).tree()
    again = language_from(Archive(language_arrays(language)))
    np.testing.assert_allclose(again.log_share[1:], -12.75, rtol=1e-6)
    np.testing.assert_allclose(again.log_back_off[1:4], [-6.35, 6.35, 0.0], rtol=1e-6)


def root_without_a_child(arrays: Arrays) -> None:
    arrays["language_children"][:2] = [NUM_UNITS - 1, arrays["language_children"][1] + 1]


def one_child_more(arrays: Arrays) -> None:
    arrays["language_children"][-1] += 1


def one_child_less(arrays: Arrays) -> None:
    arrays["language_children"][1] -= 1


def negative_child(arrays: Arrays) -> None:
    children = arrays["language_children"].astype(np.int64)
    children[-2:] = [-1, 1]
    arrays["language_children"] = children


def child_of_itself(arrays: Arrays) -> None:
    """The numbers add up, but no level follows the first."""
    arrays["language_children"] = np.array([NUM_UNITS, *[0] * NUM_UNITS, 1])


def child_before_its_parent(arrays: Arrays) -> None:
    arrays["language_children"] = np.array([NUM_UNITS, *[0] * NUM_UNITS, 0, 3, 0])


def too_many_to_add_up(arrays: Arrays) -> None:
    children = np.zeros(1 + NUM_UNITS, np.int64)
    children[:5] = [NUM_UNITS, *[2**62] * 4]  # their sum is 60 in 64 bits
    arrays["language_children"] = children


def no_list(arrays: Arrays) -> None:
    arrays["language_children"] = arrays["language_children"][None]


def too_few(arrays: Arrays) -> None:
    arrays["language_children"] = np.zeros(NUM_UNITS, np.uint8)


def empty(arrays: Arrays) -> None:
    arrays["language_children"] = np.zeros(0, np.uint8)


def no_counts(arrays: Arrays) -> None:
    arrays["language_children"] = np.array(["many"] * 100)


def swapped_units(arrays: Arrays) -> None:
    arrays["language_unit"][[3, 4]] = arrays["language_unit"][[4, 3]]


def unit_twice(arrays: Arrays) -> None:
    arrays["language_unit"][4] = arrays["language_unit"][3]


def unit_60(arrays: Arrays) -> None:
    arrays["language_unit"][NUM_UNITS] = 60


def unit_below_none(arrays: Arrays) -> None:
    units = arrays["language_unit"].astype(np.int64)
    units[1] = -1
    arrays["language_unit"] = units


def one_unit_less(arrays: Arrays) -> None:
    arrays["language_unit"] = arrays["language_unit"][:-1]


def one_share_less(arrays: Arrays) -> None:
    arrays["language_share"] = arrays["language_share"][:-1]


def one_back_off_less(arrays: Arrays) -> None:
    arrays["language_back_off"] = arrays["language_back_off"][:-1]


def share_that_is_no_number(arrays: Arrays) -> None:
    arrays["language_share"] = np.full(arrays["language_share"].shape, np.nan)


def no_back_off(arrays: Arrays) -> None:
    del arrays["language_back_off"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (root_without_a_child, "no tree"),
        (one_child_more, "no tree"),
        (one_child_less, "no tree"),
        (negative_child, "no tree"),
        (child_of_itself, "no tree"),
        (child_before_its_parent, "no tree"),
        (too_many_to_add_up, "no tree"),
        (no_list, r"of shape \(1, "),
        (too_few, r"of shape \(60,\)"),
        (empty, r"of shape \(0,\)"),
        (no_counts, "many"),
        (swapped_units, "not in order"),
        (unit_twice, "not in order"),
        (unit_60, "not in order"),
        (unit_below_none, "not in order"),
        (one_unit_less, "language_unit has shape"),
        (one_share_less, "language_share has shape"),
        (one_back_off_less, "language_back_off has shape"),
        (share_that_is_no_number, "no numbers"),
        (no_back_off, "language_back_off is missing"),
    ],
)
def test_damaged_arrays_are_refused(change: Callable[[Arrays], None], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        changed(change)


@pytest.mark.parametrize("num_units", [MOST_UNITS, MOST_UNITS + 1])
def test_the_longest_n_gram_has_its_bound(num_units: int) -> None:
    grams: dict[Gram, float] = {(unit,): -1.0 for unit in range(NUM_UNITS)}
    grams |= {(0,) * length: -1.0 for length in range(2, num_units + 1)}
    arrays = language_arrays(Table(grams, {}).tree())
    if num_units > MOST_UNITS:
        with pytest.raises(ValueError, match="more than 16 units"):
            language_from(Archive(arrays))
    else:
        graph = language_from(Archive(arrays)).graph
        assert len(graph.last_unit) == NUM_UNITS + MOST_UNITS - 1
