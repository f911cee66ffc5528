"""Captions of live speech: phones put together to syllables as they come and are revised."""

from __future__ import annotations

from dataclasses import dataclass

from shared.phones.events import Phone
from shared.phones.inventory import PhoneInventory

MAX_PHONES = 40  # that may still be revised; older ones are taken for granted


@dataclass(frozen=True, slots=True, kw_only=True)
class Syllable:
    """One syllable, or a pause. The same ``index`` again revises it, as with phones."""

    index: int  # of its first phone
    text: str  # "shi"; of a pause, the inventory's silence
    onset_s: float  # seconds from the session's first sample
    duration_s: float  # seconds; 0 if it is final: there was no such syllable after all
    final: bool


class SyllableTrack:
    """Makes syllables of phones: an initial alone at first, then with the vowel that follows it.

    Parameters
    ----------
    inventory
        The language; its ``spell`` writes the syllables.
    """

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self._phones: dict[int, Phone] = {}
        self._syllables: dict[int, Syllable] = {}

    def reset(self) -> None:
        """Forget all phones, as when a session begins anew."""
        self._phones.clear()
        self._syllables.clear()

    def accept(self, phone: Phone) -> list[Syllable]:
        """Take a phone, or a revision of one; return the syllables that it changes."""
        if phone.is_withdrawn:
            self._phones.pop(phone.index, None)
        else:
            self._phones[phone.index] = phone
        groups = self._groups()
        if len(self._phones) > MAX_PHONES:
            oldest = groups.pop(0)
            self._syllables.pop(oldest[0].index, None)
            for each in oldest:
                del self._phones[each.index]
        syllables = {group[0].index: self._syllable(group) for group in groups}
        withdrawn = [
            Syllable(index=index, text=old.text, onset_s=old.onset_s, duration_s=0.0, final=True)
            for index, old in self._syllables.items()
            if index not in syllables
        ]
        changed = [new for index, new in syllables.items() if self._syllables.get(index) != new]
        self._syllables = syllables
        return withdrawn + changed

    def _groups(self) -> list[list[Phone]]:
        """Return the phones of each syllable, in order."""
        groups: list[list[Phone]] = []
        for _, phone in sorted(self._phones.items()):
            follows_initial = (
                groups
                and groups[-1][-1].symbol in self._inventory.initials
                and phone.symbol in self._inventory.vowels
            )
            if follows_initial:
                groups[-1].append(phone)
            else:
                groups.append([phone])
        return groups

    def _syllable(self, phones: list[Phone]) -> Syllable:
        first, last = phones[0], phones[-1]
        return Syllable(
            index=first.index,
            text=self._inventory.spell(tuple(phone.symbol for phone in phones)),
            onset_s=first.onset_s,
            duration_s=max(0.0, last.onset_s + last.duration_s - first.onset_s),
            final=all(phone.final for phone in phones),
        )
