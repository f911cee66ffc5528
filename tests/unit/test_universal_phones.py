"""The universal inventory: features, IPA, phones of Mandarin and of a manifest's rows, errors."""

from pathlib import Path

import pytest
import soundfile

from kouxing.corpora.scoring import feature_errors
from kouxing.corpora.speech_corpus import RowErrors, read_corpus
from kouxing.corpora.universal_phones import labeled_phones, universal_words
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import check_visemes
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.universal.segments import (
    features,
    nearest_phone,
    read_ipa,
    symbol_to_ipa,
)
from tests.corpora import write_manifest
from tests.languages import MANDARIN
from tests.system import HELLO

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


def test_written_ipa_is_read_back() -> None:
    for phone in {*UNIVERSAL.phones} - {"sil"}:
        assert read_ipa(symbol_to_ipa(phone)) == ((phone,), ())
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


def words_of(**row: str) -> list[str]:
    return [" ".join(word) for word in universal_words({"utt_id": "a", "text": "", **row})]


def test_reads_phones_from_ipa_arpabet_and_pinyin_columns() -> None:
    assert words_of(ipa="t͡ʃaɪ niː", language="xx") == ["ch a ih", "n i"]
    assert words_of(arpabet="S T AY T AH N") == ["s", "t", "a", "ih", "tasp", "ax", "n"]
    assert words_of(pinyin="zhong1 guo2") == ["tr uh ng", "k w o"]


@pytest.mark.parametrize(
    ("syllable", "phones"),
    [
        ("gwong1", "k w ao ng"),
        ("jyu4", "j y"),
        ("seoi2", "s oc y"),
        ("ng5", "ng"),
        ("sik6", "s ih k"),
    ],
)
def test_cantonese_syllables(syllable: str, phones: str) -> None:
    assert words_of(text=syllable, language="yue") == [phones]
    assert words_of(text=f"{syllable} nei5", language="yue") == [phones, "n e ih"]


def test_labels_of_a_stop_are_one_phone(tmp_path: Path) -> None:
    table = tmp_path / "labels.tsv"
    labels = ["<p:>", "_t", "!t", "tasp", "aI", "k", "!k", "k", "."]
    table.write_text("start_s\tend_s\tsymbol\n" + "".join(f"0\t1\t{label}\n" for label in labels))
    row = {"utt_id": "emodb_1", "text": "", "phones_path": str(table)}
    assert universal_words(row) == [("t", "a", "ih", "k", "k")]
    ends = [end for end, _ in labeled_phones(table)]
    assert ends == [1.0, 1.0, 0.5, 1.0, 1.0, 1.0, 1.0]
    table.write_text("start_s\tend_s\n0\t1\n")
    with pytest.raises(UserError, match="lacks the column symbol"):
        universal_words(row)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"ipa": "a!"}, "unknown symbol '!'"),
        ({"arpabet": "QQ"}, "unknown symbol 'QQ'"),
        ({"text": "x", "language": "tlh"}, "language 'tlh' has no tables"),
        ({"text": "xyz", "language": "yue"}, "'xyz' is not jyutping"),
    ],
)
def test_unreadable_labels_are_rejected(row: dict[str, str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        words_of(**row)


def test_each_row_of_a_corpus_has_its_language(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.wav", HELLO, 16_000)
    rows = ["a\ta.wav\tde\t-\tja", "b\ta.wav\txx\tja\t"]
    write_manifest(tmp_path, "utt_id path language text ipa", rows)
    errors, inventory = RowErrors(), load_inventory("universal")
    (row,) = read_corpus(tmp_path, errors, inventory)
    assert row.language == "de"
    assert [inventory.phones[phone] for phone in row.phones] == ["j", "a"]
    assert "language 'xx' has no tables" in errors.messages[0]


def test_feature_errors_are_the_share_of_wrong_features() -> None:
    known = features()
    voicing = sum(a != b for a, b in zip(known["p"], known["b"], strict=True)) / 24
    assert feature_errors("p a".split(), "b a".split()) == voicing == 1 / 24
    assert feature_errors("p a t".split(), "b a".split()) == pytest.approx(1 + voicing)
    assert feature_errors([], ["a"]) == 1.0
    assert feature_errors(["a", "s"], []) == 2.0
