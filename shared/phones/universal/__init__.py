"""Phones of all languages: 85 IPA segments and silence, above the languages' own inventories.

``phones.tsv`` has the columns of ``kouxing.shared.phones.inventory``, and:

========  ==============================================================================
column    meaning
========  ==============================================================================
ipa       IPA letter (International Phonetic Association, 2020); empty for silence
features  24 features of panphon, ``+``, ``-`` or ``0``; the file's head names them
========  ==============================================================================

A phone's symbol is made of letters a-z, as on the wire; ``write`` returns its IPA letter. A
diphthong is two phones. Length, stress and tone are not part of a phone. Secondary palatalization
is left out, except for ɲ and ʎ.
"""

from kouxing.shared.errors import UserError
from kouxing.shared.phones.universal.segments import ipa_of, read_ipa

__all__ = ["pronounce", "spell", "write"]


def pronounce(text: str) -> list[tuple[str, ...]]:
    """Return the phones of each word of a text in IPA.

    Raises ``UserError`` if a symbol is unknown.
    """
    words = []
    for word in text.split():
        phones, unknown = read_ipa(word)
        if unknown:
            raise UserError(f"cannot read {unknown[0]!r} in {word!r}; write IPA")
        words.append(phones)
    return [phones for phones in words if phones]


def spell(phones: tuple[str, ...]) -> str:
    """Return the phones in IPA."""
    return "".join(map(ipa_of, phones))


def write(symbol: str) -> str:
    """Return the IPA letter of a phone; other texts stay as they are."""
    return ipa_of(symbol)
