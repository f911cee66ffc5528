"""The universal inventory: its features, IPA texts, and the phones of Mandarin in it."""

import pytest

from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import check_visemes
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.universal.segments import features, ipa_of, nearest_phone, read_ipa
from tests.languages import MANDARIN

UNIVERSAL = load_inventory("universal")


def test_phones_have_features_and_visemes() -> None:
    assert len(UNIVERSAL) == 86
    assert set(features()) == {*UNIVERSAL.phones} - {"sil"}
    assert {len(row) for row in features().values()} == {24}
    syllabic = {phone for phone, row in features().items() if row[0] == 1}
    assert syllabic == UNIVERSAL.vowels
    check_visemes(UNIVERSAL)


def test_features_of_a_stop_and_of_a_nasal_differ_as_in_panphon() -> None:
    """Mortensen et al. 2016, table 1: sonorant and nasal."""
    b, m = features()["b"], features()["m"]
    differs = [n for n in range(24) if b[n] != m[n]]
    assert differs == [1, 6]


@pytest.mark.parametrize(
    ("ipa", "phones"),
    [
        ("t͡ʃˈa͡ɪniːz", "ch a ih n i z"),  # stress, length, a diphthong
        ("mˈɪɾiŋ", "m ih dx i ng"),
        ("ˈt͡ɕʰwɑŋ˥", "tch w aa ng"),
        ("ɲɔ̃", "nj aon"),  # one modifier is part of the phone
        ("lʷe̞", "l e"),  # others are left out
        ("(͡e͡n)θˈɔː(de)", "th ao"),  # switches to another language, tied by espeak-ng
        ("ç", "ich"),  # composed or decomposed
        ("c\u0327", "ich"),
    ],
)
def test_reads_ipa(ipa: str, phones: str) -> None:
    assert read_ipa(ipa) == (tuple(phones.split()), ())


def test_names_unknown_symbols() -> None:
    assert read_ipa("ma?ǂ") == (("m", "a"), ("?", "ǂ"))


def test_writes_what_it_reads() -> None:
    for phone in {*UNIVERSAL.phones} - {"sil"}:
        assert read_ipa(ipa_of(phone)) == ((phone,), ())
    assert UNIVERSAL.spell(("h", "a", "uh", "s")) == "haʊs"


@pytest.mark.parametrize(
    ("phone", "phones", "nearest"),
    [("th", ("s", "f", "sil"), "s"), ("th", ("s", "th"), "th"), ("ehn", ("a", "eh"), "eh")],
)
def test_nearest_phone_has_the_most_common_features(
    phone: str, phones: tuple[str, ...], nearest: str
) -> None:
    assert nearest_phone(phone, phones) == nearest


def test_every_phone_of_mandarin_has_universal_phones() -> None:
    assert set(MANDARIN.universal) == set(MANDARIN.phones)
    assert {phone for row in MANDARIN.universal.values() for phone in row} <= set(UNIVERSAL.phones)
    assert UNIVERSAL.spell(MANDARIN.universal["zh"] + MANDARIN.universal["uang"]) == "ʈ͡ʂwɑŋ"
