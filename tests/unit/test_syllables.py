"""Captions: phones and their revisions become syllables of pinyin."""

from __future__ import annotations

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.known_text import characters_of, place_in_text
from kouxing.shared.phones.mandarin.pinyin import phones_of_syllable, spell
from kouxing.shared.phones.syllables import MAX_PHONES, SyllableTrack

pytestmark = pytest.mark.unit
MANDARIN = load_inventory("mandarin")


def phone(index: int, symbol: str, *, final: bool = True, duration_s: float = 0.1) -> Phone:
    return Phone(
        index=index,
        symbol=symbol,
        onset_s=0.1 * index,
        duration_s=duration_s,
        confidence=1.0,
        final=final,
    )


def test_spelling_inverts_reading_for_every_syllable() -> None:
    num_spelled = 0
    for initial in ["", *sorted(MANDARIN.initials)]:
        for final in sorted(MANDARIN.vowels):
            phones = (initial, final) if initial else (final,)
            try:
                read = phones_of_syllable(spell(phones))
            except UserError:  # not a syllable of Mandarin
                continue
            if final not in ("ii", "iii") or initial:
                num_spelled += read == phones
    assert num_spelled > 400


def test_shows_an_initial_at_once_and_adds_its_vowel() -> None:
    track = SyllableTrack(MANDARIN)
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
    track = SyllableTrack(MANDARIN)
    assert not track.update(phone(0, "d"))[0].final
    (pause,) = track.update(phone(1, "sil", final=False))  # a revision may make it a vowel
    assert pause.text == "sil"
    initial, _ = track.update(phone(1, "sil"))
    assert (initial.text, initial.final) == ("d", True)


def test_joins_two_syllables_after_a_revision() -> None:
    track = SyllableTrack(MANDARIN)
    for index, symbol in enumerate(("a", "ou", "sil")):
        track.update(phone(index, symbol, final=False))
    withdrawn, joined = track.update(phone(0, "m", final=False))
    assert (withdrawn.index, withdrawn.duration_s, withdrawn.final) == (1, 0.0, True)
    assert joined.text == "mou"
    (alone,) = track.update(phone(1, "sil", duration_s=0.0))  # the vowel is withdrawn
    assert alone.text == "m"


def test_keeps_syllables_in_a_long_stream() -> None:
    track = SyllableTrack(MANDARIN)
    texts: dict[int, str] = {}
    for index in range(4 * MAX_PHONES):
        for syllable in track.update(phone(index, ("b", "a", "sil")[index % 3])):
            texts[syllable.index] = syllable.text
            assert syllable.duration_s > 0.0
    assert list(texts.values()) == ["ba", "sil"] * (4 * MAX_PHONES // 3) + ["b"]


def test_shows_characters_of_a_known_text_despite_wrong_phones() -> None:
    text = characters_of("四是四，十是十。十四是十四，四十是四十！" * 4, MANDARIN)
    track = SyllableTrack(MANDARIN, text)
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


def test_spells_syllables_that_are_not_in_the_text() -> None:
    places = place_in_text([("n", "i"), ("h", "ao"), ("f", "a")], [("h", "ao"), ("m", "a")])
    assert places == [None, 0, 1]
    track = SyllableTrack(MANDARIN, characters_of("好。", MANDARIN))
    texts: dict[int, str] = {}
    for index, symbol in enumerate(("n", "i", "h", "ao")):
        texts |= {new.index: new.text for new in track.update(phone(index, symbol))}
    assert texts == {0: "ni", 2: "好"}


def test_ignores_the_withdrawal_of_an_unknown_phone() -> None:
    track = SyllableTrack(MANDARIN)
    assert track.update(phone(3, "sil", duration_s=0.0)) == []
    track.update(phone(0, "sh"))
    (withdrawn,) = track.update(phone(0, "sh", duration_s=0.0))
    assert withdrawn.duration_s == 0.0
