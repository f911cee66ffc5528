"""Lips that meet: by what the sound tells of the lips and of the phone, decided together.

Either source errs: the one confuses p with t, the other rounds closures off. Their evidence is
added as log odds: a recognised b, p, m (or f) raises the odds of a closure, and a probability of
the sound that is high enough needs no phone. Phones are no evidence against a closure, so a p that
is taken for a t cannot open lips that the sound has shut; and no phone alone can shut lips that
the sound tells to be open.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from shared.phones.events import Phone
from shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

MAX_PHONE_LOG_ODDS = 2.2  # of a phone of confidence 0.9; a closure needs 0.1 from the sound then
_LOWEST, _HIGHEST = 0.002, 0.998  # probabilities that count
_OPEN, _SHUT = 0.4, 0.6  # probabilities below and above which nothing is left to doubt
_NEIGHBOUR = 0.8  # a closure takes the frames beside it along, so that averaging leaves it shut
_HELD_S = 0.08  # after its onset a phone's lips are shut for so long at most
_EDGE_S = 0.03  # in which a phone's evidence rises and falls


class ClosingPhones:
    """The recognised phones of one kind of closure, such as b p m.

    Parameters
    ----------
    inventory
        The language.
    viseme
        First viseme of the phones: "b" or "f".
    """

    def __init__(self, inventory: PhoneInventory, viseme: str) -> None:
        self._symbols = {
            symbol for symbol, shares in inventory.visemes.items() if shares[0][0] == viseme
        }
        self._phones: dict[int, Phone] = {}  # by index

    def accept(self, phone: Phone) -> bool:
        """Take a phone or a revision; return whether it changes anything."""
        known = self._phones.pop(phone.index, None)
        if known is not None and known.final and not phone.final:
            self._phones[phone.index] = known
            return False
        if phone.symbol in self._symbols and math.isfinite(phone.onset_s + phone.duration_s):
            self._phones[phone.index] = phone
        return known != self._phones.get(phone.index)

    def forget_before(self, time_s: float) -> None:
        """Forget phones that began before a time."""
        self._phones = {i: phone for i, phone in self._phones.items() if phone.onset_s >= time_s}

    def log_odds(self, time_s: Array) -> Array:
        """Return what the phones add to the log odds of a closure at some times, shape (n,)."""
        added = np.zeros(len(time_s))
        for phone in self._phones.values():
            confidence = min(max(phone.confidence, 0.5), _HIGHEST)
            most = min(math.log(confidence / (1.0 - confidence)), MAX_PHONE_LOG_ODDS)
            end_s = phone.onset_s + min(phone.duration_s, _HELD_S)
            away_s = np.maximum(phone.onset_s - time_s, time_s - end_s)
            added = np.maximum(added, most * np.clip(1.0 - away_s / _EDGE_S, 0.0, 1.0))
        return added


def shut_share(probability: Array, phone_log_odds: Array) -> Array:
    """Tell how far lips are led to their closure.

    Parameters
    ----------
    probability
        Of a closure, from the sound, at every lip frame, shape (n,).
    phone_log_odds
        What recognised phones add, shape (n,).

    Returns
    -------
    array (n,)
        0: they stay as they are, 1: shut.
    """
    from_sound = np.clip(probability, _LOWEST, _HIGHEST)
    log_odds = np.log(from_sound / (1.0 - from_sound)) + phone_log_odds
    part = np.clip((1.0 / (1.0 + np.exp(-log_odds)) - _OPEN) / (_SHUT - _OPEN), 0.0, 1.0)
    share = part * part * (3.0 - 2.0 * part)
    widened = share.copy()
    widened[1:] = np.maximum(widened[1:], _NEIGHBOUR * share[:-1])
    widened[:-1] = np.maximum(widened[:-1], _NEIGHBOUR * share[1:])
    return widened
