"""Phones of several recognizers, one after the other, numbered as if they came from one.

A recognizer that takes the place of a lost one counts phones anew. Those of the lost one that were
not final are void. One that comes again keeps its place, so that the mouth notices nothing.
"""

from __future__ import annotations

from dataclasses import replace

from kouxing.shared.phones.events import Phone

_SAME_S = 0.05  # between the onsets of a phone that two recognizers tell


class PhoneNumbers:
    """Gives each phone of a session an index of its own."""

    def __init__(self) -> None:
        self._base = 0  # of the recognizer's indices
        self._next = 0  # after the greatest index given
        self._places: dict[int, int] = {}  # of void phones that came again, by their new index
        self._open: dict[int, Phone] = {}  # not final, by index
        self._void: dict[int, Phone] = {}  # not final when another recognizer began

    def restart(self) -> None:
        """Another recognizer begins."""
        self._void |= self._open
        self._open.clear()
        self._places.clear()
        self._base = self._next

    def place(self, phone: Phone) -> Phone:
        """Return a phone of the recognizer, or a revision, with its index among all phones."""
        index = self._places.get(phone.index, self._base + phone.index)
        again = [each.index for each in self._void.values() if _is_same(each, phone)]
        if again and index not in self._open:
            index = self._places[phone.index] = again[0]
            del self._void[index]
        placed = replace(phone, index=index)
        self._next = max(self._next, index + 1)
        self._open.pop(index, None)
        if not phone.final:
            self._open[index] = placed
        return placed

    def take_withdrawn(self) -> list[Phone]:
        """Return the void phones that did not come again, withdrawn; each once."""
        withdrawn = [replace(phone, duration_s=0.0, final=True) for phone in self._void.values()]
        self._void.clear()
        return withdrawn


def _is_same(one: Phone, other: Phone) -> bool:
    return one.symbol == other.symbol and abs(one.onset_s - other.onset_s) < _SAME_S
