"""Renumbering of phones from successive recognizers."""

from __future__ import annotations

import pytest

from kouxing.services.synthesizer.phone_numbers import PhoneNumbers
from tests.lips import phone

pytestmark = pytest.mark.unit


@pytest.fixture
def numbers() -> PhoneNumbers:
    """Return the state after a recognizer with two phones, one of them final, is lost."""
    numbers = PhoneNumbers()
    assert numbers.renumber(phone(0, "d", 1.0)).index == 0
    assert numbers.renumber(phone(1, "a", 1.1, final=False)).index == 1
    numbers.restart()
    return numbers


def test_the_next_recognizer_gets_new_indices(numbers: PhoneNumbers) -> None:
    assert [numbers.renumber(phone(index, "i", 2.0 + index)).index for index in (0, 1)] == [2, 3]
    assert numbers.renumber(phone(0, "u", 2.0)).index == 2


def test_a_repeated_phone_keeps_its_index(numbers: PhoneNumbers) -> None:
    assert numbers.renumber(phone(0, "a", 1.13, final=False)).index == 1
    assert numbers.renumber(phone(0, "ai", 1.2)).index == 1
    assert numbers.renumber(phone(1, "i", 1.3)).index == 3
    assert numbers.take_withdrawn() == []


def test_withdraws_missing_phones_once(numbers: PhoneNumbers) -> None:
    assert numbers.renumber(phone(0, "a", 1.2)).index == 2
    (withdrawn,) = numbers.take_withdrawn()
    assert (withdrawn.index, withdrawn.is_withdrawn) == (1, True)
    assert numbers.take_withdrawn() == []


def test_phones_stay_void_over_two_losses(numbers: PhoneNumbers) -> None:
    numbers.restart()
    assert numbers.renumber(phone(5, "a", 1.1)).index == 1
