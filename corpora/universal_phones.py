"""Finds the universal phones of the rows of a manifest, in any language.

The first of these columns that a row has gives its phones:

============ =====================================================================================
column       content
============ =====================================================================================
phones_path  table of the hand-made labels of a recording of the Berlin EmoDB (``emodb.tsv``)
ipa          IPA, with spaces between words
arpabet      ARPABET without stress
pinyin       Mandarin
text         text in the language of the column ``language``, an ISO 639-1 code. ``yue``: jyutping
============ =====================================================================================
"""

import re
from functools import cache
from pathlib import Path

from kouxing.corpora.tables import read_rows
from kouxing.shared.errors import UserError
from kouxing.shared.files.tsv_tables import read_table
from kouxing.shared.phones.alphabets import phones_of_arpabet
from kouxing.shared.phones.inventory import (
    BUILT_IN,
    SILENCE,
    PhoneInventory,
    Syllable,
    load_inventory,
)
from kouxing.shared.phones.universal.segments import read_ipa

_EMODB = "emodb_"
_MARKS = re.compile("^[!_]|asp$")  # marks for bursts, closures and aspiration
_STOPS = ("p", "t", "k")
_ASPIRATED = "asp"
_JYUTPING = re.compile(r"(gw|kw|ng|[bpmfdtnlgkhwzcsj])?(aa|yu|oe|eo|[aeiou])?(ng|[mnptkiu])?\d?")
# Bauer and Benedict 1997, Modern Cantonese Phonology
_INITIALS = {
    "b": "p",
    "p": "pasp",
    "d": "t",
    "t": "tasp",
    "g": "k",
    "k": "kasp",
    "gw": "k w",
    "kw": "kasp w",
    "z": "ts",
    "c": "tsh",
}
_NUCLEI = {"aa": "a", "a": "ac", "e": "eh", "o": "ao", "oe": "oeh", "eo": "oc", "yu": "y"}
_CLOSE_NUCLEI = {"ei": "e", "ou": "o", "ik": "ih", "ing": "ih", "uk": "uh", "ung": "uh"}
_GLIDES = {"i": "ih", "u": "uh"}


def universal_words(row: dict[str, str]) -> list[Syllable]:
    """Return the universal phones of a row's words; UserError if they cannot be read."""
    if has_labels(row):
        labels = labeled_phones(Path(row["phones_path"]))
        return [tuple(phone for _, phone in labels if phone != SILENCE)]
    if row.get("ipa"):
        return [_ipa_phones(word) for word in row["ipa"].split()]
    if row.get("arpabet"):
        return [(phone,) for phone in _english_phones(row["arpabet"].split())]
    language = "zh" if row.get("pinyin") else row.get("language", "")
    if language == "yue":
        return [_cantonese_phones(syllable) for syllable in row["text"].split()]
    inventory = _inventories_by_code().get(language)
    if inventory is None:
        raise UserError(
            f"language {language!r} has no tables; use {', '.join(_inventories_by_code())}"
        )
    return [
        inventory.in_universal_phones(syllable)
        for syllable in inventory.pronounce(row.get("pinyin") or row["text"])
    ]


def has_labels(row: dict[str, str]) -> bool:
    """Return whether a row has hand-labeled phones with times."""
    return bool(row.get("phones_path")) and row["utt_id"].startswith(_EMODB)


@cache
def _inventories_by_code() -> dict[str, PhoneInventory]:
    inventories = map(load_inventory, BUILT_IN)
    return {inventory.code: inventory for inventory in inventories if inventory.code}


@cache
def _emodb_symbols() -> dict[str, Syllable]:
    rows = read_table("kouxing.corpora", "emodb.tsv")
    return {row["symbol"]: tuple((row["phones"] or "").split()) for row in rows}


def _look_up(table: dict[str, Syllable], symbol: str) -> Syllable:
    try:
        return table[symbol]
    except KeyError:
        raise UserError(f"unknown symbol {symbol!r}") from None


def _ipa_phones(word: str) -> Syllable:
    phones, unknown = read_ipa(word)
    if unknown:
        raise UserError(f"unknown symbol {unknown[0]!r} in {word!r}")
    return phones


def _english_phones(symbols: list[str]) -> list[str]:
    """Return the phones of ARPABET. p t k are aspirated before a vowel, but not after s."""
    phones = [phone for symbol in symbols for phone in _look_up(phones_of_arpabet(), symbol)]
    vowels = load_inventory("english").vowels
    return [
        phone + _ASPIRATED if phone in _STOPS and after in vowels and before != "s" else phone
        for before, phone, after in zip(["", *phones], phones, [*phones[1:], ""], strict=False)
    ]


def labeled_phones(path: Path) -> list[tuple[float, str]]:
    """Return the end in seconds of each phone of a table of labels; pauses count as phones.

    A stop has up to three labels. Labels of a diphthong have two phones of equal durations.
    Raises ``UserError`` or ``ValueError`` if the table cannot be read.
    """
    phones: list[tuple[float, str]] = []
    before = ""
    for row in read_rows(path, ("symbol", "start_s", "end_s")):
        label, start_s, end_s = row["symbol"], float(row["start_s"]), float(row["end_s"])
        symbol = _MARKS.sub("", label) if len(label) > 1 else label
        if symbol == before and symbol != label:
            phones[-1] = end_s, phones[-1][1]
        else:
            parts = _look_up(_emodb_symbols(), symbol) or (SILENCE,)
            step_s = (end_s - start_s) / len(parts)
            phones += [(start_s + step_s * n, part) for n, part in enumerate(parts, start=1)]
        before = symbol
    return phones


def _cantonese_phones(syllable: str) -> Syllable:
    parts = _JYUTPING.fullmatch(syllable)
    if not parts:
        raise UserError(f"{syllable!r} is not jyutping")
    initial, nucleus, end = (part or "" for part in parts.groups())
    if nucleus + end in _CLOSE_NUCLEI:
        vowel = _CLOSE_NUCLEI[nucleus + end]
    else:
        vowel = _NUCLEI.get(nucleus, nucleus)
    glide = "y" if nucleus == "eo" and end == "i" else _GLIDES.get(end, end)
    return tuple(f"{_INITIALS.get(initial, initial)} {vowel} {glide}".split())
