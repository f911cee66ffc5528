"""The phones of a session as far as they are known, each in its newest revision."""

from __future__ import annotations

import math

from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import Timeline, build_timeline
from kouxing.shared.phones.events import Phone, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

_MIN_AGE_S = 0.02  # of a phone that ends with the speech


class KnownPhones:
    """Phones with their revisions, and the times at which speech ended.

    Parameters
    ----------
    inventory : PhoneInventory
        The language.
    """

    def __init__(self, inventory: PhoneInventory) -> None:
        self._inventory = inventory
        self._phones: dict[int, Phone] = {}  # by index
        self._speech_ends_s: list[float] = []
        self._next_index = 0  # after the greatest index seen
        self._first_index = 0  # phones before it were flushed

    def __len__(self) -> int:
        return len(self._phones)

    def accept_phone(self, phone: Phone) -> bool:
        """Take a phone, or a revision of the one with the same index.

        Returns
        -------
        bool
            False if it changes nothing: its symbol or times make no sense, it came from before a
            flush, or its final revision is known already.
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

    def accept_speech(self, change: SpeechChange) -> bool:
        """Take a change of voice activity; return whether it is an end of speech.

        Phones recognised before this event have ended, even if the event's time is earlier.
        """
        if change.active or not math.isfinite(change.time_s):
            return False
        least_s = [phone.onset_s + _MIN_AGE_S for phone in self._phones.values()]
        self._speech_ends_s.append(max([change.time_s, *least_s]))
        return True

    def flush(self) -> None:
        """Drop all phones known so far, and their revisions to come."""
        self._phones.clear()
        self._speech_ends_s.clear()
        self._first_index = self._next_index

    def forget_before(self, time_s: float) -> list[int]:
        """Forget phones that ended before a time; return their indices.

        The last two stay: the mouth may still hold them.
        """
        forgotten = []
        for index, phone in list(self._phones.items()):
            if phone.onset_s + phone.duration_s < time_s and len(self._phones) > 2:
                del self._phones[index]
                forgotten.append(index)
        self._speech_ends_s = [end_s for end_s in self._speech_ends_s if end_s >= time_s]
        return forgotten

    def in_order(self) -> list[Phone]:
        """Return all known phones by their onsets."""
        return sorted(self._phones.values(), key=lambda phone: (phone.onset_s, phone.index))

    def timeline(self) -> Timeline:
        """Place the visemes of all known phones on the time axis."""
        phones = tuple(self._phones.values())
        return build_timeline(phones, self._inventory, self._speech_ends_s, live=True)
