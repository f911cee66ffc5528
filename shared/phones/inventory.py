"""Loads the phones of a language from the language's package.

A language is a package of tables (``table_language``), if it has ``language.toml``. Its phones are
phones of the universal inventory.

A language with its own phones is a Python package with ``phones.tsv`` and a function
``pronounce``, which returns the phones of each syllable of a text. It may also have:

- ``transcribe``, a function in place of ``pronounce`` that returns a text's syllables with their
  spelling, and the parts that it cannot read (``Transcript``)
- ``UNREADABLE_HINT``, the end of the error about such a part
- ``READABLE``, a pattern for the parts of a line of text to pronounce; by default words
- ``spell``, a function that spells a syllable's phones; by default the symbols in a row
- ``write``, a function that returns a spelling or a phone as it is printed; by default unchanged
- ``CODE``, the ISO 639-1 code that recordings use for the language
- ``universal.tsv``, the universal phones (``universal``) that make up each phone

``BUILT_IN`` lists the languages of kouxing. An installed distribution adds a language with an entry
point in the group ``kouxing.languages``: the language's name, and the package.

``phones.tsv`` has one phone per row, in the order of the acoustic models' outputs:

=============== ===================================================================================
column          meaning
=============== ===================================================================================
phone           symbol, 1 to 4 lower-case letters
kind            ``initial`` (a consonant that begins a syllable), ``vowel`` (the rest of a syllable)
                or ``silence`` (exactly one row, ``sil``)
visemes         the phone's mouth shapes in order, ``name:fraction`` separated by spaces; the
                fractions of its duration add up to 1
before_rounded  the phone's viseme before a rounded one, if different; may be empty
=============== ===================================================================================
"""

import importlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from importlib import resources
from typing import Any

from kouxing.shared.errors import UserError
from kouxing.shared.files.tsv_tables import read_table
from kouxing.shared.phones.table_language import SETTINGS, TableLanguage, load_table_language
from kouxing.shared.phones.transcript import SpokenSyllable, Transcript
from kouxing.shared.plugins import plugins

TABLE_LANGUAGES = (
    "cantonese dutch english french german hindi indonesian italian japanese korean polish"
    " portuguese russian spanish swedish turkish ukrainian vietnamese"
).split()
DEFAULT_LANGUAGE = "mandarin"
UNIVERSAL = "universal"  # the phones of all languages
AUTO = "auto"  # its code for users
BUILT_IN = {
    name: f"kouxing.shared.phones.{name}"
    for name in (DEFAULT_LANGUAGE, UNIVERSAL, *TABLE_LANGUAGES)
}
ENTRY_POINTS = "kouxing.languages"
KINDS = ("initial", "vowel", "silence")
MAX_PHONES = 255  # model files count phones in 8 bits
SILENCE = "sil"  # also in kouxing_client, which is slow to import
_SYMBOL = re.compile(r"[a-z]{1,4}")
_WORDS = re.compile(r"[^\W\d_]+(?: +[^\W\d_]+)*")

Syllable = tuple[str, ...]
# (viseme, fraction of the phone's duration), in order
VisemeFractions = tuple[tuple[str, float], ...]


