"""Captions: phones and their revisions become syllables of pinyin."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.syllable_captions import (
    MAX_PHONES,
    CaptionSyllable,
    SyllableCaptions,
    split_characters,
)
from tests import lips

MANDARIN = load_inventory("mandarin")


def phone(index: int, symbol: str, *, final: bool = True, duration_s: float = 0.1) -> Phone:
    return lips.phone(index, symbol, 0.1 * index, duration_s, final=final)


def test_shows_an_initial_at_once_and_adds_its_vowel() -> None:
    track = SyllableCaptions(MANDARIN)
    (first,) = track.update(phone(0, "sh", final=False))
    assert (first.index, first.text, first.final) == (0, "sh", False)
    (second,) = track.update(phone(1, "iii", final=False))
    assert (second.index, second.text, second.onset_s) == (0, "shi", 0.0)
    assert second.duration_s == pytest.approx(0.2)
    assert track.update(phone(1, "iii", final=False)) == []
    track.update(phone(0, "sh"))
    (final,) = track.update(phone(1, "iii"))
    assert final.final


def test_an_initial_is_final_once_no_vowel_can_follow() -> None:
    track = SyllableCaptions(MANDARIN)
    assert not track.update(phone(0, "d"))[0].final
    (pause,) = track.update(phone(1, "sil", final=False))  # a revision may make it a vowel
    assert pause.text == "sil"
    initial, _ = track.update(phone(1, "sil"))
    assert (initial.text, initial.final) == ("d", True)


def test_shows_characters_of_a_known_text_despite_wrong_phones() -> None:
    text = split_characters("四是四，十是十。十四是十四，四十是四十！" * 4, MANDARIN)
    track = SyllableCaptions(MANDARIN, text)
    texts: dict[int, str] = {}
    index = 0
    for number, (_, phones) in enumerate(text):
        symbols = ("sil", *phones) if number % 10 == 3 else phones
        if number % 10 == 5:
            symbols = ("c", "ii")  # wrong
        if number % 10 == 7:
            continue  # not recognized
        for symbol in symbols:
            for syllable in track.update(phone(index, symbol)):
                texts[syllable.index] = syllable.text
            index += 1
    shown = [character for character in texts.values() if character != "sil"]
    expected = [character for number, (character, _) in enumerate(text) if number % 10 != 7]
    right = sum(a == b for a, b in zip(shown, expected, strict=True))
    assert right >= 0.9 * len(expected), shown


@given(
    phones=st.lists(
        st.builds(
            phone,
            st.integers(0, MAX_PHONES - 1),
            st.sampled_from([*sorted(MANDARIN.phones), "?"]),
            final=st.booleans(),
            duration_s=st.sampled_from([0.0, 0.1]),  # 0: withdrawn
        ),
        max_size=30,
    ),
    text=st.sampled_from(["", "你好欢迎来到"]),
)
def test_shows_exactly_the_phones_that_are_not_withdrawn(phones: list[Phone], text: str) -> None:
    track = SyllableCaptions(MANDARIN, split_characters(text, MANDARIN))
    shown: dict[int, CaptionSyllable] = {}
    current: set[int] = set()
    for change in phones:
        current.add(change.index)
        if change.is_withdrawn:
            current.remove(change.index)
        for syllable in track.update(change):
            shown[syllable.index] = syllable
            if syllable.duration_s == 0.0:
                del shown[syllable.index]
        assert shown.keys() <= current
