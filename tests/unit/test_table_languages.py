"""Languages that are folders of tables: their phones, and texts that espeak-ng reads."""

import shutil

import pytest

from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import check_visemes
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import BUILT_IN, load_inventory
from kouxing.shared.phones.table_language import load_table_language

OTHERS = sorted({*BUILT_IN} - {"mandarin", "universal"})
UNIVERSAL = load_inventory("universal")


def words_of(language: str, text: str) -> list[tuple[str, str]]:
    return [(word.text, word.spelling) for word in load_inventory(language).read(text).syllables]


@pytest.mark.parametrize("language", OTHERS)
def test_phones_are_universal(language: str) -> None:
    inventory = load_inventory(language)
    assert {*inventory.phones} < {*UNIVERSAL.phones}
    assert inventory.in_universal_phones(inventory.phones) == inventory.phones
    check_visemes(inventory)


@pytest.mark.parametrize(
    ("language", "text", "spoken"),
    [
        ("english", "Thanks, judge!", [("Thanks", "θæŋks"), ("judge", "d͡ʒʌd͡ʒ")]),
        ("english", "No.", [("No", "noʊ")]),
        ("english", "iPhone", [("iPhone", "aɪfoʊn")]),
        ("english", "a pin spins", [("a", "ə"), ("pin", "pʰɪn"), ("spins", "spɪnz")]),
        ("german", "Schöne Füchse", [("Schöne", "ʃønə"), ("Füchse", "fyksə")]),
        ("french", "un vin blanc", [("un", "œ̃"), ("vin", "vɛ̃"), ("blanc", "blɑ̃")]),
        ("spanish", "¡Los niños!", [("Los", "los"), ("niños", "niɲos")]),
        ("italian", "gli gnocchi", [("gli", "ʎi"), ("gnocchi", "ɲoki")]),
        ("portuguese", "manhã", [("manhã", "mɐ̃ɲɐ̃")]),
        ("japanese", "さんぽ きょう", [("さんぽ", "sampo"), ("きょう", "kjoo")]),
        ("russian", "щука ты", [("щука", "ɕuka"), ("ты", "tɨ")]),
        ("korean", "한국 입니다", [("한국", "hanɡuk"), ("입니다", "imnida")]),
        ("korean", "김치", [("김치", "kimt͡ɕʰi")]),
        ("cantonese", "香港人", [("香", "hœŋ"), ("港", "kɔŋ"), ("人", "jɐn")]),
        ("cantonese", "國家 打他", [*zip("國家打他", ("kwɔk", "ka", "ta", "tʰa"), strict=True)]),
        ("hindi", "नमस्ते जल", [("नमस्ते", "nəməste"), ("जल", "d͡ʒəl")]),
        ("dutch", "een leuk huis", [("een", "ən"), ("leuk", "løk"), ("huis", "hœys")]),
        ("polish", "dzień szum", [("dzień", "d͡ʑɛɲ"), ("szum", "ʃum")]),
        ("turkish", "yüz ışık", [("yüz", "jyz"), ("ışık", "ɯʃɯk")]),
        ("ukrainian", "що їжа", [("що", "ʃt͡ʃɔ"), ("їжа", "iʒa")]),
        ("swedish", "sju", [("sju", "ʃu")]),
        ("indonesian", "nyanyi cucu", [("nyanyi", "ɲaɲi"), ("cucu", "t͡ʃut͡ʃu")]),
        ("vietnamese", "người Việt", [("người", "ŋɯɤj"), ("Việt", "viɛt")]),
    ],
)
def test_reads_words(language: str, text: str, spoken: list[tuple[str, str]]) -> None:
    assert words_of(language, text) == spoken


def test_a_number_is_a_word_of_the_language() -> None:
    assert words_of("english", "25 men") == [("25", "twɛntifaɪv"), ("men", "mɛn")]
    assert words_of("german", "25")[0][1].startswith("fynf")
    assert words_of("english", "5%")[0] == ("5%", "faɪvpɚsɛnt")
    assert words_of("hindi", "२५") == words_of("hindi", "25") == [("25", "pət͡ʃis")]


@pytest.mark.parametrize("language", OTHERS)
def test_reads_numbers_in_every_language(language: str) -> None:
    transcript = load_inventory(language).read("1 25 2026 3.5 50%")
    assert [word.text for word in transcript.syllables] == ["1", "25", "2026", "3.5", "50%"]
    assert len({word.spelling for word in transcript.syllables}) == 5
    assert not transcript.dropped