@dataclass(frozen=True, kw_only=True)
class PhoneInventory:
    """The phones, visemes and lexicon of a language; raises ``UserError`` if they are not valid."""

    language: str
    phones: tuple[str, ...]  # (num_phones,) in the order of the acoustic models' outputs
    kinds: tuple[str, ...]  # (num_phones,) of KINDS
    visemes: dict[str, VisemeFractions]  # by phone
    before_rounded: dict[str, str]  # different viseme of a phone before a rounded one
    read: Callable[[str], Transcript]  # text to syllables, and its unreadable parts; the lexicon
    unreadable_hint: str = "; leave it out, or write it as it is spoken"  # end of an error
    readable: re.Pattern[str] = _WORDS  # finds the parts of a line to pronounce
    spell: Callable[[Syllable], str] = "".join  # phones of a syllable to its spelling
    write: Callable[[str], str] = str  # a spelling or a phone as printed: "ni3" is "nǐ"
    code: str = ""  # ISO 639-1, such as "zh"; empty: no recordings have it
    universal: Mapping[str, Syllable] = field(default_factory=dict)  # universal phones, by phone

    def __post_init__(self) -> None:
        wrong = [phone for phone in self.phones if not _SYMBOL.fullmatch(phone)]
        if wrong or len(set(self.phones)) != len(self.phones):
            raise UserError(
                f"language {self.language}: phones must be distinct and have 1 to 4 letters a-z"
            )
        if len(self.phones) > MAX_PHONES:
            raise UserError(f"language {self.language}: more than {MAX_PHONES} phones")
        silent = [p for p, kind in zip(self.phones, self.kinds, strict=True) if kind == "silence"]
        if silent != [SILENCE] or not set(self.kinds) <= set(KINDS):
            raise UserError(
                f"language {self.language}: each phone's kind must be one of {', '.join(KINDS)}, "
                f"and exactly one phone must be silence: {SILENCE}"
            )
        for phone in self.phones:
            total = sum(fraction for _, fraction in self.visemes.get(phone, ()))
            if not math.isclose(total, 1.0, abs_tol=1e-6):
                raise UserError(
                    f"language {self.language}: viseme fractions of {phone} must add up to 1"
                )

    def __len__(self) -> int:
        return len(self.phones)

    @cached_property
    def index(self) -> dict[str, int]:
        """Position of each phone in ``phones``."""
        return {phone: position for position, phone in enumerate(self.phones)}

    @property
    def silence(self) -> str:
        """The phone for a pause."""
        return SILENCE

    @cached_property
    def initials(self) -> frozenset[str]:
        """Consonants that begin a syllable."""
        return self._of_kind("initial")

    @cached_property
    def vowels(self) -> frozenset[str]:
        """Vowels, including the rest of the syllable."""
        return self._of_kind("vowel")

    @cached_property
    def has_universal_phones(self) -> bool:
        """Whether all phones are universal phones."""
        return all(self.universal.get(phone) == (phone,) for phone in self.phones)

    def pronounce(self, text: str) -> list[Syllable]:
        """Return the phones of each syllable; raise ``UserError`` if a part cannot be read."""
        transcript = self.read(text)
        if transcript.dropped:
            raise UserError(f"cannot read {transcript.dropped[0]!r}{self.unreadable_hint}")
        return transcript.phones

    def in_universal_phones(self, phones: Sequence[str]) -> Syllable:
        """Convert phones of this language to universal phones.

        Raises ``KeyError`` if the language has no universal phones for one of them.
        """
        return tuple(universal for phone in phones for universal in self.universal[phone])

    def _of_kind(self, kind: str) -> frozenset[str]:
        return frozenset(
            phone
            for phone, phone_kind in zip(self.phones, self.kinds, strict=True)
            if phone_kind == kind
        )


@lru_cache
def language_codes() -> dict[str, str]:
    """Return the language of each code that a user may give, with ``auto``."""
    table_languages = {load_table_language(BUILT_IN[name]).code: name for name in TABLE_LANGUAGES}
    return {AUTO: UNIVERSAL, "zh": DEFAULT_LANGUAGE} | dict(sorted(table_languages.items()))


def language_titles() -> dict[str, Mapping[str, str]]:
    """Return the display names in "en" and "zh" of ``language_codes``; zh first."""
    table_languages = {
        code: BUILT_IN[name] for code, name in language_codes().items() if name in TABLE_LANGUAGES
    }
    return {
        "zh": {"en": "Mandarin", "zh": "普通话"},
        AUTO: {"en": "any language", "zh": "任何语言"},
    } | {code: load_table_language(package).titles for code, package in table_languages.items()}


def find_language(name: str) -> str:
    """Return the language of a code such as ``de``, or of its name.

    Raises ``UserError`` if it is not installed.
    """
    language = language_codes().get(name, name)
    if language not in BUILT_IN and language not in (installed := plugins(ENTRY_POINTS)):
        language = next(filter(partial(_has_code, name), installed), name)
    return load_inventory(language).language


def _has_code(code: str, language: str) -> bool:
    try:
        return load_inventory(language).code == code
    except UserError:  # reported if the user names this language
        return False


