"""Keeps the known phones of a session, each in its newest revision."""

import math

from kouxing.shared.phones.events import Phone, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

RECOGNIZED_AFTER_S = 0.09  # most phones are recognized within this time after their onset
_MIN_AGE_S = 0.02  # minimum duration of a phone that ends with the speech


class KnownPhones:
    """Phones with their revisions, and the times at which speech ended."""

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self._phones: dict[int, Phone] = {}  # by index
        self.speech_ends_s: list[float] = []
        self._next_index = 0  # the greatest known index plus one
        self._first_index = 0  # earlier phones were flushed

    def __len__(self) -> int:
        return len(self._phones)

    def add_phone(self, phone: Phone) -> bool:
        """Add a phone or a revision; return whether this changes anything.

        Invalid phones, phones from before a flush, and revisions of final phones change nothing.
        """
        times = (phone.onset_s, phone.duration_s)
        if (
            phone.symbol not in self._inventory.index
            or not all(map(math.isfinite, times))
            or phone.index < self._first_index
        ):
            return False
        self._next_index = max(self._next_index, phone.index + 1)
        known = self._phones.get(phone.index)
        if known is not None and known.final and not phone.final:
            return False
        if phone.is_withdrawn:
            return self._phones.pop(phone.index, None) is not None
        self._phones[phone.index] = phone
        return True

    def add_speech_change(self, change: SpeechChange) -> bool:
        """Add a change of voice activity; return whether speech has ended.

        Phones recognized before this event have ended, even if the event's time is earlier.
        """
        if change.active or not math.isfinite(change.time_s):
            return False
        earliest_s = [phone.onset_s + _MIN_AGE_S for phone in self._phones.values()]
        self.speech_ends_s.append(max([change.time_s, *earliest_s]))
        return True

    def flush(self) -> None:
        """Drop all known phones and their future revisions."""
        self._phones.clear()
        self.speech_ends_s.clear()
        self._first_index = self._next_index

    def forget_before(self, time_s: float) -> list[int]:
        """Drop phones that ended before a time, except the last two; return their indices."""
        forgotten = []
        for index, phone in list(self._phones.items()):
            if phone.end_s < time_s and len(self._phones) > 2:
                del self._phones[index]
                forgotten.append(index)
        self.speech_ends_s = [end_s for end_s in self.speech_ends_s if end_s >= time_s]
        return forgotten

    def sorted_by_onset(self) -> list[Phone]:
        """Return all known phones by onset."""
        return sorted(self._phones.values(), key=lambda phone: (phone.onset_s, phone.index))
