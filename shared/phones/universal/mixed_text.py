"""Reads texts that mix languages, such as Mandarin with English words.

Each script is read in one language. For other languages, the user must choose a language.
Numbers and their units are read in the language of the words before them. In a text with kana,
Chinese characters are Japanese.
"""

import re
import unicodedata
from dataclasses import replace
from itertools import groupby
from operator import itemgetter

from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript

# by the first word of the letters' Unicode names
_LANGUAGES = {
    "CYRILLIC": "russian",
    "DEVANAGARI": "hindi",
    "HANGUL": "korean",
    "HIRAGANA": "japanese",
    "KATAKANA": "japanese",
    "LATIN": "english",
}
_UNIT = re.compile(r"(?:(?<=[0-9])(?:km/h|[kcm]?m|[km]?g|m?l)|(?<=°)[CF])(?![A-Za-z])")


def read_mixed_text(text: str) -> Transcript:
    """Return the words and characters of a text, in phones of the universal inventory.

    Raises ``UserError`` if a language needs espeak-ng, and it is missing.
    """
    syllables: list[SpokenSyllable] = []
    dropped: list[str] = []
    for language, part in _split_languages(unicodedata.normalize("NFKC", text)):
        inventory = load_inventory(language)
        transcript = inventory.read(part)
        dropped += transcript.dropped
        syllables += (
            replace(syllable, phones=inventory.in_universal_phones(syllable.phones))
            for syllable in transcript.syllables
        )
    return Transcript(tuple(syllables), tuple(dropped))


def _split_languages(text: str) -> list[tuple[str, str]]:
    """Split a text where its language changes. Returns the language and the text of each part."""
    scripts = [unicodedata.name(c, "").split(" ")[0] if c.isalpha() else "" for c in text]
    for unit in _UNIT.finditer(text):
        scripts[unit.start() : unit.end()] = [""] * len(unit[0])
    character_language = "japanese" if {"HIRAGANA", "KATAKANA"} & {*scripts} else "mandarin"
    languages = _LANGUAGES | dict.fromkeys(("CJK", "IDEOGRAPHIC"), character_language)
    known = [languages.get(script) for script in scripts]
    current = next(filter(None, known), "english")  # also of numbers before the first word
    spoken = [(current := language or current) for language in known]
    parts = groupby(zip(spoken, text, strict=True), key=itemgetter(0))
    return [(language, "".join(letter for _, letter in part)) for language, part in parts]
