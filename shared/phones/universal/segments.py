"""The segments of the universal inventory: IPA, features, and the parser of texts in IPA."""

import re
import unicodedata
from functools import cache

from kouxing.shared.files.tsv_tables import read_table

_TIE = "\u0361"
_OTHER_TIES = str.maketrans("\u035c\u200d", _TIE * 2)
_FLAG = re.compile(f"[(](?:[a-z-]|{_TIE})*[)]")  # espeak-ng marks words of another language: (en)
_IGNORED = re.compile(r"[ˈˌːˑ.|‖‿\-–'’\"^_\d˥˦˧˨˩↗↘ꜛꜜ\s]")  # stress, length, breaks and tones
_MAX_LETTERS = 4


def read_ipa(ipa: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the phones of a text in IPA, and its symbols that have no phone.

    Stress, length, tone, and modifiers that no phone has (as in lʷ) are left out. A tied pair that
    is not a single phone, such as a͡ɪ, becomes two phones.

    Examples
    --------
    >>> read_ipa("t͡ʃˈa͡ɪniːz")
    (('ch', 'a', 'ih', 'n', 'i', 'z'), ())
    """
    letters = unicodedata.normalize("NFD", ipa).translate(_OTHER_TIES)
    rest = _IGNORED.sub("", remove_language_flags(letters))
    spellings = _spellings()
    phones: list[str] = []
    unknown: list[str] = []
    while rest:
        known = (n for n in range(_MAX_LETTERS, 0, -1) if rest[:n] in spellings)
        length = next(known, 0)
        if length:
            phones += spellings[rest[:length]]
        elif unicodedata.category(rest[0]) not in {"Mn", "Lm"}:  # a modifier is left out
            unknown.append(rest[0])
        rest = rest[length or 1 :]
    return tuple(phones), tuple(unknown)


def remove_language_flags(ipa: str) -> str:
    """Remove espeak-ng's marks for words of another language."""
    return _FLAG.sub("", ipa)


def symbol_to_ipa(symbol: str) -> str:
    """Return the IPA letter of a phone; other text stays as it is."""
    row = _rows().get(symbol)
    return row["ipa"] if row and row["ipa"] else symbol


@cache
def features() -> dict[str, tuple[int, ...]]:
    """Return panphon's 24 features of each phone but silence: 1, -1 or 0 (not specified)."""
    signs = {"+": 1, "-": -1, "0": 0}
    return {
        phone: tuple(signs[sign] for sign in row["features"])
        for phone, row in _rows().items()
        if row["ipa"]
    }


@cache
def _rows() -> dict[str, dict[str, str]]:
    return {row["phone"]: row for row in read_table(__package__, "phones.tsv")}


@cache
def _spellings() -> dict[str, tuple[str, ...]]:
    """Return the phones of each known spelling, decomposed."""
    spellings: dict[str, tuple[str, ...]] = {
        row["ipa"]: (phone,) for phone, row in _rows().items() if row["ipa"]
    }
    spellings |= {
        row["ipa"]: tuple(row["phones"].split()) for row in read_table(__package__, "other_ipa.tsv")
    }
    return {unicodedata.normalize("NFD", ipa): phones for ipa, phones in spellings.items()}


@cache
def nearest_phone(phone: str, phones: tuple[str, ...]) -> str:
    """Return the phone in ``phones`` that shares most features with a phone."""
    if phone in phones:
        return phone
    known, own = features(), features()[phone]
    spoken = [other for other in phones if other in known]
    return min(
        spoken, key=lambda other: sum(a != b for a, b in zip(known[other], own, strict=True))
    )
