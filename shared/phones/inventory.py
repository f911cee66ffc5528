"""The phones of a language: one value, made from the tables in the language's own folder.

A language is a Python package with ``phones.tsv`` and a function ``pronounce``. A function
``transcribe`` may tell more: a text's syllables with their spelling, and what it cannot read. A
pattern ``READABLE`` may say which stretches of a line of text to pronounce; without it, words
between spaces. A function ``spell`` may write a syllable's phones as its readers do; without it,
the symbols in a row. ``CODE`` may be the language's two letters in ISO 639-1, by which recordings
name it. The languages that come with kouxing are listed in ``BUILT_IN``; any installed distribution
adds one by an entry point of the group ``kouxing.languages`` (its name is the language's, its value
the package).

``phones.tsv`` has one phone a row, in the order of the acoustic models' outputs:

=============== ===================================================================================
column          meaning
=============== ===================================================================================
phone           symbol, 1 to 4 lower-case letters
kind            ``initial`` (a consonant that begins a syllable), ``vowel`` (a syllable's vowel with
                what follows it) or ``silence`` (exactly one row)
visemes         the mouth shapes the phone goes through, ``name:share`` separated by spaces; the
                shares of its duration add up to 1
before_rounded  the phone's viseme before a rounded one, if it has another there; may be empty
=============== ===================================================================================
"""

from __future__ import annotations

import csv
import importlib
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from importlib import resources
from importlib.metadata import entry_points

from kouxing.shared.errors import UserError
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript

BUILT_IN = {"mandarin": "kouxing.shared.phones.mandarin"}
DEFAULT_LANGUAGE = "mandarin"
ENTRY_POINTS = "kouxing.languages"
KINDS = ("initial", "vowel", "silence")
MAX_PHONES = 255  # model files count phones in 8 bits
_SYMBOL = re.compile(r"[a-z]{1,4}")
_WORDS = re.compile(r"[^\W\d_]+(?: +[^\W\d_]+)*")

Syllable = tuple[str, ...]
VisemeShares = tuple[tuple[str, float], ...]  # (viseme, share of the phone's duration), in order


@dataclass(frozen=True, kw_only=True)
class PhoneInventory:
    """A language as everything outside its folder sees it.

    Raises
    ------
    UserError
        If the phones do not make an inventory.
    """

    language: str
    phones: tuple[str, ...]  # (num_phones,) in the order of the acoustic models' outputs
    kinds: tuple[str, ...]  # (num_phones,) of KINDS
    visemes: dict[str, VisemeShares]  # by phone
    before_rounded: dict[str, str]  # viseme of a phone before a rounded one, where it has another
    pronounce: Callable[[str], list[Syllable]]  # text to syllables of phones; the lexicon
    transcribe: Callable[[str], Transcript] | None = None  # as pronounce, with the spelling
    readable: re.Pattern[str] = _WORDS  # finds the stretches of a line that may be pronounced
    spell: Callable[[Syllable], str] = "".join  # the phones of a syllable to its spelling
    code: str = ""  # ISO 639-1, "zh"; empty: recordings are never in this language

    def __post_init__(self) -> None:
        wrong = [phone for phone in self.phones if not _SYMBOL.fullmatch(phone)]
        if wrong or len(set(self.phones)) != len(self.phones):
            raise UserError(f"language {self.language}: phones are distinct, 1 to 4 letters a-z")
        if len(self.phones) > MAX_PHONES:
            raise UserError(f"language {self.language}: there are at most {MAX_PHONES} phones")
        if self.kinds.count("silence") != 1 or not set(self.kinds) <= set(KINDS):
            raise UserError(
                f"language {self.language}: a kind is one of {', '.join(KINDS)}, and exactly one "
                "phone is silence"
            )
        for phone in self.phones:
            total = sum(share for _, share in self.visemes.get(phone, ()))
            if not math.isclose(total, 1.0, abs_tol=1e-6):
                raise UserError(
                    f"language {self.language}: viseme shares of {phone} must add up to 1"
                )

    def __len__(self) -> int:
        return len(self.phones)

    @cached_property
    def index(self) -> dict[str, int]:
        """Position of each phone in ``phones``."""
        return {phone: position for position, phone in enumerate(self.phones)}

    @cached_property
    def silence(self) -> str:
        """The phone that stands for a pause."""
        return self.phones[self.kinds.index("silence")]

    @cached_property
    def initials(self) -> frozenset[str]:
        """Consonants that begin a syllable."""
        return self._of_kind("initial")

    @cached_property
    def vowels(self) -> frozenset[str]:
        """Vowels, each with what follows it in its syllable."""
        return self._of_kind("vowel")

    def read(self, text: str) -> Transcript:
        """Return a text's syllables with their spelling, and what cannot be read.

        Raises
        ------
        UserError
            If the text cannot be read at all.
        """
        if self.transcribe is not None:
            return self.transcribe(text)
        syllables = (
            SpokenSyllable(self.spell(phones), self.spell(phones), phones)
            for phones in self.pronounce(text)
        )
        return Transcript(tuple(syllables))

    def _of_kind(self, wanted: str) -> frozenset[str]:
        return frozenset(
            phone for phone, kind in zip(self.phones, self.kinds, strict=True) if kind == wanted
        )


@lru_cache
def load_inventory(language: str = DEFAULT_LANGUAGE) -> PhoneInventory:
    """Read the inventory of a language.

    Parameters
    ----------
    language
        One of ``BUILT_IN``, or the name of an entry point.

    Raises
    ------
    UserError
        If no such language is installed, or its table is wrong.
    """
    package = BUILT_IN.get(language)
    if package is None:
        installed = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
        package = installed.get(language)
        if package is None:
            known = ", ".join(sorted({*BUILT_IN, *installed}))
            raise UserError(f"language {language!r} is not installed; known: {known}")
    try:
        text = resources.files(package).joinpath("phones.tsv").read_text("utf-8")
        lines = [line for line in text.splitlines() if not line.startswith("#")]
        rows = list(csv.DictReader(lines, delimiter="\t"))
        lexicon = importlib.import_module(package)
        return PhoneInventory(
            language=language,
            phones=tuple(row["phone"] for row in rows),
            kinds=tuple(row["kind"] for row in rows),
            visemes={row["phone"]: _viseme_shares(row["visemes"]) for row in rows},
            before_rounded={
                row["phone"]: row["before_rounded"] for row in rows if row["before_rounded"]
            },
            pronounce=lexicon.pronounce,
            transcribe=getattr(lexicon, "transcribe", None),
            readable=getattr(lexicon, "READABLE", _WORDS),
            spell=getattr(lexicon, "spell", "".join),
            code=getattr(lexicon, "CODE", ""),
        )
    except (OSError, ImportError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"language {language}: package {package} cannot be read: {error}") from None


def _viseme_shares(text: str) -> VisemeShares:
    pairs = [part.split(":") for part in text.split()]
    return tuple((viseme, float(share)) for viseme, share in pairs)
