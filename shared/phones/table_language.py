"""A language that is a folder of tables. espeak-ng converts its texts to phones.

``language.toml`` has these keys:

=======  ===========================================================================================
key      meaning
=======  ===========================================================================================
code     ISO 639-1 code, or ISO 639-3 for Cantonese and others
titles   name for users, in ``en`` and ``zh``
voice    voice of espeak-ng
scripts  scripts of the words, as in the Unicode names of letters, such as ``LATIN``
words    how words are found: ``spaced`` (the default), ``character`` (each is a word), or ``mecab``
         (MeCab splits Japanese)
numbers  spoken forms of numbers: pairs of a pattern and a replacement, applied in order to a number
         with its sign and unit
units    spoken forms of what follows a number, such as km
short    spoken forms of abbreviations and signs, such as Dr.
rules    corrections of the voice's IPA: pairs of a pattern and a replacement, applied in order
=======  ===========================================================================================

``phones.tsv`` lists the universal phones of the language in the column ``phone``. Other columns
are for readers. A phone that espeak-ng takes from another language becomes the nearest one. If the
language has no Latin letters, Latin words are read as English.
"""

import re
import tomllib
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import resources
from itertools import chain

from kouxing.shared.files.tsv_tables import read_table
from kouxing.shared.phones.espeak import transcribe_phrases
from kouxing.shared.phones.mecab import has_mecab, read_numbers, split_words
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript
from kouxing.shared.phones.universal.segments import (
    nearest_phone,
    read_ipa,
    remove_language_flags,
    symbol_to_ipa,
)

SETTINGS = "language.toml"
_REQUIRED = ("code", "titles", "voice", "scripts")  # keys of the settings
_SIGNS = "%&@#§€$£¥°+="  # espeak-ng speaks them as words
_UNITS = ("%", "€", "£", "°")  # espeak-ng speaks them after numbers
_SPACED, _CHARACTER, _MECAB = "spaced", "character", "mecab"
_LETTER = r"(?:[^\W\d_]|[\u0900-\u0963])"  # letters, and the vowel signs of Devanagari
_LATIN_EDGE = re.compile(r"(?<=[A-Za-z])(?=[^\W\x00-\x7f])|(?<=[^\W\x00-\x7f])(?=[A-Za-z])")
_CAMEL_CASE = re.compile(r"[a-z][A-Z]")  # espeak-ng speaks iPhone as two words
_LATIN, _ENGLISH = "LATIN", "en-us"
_PLAIN = str.maketrans("⁄−", "/-")
_GROUPS = r"(?<![0-9] )[0-9]{1,3}(?: [0-9]{3})+(?:[.,][0-9]+)?(?! ?[0-9])"  # 1 000
_DIGITS = rf"{_GROUPS}|[0-9]+(?:[.,:][0-9]+)*"
_WORD = rf"(?P<word>{_LETTER}+(?:['’·-]{_LETTER}+)*['’]?|[{re.escape(_SIGNS)}])|(?P<other>\S)"


