"""Languages that are folders of tables: their phones, and texts that espeak-ng reads."""

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
        ("english", "a pin spins", [("a", "ə"), ("pin", "pʰɪn"), ("spins", "spɪnz")]),
        ("german", "Schöne Füchse", [("Schöne", "ʃønə"), ("Füchse", "fyksə")]),
        ("french", "un vin blanc", [("un", "œ̃"), ("vin", "vɛ̃"), ("blanc", "blɑ̃")]),
        ("spanish", "¡Los niños!", [("Los", "los"), ("niños", "niɲos")]),
        ("italian", "gli gnocchi", [("gli", "ʎi"), ("gnocchi", "ɲoki")]),
        ("portuguese", "manhã", [("manhã", "mɐ̃ɲɐ̃")]),
        ("japanese", "さんぽ きょう", [("さんぽ", "sampo"), ("きょう", "kjoɯ")]),
        ("russian", "щука ты", [("щука", "ɕuka"), ("ты", "tɨ")]),
    ],
)
def test_reads_words(language: str, text: str, spoken: list[tuple[str, str]]) -> None:
    assert words_of(language, text) == spoken


def test_a_number_is_a_word_of_the_language() -> None:
    assert words_of("english", "25 men") == [("25", "twɛntifaɪv"), ("men", "mɛn")]
    assert words_of("german", "25")[0][1].startswith("fynf")
    assert words_of("english", "5%")[0] == ("5%", "faɪvpɚsɛnt")


def test_words_that_espeak_joins_stay_apart() -> None:
    assert [word for word, _ in words_of("english", "one of the men")] == [
        "one",
        "of",
        "the",
        "men",
    ]


def test_names_what_it_cannot_read() -> None:
    transcript = load_inventory("english").read("Hello 你好 ☃ привет, world")
    assert [word.text for word in transcript.syllables] == ["Hello", "world"]
    assert set(transcript.dropped) == {"你好", "☃", "привет"}
    with pytest.raises(UserError, match="cannot read '你好' as language en"):
        load_inventory("english").pronounce("Hello 你好")


def test_a_phone_of_another_language_becomes_the_nearest() -> None:
    tables = load_table_language(BUILT_IN["spanish"])
    assert tables._phones_of("(en)ðˈɪz") == ("dh", "i", "s")  # no z in Spanish


def test_reads_mixed_sentences() -> None:
    words = words_of("universal", "我很 happy，买了 2 个")
    assert [word for word, _ in words] == ["我", "很", "happy", "买", "了", "两", "个"]
    assert dict(words)["happy"] == "hæpi"
    assert UNIVERSAL.pronounce("我 ok") == [("w", "o"), ("o", "uh", "kasp", "e", "ih")]
    japanese = UNIVERSAL.read("これは 私")
    assert [word.text for word in japanese.syllables] == ["これは"]
    assert japanese.dropped == ("私",)
    with pytest.raises(UserError, match="cannot read '한국'"):
        UNIVERSAL.pronounce("我 한국")


def test_missing_espeak_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(UserError, match=r"espeak-ng is missing.*apt-get install espeak-ng"):
        load_inventory("english").read("hello")
