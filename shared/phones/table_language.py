"""A language that is a folder of tables. espeak-ng converts its texts to phones.

``language.toml`` has these keys:

=======  ===========================================================================================
key      meaning
=======  ===========================================================================================
code     ISO 639-1
titles   name for users, in ``en`` and ``zh``
voice    voice of espeak-ng
scripts  scripts of the words, as in the Unicode names of letters, such as ``LATIN``
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
from kouxing.shared.phones.table import read_table
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript
from kouxing.shared.phones.universal.segments import ipa_of, nearest_phone, read_ipa

SETTINGS = "language.toml"
_SIGNS = "%&@#§€$£¥°+="  # espeak-ng speaks them as words
_TOKENS = re.compile(
    r"(?P<number>[€$£¥]?[0-9]+(?:[.,:][0-9]+)*(?: ?[%€£°])?)"
    rf"|(?P<word>[^\W\d_]+(?:['’·-][^\W\d_]+)*['’]?|[{_SIGNS}])|(?P<other>\S)"
)


@dataclass(frozen=True, kw_only=True)
class TableLanguage:
    """Converts the texts of a language to phones."""

    code: str
    titles: Mapping[str, str]
    voice: str
    scripts: tuple[str, ...]
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
        words = []
        for phrase, sounds in zip(phrases, transcribe_phrases(phrases, self.voice), strict=True):
            for word, ipa in zip(phrase, sounds, strict=True):
                phones = self._phones_of(ipa)
                if phones:
                    words.append(SpokenSyllable(word, "".join(map(ipa_of, phones)), phones))
                else:
                    dropped.append(word)
        return Transcript(tuple(words), tuple(dropped))

    def _phrases_of(self, text: str) -> tuple[list[list[str]], list[str]]:
        """Return the words between punctuation, and what cannot be read. A number is a phrase."""
        phrases: list[list[str]] = [[]]
        dropped = []
        for token in _TOKENS.finditer(unicodedata.normalize("NFKC", text)):
            word = token[0]
            if token["number"]:
                phrases += [word], []
            elif token["other"]:
                phrases.append([])
                if unicodedata.category(word)[0] not in "PM":
                    dropped.append(word)
            elif word in _SIGNS or all(map(self._has_letter, filter(str.isalpha, word))):
                phrases[-1].append(word)
            else:
                dropped.append(word)
        return [phrase for phrase in phrases if phrase], dropped

    def _has_letter(self, letter: str) -> bool:
        return unicodedata.name(letter, "").startswith(self.scripts)

    def _phones_of(self, ipa: str) -> tuple[str, ...]:
        """Return a word in the language's phones; empty if it has unknown symbols."""
        for pattern, replacement in self.rules:
            ipa = re.sub(pattern, replacement, ipa)
        phones, unknown = read_ipa(ipa)
        return () if unknown else tuple(nearest_phone(phone, self.phones) for phone in phones)


@cache
def load_table_language(package: str) -> TableLanguage:
    """Read the tables of a language; ``OSError``, ``KeyError`` or ``ValueError`` if invalid."""
    settings = tomllib.loads(resources.files(package).joinpath(SETTINGS).read_text("utf-8"))
    return TableLanguage(
        code=settings["code"],
        titles=settings["titles"],
        voice=settings["voice"],
        scripts=tuple(settings["scripts"]),
        rules=tuple((pattern, replacement) for pattern, replacement in settings.get("rules", ())),
        phones=tuple(row["phone"] for row in read_table(package, "phones.tsv")),
    )
