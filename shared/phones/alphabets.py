"""Writes phones in other alphabets: IPA, and ARPABET for English."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from enum import StrEnum
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING

from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.files.tsv_tables import read_table
from kouxing.shared.phones.inventory import PhoneInventory, Syllable, load_inventory
from kouxing.shared.phones.universal.segments import nearest_phone, symbol_to_ipa

if TYPE_CHECKING:  # it needs NumPy, which commands import only if they need it
    from kouxing.shared.phones.events import Phone

_ENGLISH = "english"
_TOUCHING_S = 0.011  # phones of a diphthong have no gap


class Alphabet(StrEnum):
    """How phones are written."""

    OWN = "own"  # the symbols of the language's inventory
    IPA = "ipa"
    ARPABET = "arpabet"


def respell(
    phones: Iterable[Phone], inventory: PhoneInventory, alphabet: Alphabet | None = None
) -> Iterator[Phone]:
    """Convert spoken phones to another alphabet, in order.

    Without an alphabet, universal phones are written in IPA, and other phones unchanged. A phone
    of Mandarin may be several IPA letters, which share its time equally. A diphthong of ARPABET is
    two phones of the universal inventory, so its first phone waits for the second.

    Raises ``UserError`` if the language does not list universal phones.
    """
    if alphabet is None:
        alphabet = Alphabet.IPA if inventory.has_universal_phones else Alphabet.OWN
    if alphabet is not Alphabet.OWN and not inventory.universal:
        raise UserError(
            f"language {inventory.language} does not list universal phones; use --alphabet own"
        )
    spoken = (phone for phone in phones if phone.is_spoken)
    if alphabet is Alphabet.OWN:
        return spoken
    universal = chain.from_iterable(_split(phone, inventory) for phone in spoken)
    if alphabet is Alphabet.IPA:
        return (replace(phone, symbol=symbol_to_ipa(phone.symbol)) for phone in universal)
    return _in_arpabet(universal)


def _split(phone: Phone, inventory: PhoneInventory) -> Iterator[Phone]:
    symbols = inventory.universal[phone.symbol]
    duration_s = phone.duration_s / len(symbols)
    for number, symbol in enumerate(symbols):
        onset_s = phone.onset_s + number * duration_s
        yield replace(phone, symbol=symbol, onset_s=onset_s, duration_s=duration_s)


def _in_arpabet(phones: Iterable[Phone]) -> Iterator[Phone]:
    known, table = load_inventory(_ENGLISH).phones, _arpabet()
    starts = {pair[0] for pair in table if len(pair) == 2}
    before: Phone | None = None  # may start a diphthong
    for phone in phones:
        symbol = nearest_phone(phone.symbol, known)
        if before is not None:
            gap_s = phone.onset_s - before.end_s
            pair = (before.symbol, symbol)
            if pair in table and gap_s < _TOUCHING_S:
                yield replace(
                    before,
                    symbol=table[pair],
                    duration_s=phone.end_s - before.onset_s,
                    confidence=min(before.confidence, phone.confidence),
                )
                before = None
                continue
            yield replace(before, symbol=table[before.symbol,])
        before = replace(phone, symbol=symbol) if symbol in starts else None
        if before is None:
            yield replace(phone, symbol=table[symbol,])
    if before is not None:
        yield replace(before, symbol=table[before.symbol,])


@cache
def phones_of_arpabet() -> dict[str, Syllable]:
    """Return the universal phones of each symbol of ARPABET."""
    return {symbol: phones for phones, symbol in reversed(_arpabet().items())}


@cache
def _arpabet() -> dict[Syllable, str]:
    rows = read_table(f"kouxing.shared.phones.{_ENGLISH}", "arpabet.tsv")
    return {tuple(row["phones"].split()): row["arpabet"] for row in rows}