@lru_cache
def load_inventory(language: str = DEFAULT_LANGUAGE) -> PhoneInventory:
    """Read the inventory of a language in ``BUILT_IN`` or of an entry point.

    Raises ``UserError`` if the language is not installed, or its table is not valid.
    """
    package = BUILT_IN.get(language)
    if package is None:
        installed = plugins(ENTRY_POINTS)
        package = installed.get(language)
        if package is None:
            known = ", ".join([*language_codes(), *sorted(installed.keys() - BUILT_IN.keys())])
            raise UserError(f"language {language!r} is not installed; choose from: {known}")
    try:
        if resources.files(package).joinpath(SETTINGS).is_file():
            return _inventory_of_tables(language, load_table_language(package))
        lexicon = importlib.import_module(package)
        universal = _universal_phones(package, language)
        return _inventory_of(language, read_table(package, "phones.tsv"), lexicon, universal)
    except (OSError, ImportError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise UserError(f"language {language}: cannot read package {package}: {error}") from None


def _inventory_of(
    language: str,
    rows: Sequence[Mapping[str, str]],
    lexicon: Any,
    universal: Mapping[str, Syllable],
) -> PhoneInventory:
    """Return the inventory of a table of phones and the functions of a module."""
    spell = getattr(lexicon, "spell", "".join)
    return PhoneInventory(
        language=language,
        phones=tuple(row["phone"] for row in rows),
        kinds=tuple(row["kind"] for row in rows),
        visemes={row["phone"]: _viseme_fractions(row["visemes"]) for row in rows},
        before_rounded={
            row["phone"]: row["before_rounded"] for row in rows if row["before_rounded"]
        },
        read=getattr(lexicon, "transcribe", None) or partial(_spell_all, lexicon.pronounce, spell),
        unreadable_hint=getattr(lexicon, "UNREADABLE_HINT", PhoneInventory.unreadable_hint),
        readable=getattr(lexicon, "READABLE", _WORDS),
        spell=spell,
        write=getattr(lexicon, "write", str),
        code=getattr(lexicon, "CODE", ""),
        universal=universal,
    )


def _spell_all(
    pronounce: Callable[[str], list[Syllable]], spell: Callable[[Syllable], str], text: str
) -> Transcript:
    """Return a text whose spelling follows from its phones."""
    syllables = ((spell(phones), phones) for phones in pronounce(text))
    return Transcript(tuple(SpokenSyllable(name, name, phones) for name, phones in syllables))


def _inventory_of_tables(language: str, tables: TableLanguage) -> PhoneInventory:
    """Return the inventory of a language that uses the universal phones."""
    universal = load_inventory(UNIVERSAL)
    phones = tables.phones
    if unknown := [phone for phone in phones if phone not in universal.index]:
        raise ValueError(
            f"phones.tsv: {', '.join(unknown)}: use the symbols of the universal phones, the column"
            " phone of shared/phones/universal/phones.tsv"
        )
    return replace(
        universal,
        language=language,
        phones=phones,
        kinds=tuple(universal.kinds[universal.index[phone]] for phone in phones),
        visemes={phone: universal.visemes[phone] for phone in phones},
        before_rounded={
            phone: viseme for phone, viseme in universal.before_rounded.items() if phone in phones
        },
        read=tables.transcribe,
        unreadable_hint=f" as language {tables.code}; leave it out, or write it as it is spoken",
        code=tables.code,
        universal={phone: (phone,) for phone in phones},
    )


def _universal_phones(package: str, language: str) -> Mapping[str, Syllable]:
    """Return the universal phones of each phone; empty if the language does not list them."""
    if language == UNIVERSAL:
        return {row["phone"]: (row["phone"],) for row in read_table(package, "phones.tsv")}
    if not resources.files(package).joinpath("universal.tsv").is_file():
        return {}
    rows = read_table(package, "universal.tsv")
    return {row["phone"]: tuple(row["universal"].split()) for row in rows}


def _viseme_fractions(text: str) -> VisemeFractions:
    pairs = [part.split(":") for part in text.split()]
    return tuple((viseme, float(fraction)) for viseme, fraction in pairs)
