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
rules    corrections of the voice's IPA: pairs of a pattern and a replacement, applied in order
=======  ===========================================================================================

``phones.tsv`` lists the universal phones of the language in the column ``phone``. Other columns
are for readers. A phone that espeak-ng takes from another language becomes the nearest one.
"""

import re
import tomllib
import unicodedata
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources

from kouxing.shared.errors import UserError
from kouxing.shared.phones.espeak import transcribe_phrases
from kouxing.shared.phones.mecab import has_mecab, split_words
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript
from kouxing.shared.phones.universal.segments import (
    ipa_of,
    nearest_phone,
    read_ipa,
    remove_language_flags,
)
from kouxing.shared.tables import read_table

SETTINGS = "language.toml"
_SIGNS = "%&@#§€$£¥°+="  # espeak-ng speaks them as words
_SPACED, _CHARACTER, _MECAB = "spaced", "character", "mecab"
_LETTER = r"(?:[^\W\d_]|[\u0900-\u0963])"  # letters, and the vowel signs of Devanagari
_LATIN_EDGE = re.compile(r"(?<=[A-Za-z])(?![\x00-\x7f])|(?<![\x00-\x7f])(?=[A-Za-z])")
_TOKENS = re.compile(
    r"(?P<number>[€$£¥]?[0-9]+(?:[.,:][0-9]+)*(?: ?[%€£°])?)"
    rf"|(?P<word>{_LETTER}+(?:['’·-]{_LETTER}+)*['’]?|[{_SIGNS}])|(?P<other>\S)"
)


@dataclass(frozen=True, kw_only=True)
class TableLanguage:
    """Converts the texts of a language to phones."""

    code: str
    titles: Mapping[str, str]
    voice: str
    scripts: tuple[str, ...]
    words: str
    rules: tuple[tuple[str, str], ...]
    phones: tuple[str, ...]

    def pronounce(self, text: str) -> list[tuple[str, ...]]:
        """Return the phones of each word of a text; ``UserError`` if a part cannot be read."""
        transcript = self.transcribe(text)
        if transcript.dropped:
            raise UserError(
                f"cannot read {transcript.dropped[0]!r} as language {self.code}; leave it out, or"
                " write it as it is spoken"
            )
        return transcript.phones

    def transcribe(self, text: str) -> Transcript:
        """Return the words of a text with their IPA; a number or a sign such as % is a word.

        Words of other scripts, emoji and other signs are dropped. Raises ``UserError`` if espeak-ng
        is missing.
        """
        phrases, dropped = self._phrases_of(text)
        spoken = [[sound for _, sound in phrase] for phrase in phrases]
        words = []
        for phrase, sounds in zip(phrases, transcribe_phrases(spoken, self.voice), strict=True):
            for (word, _), ipa in zip(phrase, sounds, strict=True):
                phones = self._phones_of(ipa)
                if phones:
                    words.append(SpokenSyllable(word, "".join(map(ipa_of, phones)), phones))
                else:
                    dropped.append(word)
        return Transcript(tuple(words), tuple(dropped))

    def _phrases_of(self, text: str) -> tuple[list[list[tuple[str, str]]], list[str]]:
        """Return phrases of words between punctuation, and unreadable words. A number is a phrase.

        A word has its text, and the text for espeak-ng.
        """
        phrases: list[list[tuple[str, str]]] = [[]]
        dropped = []
        plain = unicodedata.normalize("NFKC", text)
        plain = "".join(str(unicodedata.decimal(sign, sign)) for sign in plain)  # १२ is 12
        if self.words != _SPACED:
            plain = _LATIN_EDGE.sub(" ", plain)
        tokens = list(_TOKENS.finditer(plain))
        readable = [token[0] for token in tokens if token["word"] and self._is_readable(token[0])]
        readings = iter(self._split(readable))
        for token in tokens:
            word = token[0]
            if token["number"]:
                phrases += [(word, word)], []
            elif token["other"]:
                phrases.append([])
                if unicodedata.category(word)[0] not in "PM":
                    dropped.append(word)
            elif self._is_readable(word):
                phrases[-1] += next(readings)
            else:
                dropped.append(word)
        return [phrase for phrase in phrases if phrase], dropped

    def _split(self, texts: list[str]) -> list[list[tuple[str, str]]]:
        """Return the words of each text without spaces, each with the text for espeak-ng."""
        if self.words == _MECAB and (has_mecab() or any(map(_has_character, texts))):
            return split_words(texts)
        pieces = [list(text) if self.words == _CHARACTER else [text] for text in texts]
        return [[(piece, piece) for piece in some] for some in pieces]

    def _is_readable(self, word: str) -> bool:
        return word in _SIGNS or all(map(self._has_letter, filter(str.isalpha, word)))

    def _has_letter(self, letter: str) -> bool:
        return unicodedata.name(letter, "").startswith(self.scripts)

    def _phones_of(self, ipa: str) -> tuple[str, ...]:
        """Return a word in the language's phones; empty if it has unknown symbols."""
        ipa = remove_language_flags(ipa)
        for pattern, replacement in self.rules:
            ipa = re.sub(pattern, replacement, ipa)
        phones, unknown = read_ipa(ipa)
        return () if unknown else tuple(nearest_phone(phone, self.phones) for phone in phones)


def _has_character(text: str) -> bool:
    return any(unicodedata.name(letter, "").startswith("CJK") for letter in text)


@cache
def load_table_language(package: str) -> TableLanguage:
    """Read the tables of a language; ``OSError``, ``KeyError`` or ``ValueError`` if invalid."""
    settings = tomllib.loads(resources.files(package).joinpath(SETTINGS).read_text("utf-8"))
    return TableLanguage(
        code=settings["code"],
        titles=settings["titles"],
        voice=settings["voice"],
        scripts=tuple(settings["scripts"]),
        words=settings.get("words", _SPACED),
        rules=tuple((pattern, replacement) for pattern, replacement in settings.get("rules", ())),
        phones=tuple(row["phone"] for row in read_table(package, "phones.tsv")),
    )