@dataclass(frozen=True, kw_only=True)
class TableLanguage:
    """Converts the texts of a language to phones."""

    code: str
    titles: Mapping[str, str]
    voice: str
    scripts: tuple[str, ...]
    words: str
    numbers: tuple[tuple[str, str], ...]
    units: Mapping[str, str]
    short: Mapping[str, str]
    rules: tuple[tuple[str, str], ...]
    phones: tuple[str, ...]

    def transcribe(self, text: str) -> Transcript:
        """Return the words of a text with their IPA; a number or a sign such as % is a word.

        Words of other scripts, emoji and other signs are dropped. Raises ``UserError`` if espeak-ng
        is missing.
        """
        phrases, dropped = self._phrases_of(text)
        spoken = [[sound for _, sound in phrase] for phrase in phrases]
        words = []
        latin = [[sound] for sound in chain(*spoken) if self._is_foreign(sound)]
        english = dict(zip(chain(*latin), transcribe_phrases(latin, _ENGLISH), strict=True))
        for phrase, sounds in zip(phrases, transcribe_phrases(spoken, self.voice), strict=True):
            for (word, sound), ipa in zip(phrase, sounds, strict=True):
                phones = self._ipa_to_phones(*english.get(sound, [ipa]))
                if phones:
                    words.append(SpokenSyllable(word, "".join(map(symbol_to_ipa, phones)), phones))
                else:
                    dropped.append(word)
        return Transcript(tuple(words), tuple(dropped))

    def _phrases_of(self, text: str) -> tuple[list[list[tuple[str, str]]], list[str]]:
        """Return phrases of words between punctuation, and unreadable words. A number is a phrase.

        A word has its text, and the text for espeak-ng.
        """
        phrases: list[list[tuple[str, str]]] = [[]]
        dropped = []
        plain = unicodedata.normalize("NFKC", text).translate(_PLAIN)
        plain = "".join(str(unicodedata.decimal(sign, sign)) for sign in plain)  # १२ is 12
        if _LATIN not in self.scripts:
            plain = _LATIN_EDGE.sub(" ", plain)
        tokens = list(self._tokens.finditer(plain))
        numbers = iter(self._spell_numbers([token for token in tokens if token["number"]]))
        readings = iter(self._split([token["word"] for token in tokens if self._is_split(token)]))
        for token in tokens:
            word = token[0]
            if token["number"]:
                phrases += [(word, next(numbers))], []
            elif token["short"]:
                phrases += [(word, self.short[word])], []
            elif token["other"]:
                phrases.append([])
                if unicodedata.category(word)[0] not in "PM":
                    dropped.append(word)
            elif self._is_split(token):
                phrases[-1] += next(readings)
            elif self._is_foreign(word) or self._is_readable(word):
                phrases += [(word, word)], []
            else:
                dropped.append(word)
        return [phrase for phrase in phrases if phrase], dropped

    @cached_property
    def _tokens(self) -> re.Pattern[str]:
        """Finds abbreviations, numbers with sign and unit, words, and other signs."""
        endings = [unit for unit, spoken in self.units.items() if unit.isascii() and unit == spoken]
        units = {*self.units, *_UNITS} - {*endings}
        return re.compile(
            rf"(?P<short>{_match_any([*self.short])})"
            rf"|(?P<number>(?P<sign>(?<![A-Za-z0-9])-)?(?P<currency>[€$£¥])?(?P<digits>{_DIGITS})"
            rf"(?P<unit>{_match_any(endings)}| ?{_match_any([*units])})?)|{_WORD}"
        )

    def _spell_numbers(self, tokens: Sequence[re.Match[str]]) -> list[str]:
        """Return each number as text for espeak-ng."""
        numbers = [*map(self._spell_number, tokens)]
        return (
            read_numbers(numbers) if numbers and self.words == _MECAB and has_mecab() else numbers
        )

    def _spell_number(self, token: re.Match[str]) -> str:
        """Return a number with its sign and unit in words: $5 is 5 dollars."""
        unit = (token["unit"] or "").strip()
        spoken = self.units.get(unit, unit)
        number = token["digits"].replace(" ", "")
        number += spoken if spoken == unit else f" {spoken}"
        if currency := token["currency"]:
            number += f" {self.units.get(currency, currency)}"
        number = (token["sign"] or "") + number
        for pattern, replacement in self.numbers:
            number = re.sub(pattern, replacement, number)
        return number

    def _split(self, texts: list[str]) -> list[list[tuple[str, str]]]:
        """Return the words of each text without spaces, each with the text for espeak-ng."""
        if self.words == _MECAB and (has_mecab() or any(map(_has_character, texts))):
            return split_words(texts)
        pieces = [list(text) if self.words == _CHARACTER else [text] for text in texts]
        return [[(piece, piece) for piece in text_pieces] for text_pieces in pieces]

    def _is_split(self, token: re.Match[str]) -> bool:
        """Return whether a token is part of a phrase. Other readable words are whole phrases."""
        word = token["word"]
        return bool(word) and self._is_readable(word) and not _CAMEL_CASE.search(word)

    def _is_readable(self, word: str) -> bool:
        return word in _SIGNS or all(map(self._has_letter, filter(str.isalpha, word)))

    def _is_foreign(self, word: str) -> bool:
        """Return whether a word is read as English: it is Latin, and the language is not."""
        return _LATIN not in self.scripts and word.isascii() and word[0].isalpha()

    def _has_letter(self, letter: str) -> bool:
        return unicodedata.name(letter, "").startswith(self.scripts)

    def _ipa_to_phones(self, ipa: str) -> tuple[str, ...]:
        """Return a word in the language's phones; empty if it has unknown symbols."""
        ipa = remove_language_flags(ipa)
        for pattern, replacement in self.rules:
            ipa = re.sub(pattern, replacement, ipa)
        phones, unknown = read_ipa(ipa)
        return () if unknown else tuple(nearest_phone(phone, self.phones) for phone in phones)


def _match_any(forms: Sequence[str]) -> str:
    """Return a pattern that finds any of the forms, except inside Latin words and numbers."""
    either = "|".join(map(re.escape, sorted(forms, key=len, reverse=True))) or "(?!)"
    after = r"(?<![A-Za-z](?=[A-Za-z]))(?<![0-9/.](?=[0-9]))"
    return rf"{after}(?:{either})(?!(?<=[A-Za-z])[^\W\d_]|(?<=[0-9])[0-9/])"


def _has_character(text: str) -> bool:
    return any(unicodedata.name(letter, "").startswith("CJK") for letter in text)


@cache
def load_table_language(package: str) -> TableLanguage:
    """Read the tables of a language; ``OSError``, ``KeyError`` or ``ValueError`` if invalid."""
    settings = tomllib.loads(resources.files(package).joinpath(SETTINGS).read_text("utf-8"))
    if missing := [key for key in _REQUIRED if key not in settings]:
        raise ValueError(f"{SETTINGS} lacks {', '.join(missing)}")
    return TableLanguage(
        code=settings["code"],
        titles=settings["titles"],
        voice=settings["voice"],
        scripts=tuple(settings["scripts"]),
        words=settings.get("words", _SPACED),
        numbers=tuple(map(tuple, settings.get("numbers", ()))),
        units=settings.get("units", {}),
        short=settings.get("short", {}),
        rules=tuple(map(tuple, settings.get("rules", ()))),
        phones=tuple(row["phone"] for row in read_table(package, "phones.tsv")),
    )
