"""Renumbers the phones of successive recognizers, as if one recognizer had numbered them.

A recognizer that replaces a lost one numbers phones from 0. Phones of the lost recognizer that were
not final are void. If the new recognizer finds a void phone again, the phone keeps its index.
"""

from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone

_MAX_ONSET_DIFFERENCE_S = 0.05  # maximum onset difference of a phone found by two recognizers


class PhoneRenumberer:
    """Gives each phone of a session a unique index."""

    def __init__(self) -> None:
        self._base = 0  # added to the recognizer's indices
        self._next = 0  # the greatest index plus one
        self._indices: dict[int, int] = {}  # indices of void phones that were found again
        self._open: dict[int, Phone] = {}  # phones that are not final, by index
        self._void: dict[int, Phone] = {}  # phones of lost recognizers that were not final

    def restart(self) -> None:
        """Prepare for the phones of another recognizer."""
        self._void |= self._open
        self._open.clear()
        self._indices.clear()
        self._base = self._next

    def renumber(self, phone: Phone) -> Phone:
        """Return a phone or revision with its index in the session."""
        index = self._indices.get(phone.index, self._base + phone.index)
        matches = [void.index for void in self._void.values() if _is_same(void, phone)]
        if matches and index not in self._open:
            index = self._indices[phone.index] = matches[0]
            del self._void[index]
        renumbered = replace(phone, index=index)
        self._next = max(self._next, index + 1)
        self._open.pop(index, None)
        if not phone.final:
            self._open[index] = renumbered
        return renumbered

    def take_withdrawn(self) -> list[Phone]:
        """Return and forget the void phones that were not found again, as withdrawn phones."""
        withdrawn = [replace(phone, duration_s=0.0, final=True) for phone in self._void.values()]
        self._void.clear()
        return withdrawn


def _is_same(old: Phone, new: Phone) -> bool:
    return old.symbol == new.symbol and abs(old.onset_s - new.onset_s) < _MAX_ONSET_DIFFERENCE_S
