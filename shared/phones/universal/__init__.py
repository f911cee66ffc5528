"""Phones of all languages: 85 IPA segments and silence, shared by the languages' inventories.

``phones.tsv`` has the columns of ``kouxing.shared.phones.inventory``, and:

========  ==============================================================================
column    meaning
========  ==============================================================================
ipa       IPA letter (International Phonetic Association, 2020); empty for silence
features  24 features of panphon, ``+``, ``-`` or ``0``; the file's head names them
========  ==============================================================================

A phone's symbol is made of letters a-z, as on the wire; ``write`` converts symbols to IPA. A
diphthong is two phones. Length, stress and tone are not part of a phone. Secondary palatalization
is left out, except for ɲ and ʎ. Texts may mix languages (``mixed_text``).
"""

from kouxing.shared.phones.transcript import Transcript
from kouxing.shared.phones.universal.segments import read_ipa, symbol_to_ipa

__all__ = ["UNREADABLE_HINT", "read_ipa", "spell", "transcribe", "write"]

UNREADABLE_HINT = "; choose its language"
write = symbol_to_ipa  # of a phone; a spelling stays as it is


def transcribe(text: str) -> Transcript:
    """Return the words and characters of a text; each script is read in its language."""
    from kouxing.shared.phones.universal.mixed_text import (  # noqa: PLC0415 (it loads inventories)
        read_mixed_text,
    )

    return read_mixed_text(text)


def spell(phones: tuple[str, ...]) -> str:
    """Return the phones in IPA."""
    return "".join(map(symbol_to_ipa, phones))