@pytest.mark.parametrize(
    ("language", "text", "as_spoken"),
    [
        ("english", "$25.99", "25.99 dollars"),
        ("english", "72 °F", "72 degrees Fahrenheit"),
        ("english", "21st", "twenty first"),
        ("english", "½", "one half"),
        ("english", "-5", "minus 5"),
        ("german", "z. B. 3 km/h", "zum Beispiel 3 Kilometer pro Stunde"),
        ("french", "15h", "15 heures"),
        ("french", "1 234,5", "1234,5"),
        ("spanish", "1.º n.º", "primero número"),
        ("italian", "3 kg", "3 chili"),
        ("russian", "№ −5", "номер минус 5"),
        ("japanese", "2年", "にねん"),
        ("japanese", "3時", "さんじ"),
        ("korean", "3개 3", "세개 3"),
        ("cantonese", "3.5", "三點五"),
    ],
)
def test_reads_numbers_units_and_abbreviations(language: str, text: str, as_spoken: str) -> None:
    transcript = load_inventory(language).read(text)
    assert not transcript.dropped
    spoken, expected = (
        "".join(word for _, word in words_of(language, form)) for form in (text, as_spoken)
    )
    assert spoken == expected


@pytest.mark.parametrize(
    ("language", "text", "words"),
    [
        ("french", "01 23 45", "01 23 45"),
        ("spanish", "91 123 45", "91 123 45"),
        ("german", "5 mal um", "5 mal um"),  # no unit
        ("english", "1/2/2026", "1 2 2026"),
        ("english", "of the iPhone app", "of the iPhone app"),  # espeak-ng splits a word
        ("english", "one of the men", "one of the men"),  # espeak-ng joins words
        ("korean", "TV를", "TV 를"),
        ("japanese", "私は学生。キャンプ", "私 は 学生 キャンプ"),
        ("universal", "これは 私", "これ は 私"),
    ],
)
def test_finds_the_words_of_a_text(language: str, text: str, words: str) -> None:
    assert [word for word, _ in words_of(language, text)] == words.split()


def test_latin_words_of_other_scripts_are_english() -> None:
    for language in ("japanese", "korean", "russian", "cantonese", "hindi"):
        assert len(words_of(language, "OK")[0][1]) >= 3, language  # as in English, not a letter


def test_the_error_names_words_that_cannot_be_read() -> None:
    transcript = load_inventory("english").read("Hello 你好 ☃ привет, world")
    assert [word.text for word in transcript.syllables] == ["Hello", "world"]
    assert set(transcript.dropped) == {"你好", "☃", "привет"}
    with pytest.raises(UserError, match="cannot read '你好' as language en"):
        load_inventory("english").pronounce("Hello 你好")


def test_a_phone_of_another_language_becomes_the_nearest() -> None:
    tables = load_table_language(BUILT_IN["spanish"])
    assert tables._ipa_to_phones("(en)ðˈɪz") == ("dh", "i", "s")  # no z in Spanish


def test_reads_mixed_sentences() -> None:
    words = words_of("universal", "我很 happy，买了 2 个")
    assert [word for word, _ in words] == ["我", "很", "happy", "买", "了", "两", "个"]
    assert dict(words)["happy"] == "hæpi"
    assert UNIVERSAL.pronounce("我 ok") == [("w", "o"), ("o", "uh", "kasp", "e", "ih")]
    mixed = UNIVERSAL.read("我爱 한국 भारत")
    assert [word.spelling for word in mixed.syllables] == ["wo3", "ai4", "hanɡuk", "baɾət"]
    with pytest.raises(UserError, match="cannot read 'ไทย'"):
        UNIVERSAL.pronounce("我 ไทย")


def test_units_of_mixed_sentences_belong_to_their_number() -> None:
    chinese = "".join(word for word, _ in words_of("universal", "USB线长1.5m，-5℃，I ran 5km"))
    assert chinese == "USB线长一点五米负五摄氏度Iran5km"
    assert {"C", "F"} <= dict(words_of("universal", "3C产品在4F")).keys()
    korean = dict(words_of("universal", "약 5km 5G"))
    assert korean["5km"].endswith("kʰilomitʰʌ")
    assert korean["G"] == "d͡ʒi"


def test_reads_chinese_characters_in_japanese(monkeypatch: pytest.MonkeyPatch) -> None:
    words = dict(words_of("japanese", "私は学生。キャンプ"))
    assert words["は"] == "wa"  # the particle
    assert words["私"].startswith("wata")
    assert words_of("japanese", "いっぱい")[0][1] == "ippai"
    transcript = load_inventory("japanese").read("Ж はきいた")
    assert "".join(word.text for word in transcript.syllables) == "はきいた"
    assert transcript.dropped == ("Ж",)
    which = shutil.which
    monkeypatch.setattr(shutil, "which", lambda name: None if name == "mecab" else which(name))
    assert words_of("japanese", "さんぽ") == [("さんぽ", "sampo")]
    with pytest.raises(UserError, match=r"mecab is missing.*write kana, or install"):
        load_inventory("japanese").read("私は")


def test_missing_espeak_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match=r"espeak-ng is missing.*apt-get install espeak-ng"):
        load_inventory("english").read("hello")
