"""Phones in IPA and ARPABET, in files and live."""

from collections.abc import Iterator

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.phones.alphabets import Alphabet, respell
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import load_inventory
from tests.languages import MANDARIN, small_inventory
from tests.lips import phone

ENGLISH = load_inventory("english")


def spoken(symbols: str, gap_s: float = 0.0) -> list[Phone]:
    step_s = 0.1 + gap_s
    return [phone(n, symbol, n * step_s, 0.1) for n, symbol in enumerate(symbols.split())]


def arpabet(symbols: str, gap_s: float = 0.0) -> str:
    phones = respell(spoken(symbols, gap_s), ENGLISH, Alphabet.ARPABET)
    return " ".join(phone.symbol for phone in phones)


def test_diphthongs_of_arpabet_are_two_phones() -> None:
    assert arpabet("kasp a ih t sil b ao ih") == "K AY T B OY"
    assert arpabet("h ax l o uh") == "HH AH L OW"
    assert arpabet("a ih", gap_s=0.1) == "AA IH"
    assert arpabet("a a ih a") == "AA AY AA"
    merged = [*respell(spoken("a ih"), ENGLISH, Alphabet.ARPABET)]
    assert [(p.onset_s, round(p.duration_s, 6)) for p in merged] == [(0.0, 0.2)]


def test_every_english_phone_is_in_arpabet() -> None:
    assert len(arpabet(" ".join(ENGLISH.phones), gap_s=0.05).split()) == len(ENGLISH) - 1


def test_live_phones_come_as_soon_as_they_are_certain() -> None:
    given: list[str] = []

    def live() -> Iterator[Phone]:
        for item in spoken("s t a ih l"):
            given.append(item.symbol)
            yield item

    written = respell(live(), ENGLISH, Alphabet.ARPABET)
    assert [(next(written).symbol, given[-1]) for _ in range(4)] == [
        ("S", "s"),
        ("T", "t"),
        ("AY", "ih"),
        ("L", "l"),
    ]


def test_the_default_is_ipa_except_for_mandarin() -> None:
    assert [p.symbol for p in respell(spoken("th ih ng k"), ENGLISH)] == ["θ", "ɪ", "ŋ", "k"]
    assert [p.symbol for p in respell(spoken("sh uang"), MANDARIN)] == ["sh", "uang"]


def test_a_final_of_mandarin_is_several_letters_of_ipa() -> None:
    phones = [*respell(spoken("sh uang sil"), MANDARIN, Alphabet.IPA)]
    assert [p.symbol for p in phones] == ["ʂ", "w", "ɑ", "ŋ"]
    assert [p.onset_s for p in phones] == pytest.approx([0.0, 0.1, 0.1333, 0.1667], abs=1e-3)


def test_a_language_without_universal_phones_has_no_ipa() -> None:
    inventory = small_inventory()
    assert [p.symbol for p in respell(spoken("m a"), inventory)] == ["m", "a"]
    with pytest.raises(UserError, match="language small does not list universal phones"):
        respell(spoken("m a"), inventory, Alphabet.IPA)
