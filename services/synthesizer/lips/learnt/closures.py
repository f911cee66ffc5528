"""Lips that meet: by what the sound tells of the lips and of the phone, decided together.

Either source errs: the one confuses p with t, the other rounds closures off. Their evidence is
added as log odds: a recognised b, p, m raises the odds of a closure, and a probability of the sound
that is high enough needs no phone. Without a phone, lips are shut the less, the wider apart the
sound tells them to be, so that they part in time, and the more it rounds them: in u and w they
nearly meet. Phones are no evidence against a closure, so a p that is taken for a t cannot open lips
that the sound has shut; and no phone alone can shut lips that the sound tells to be wide open. Of a
whole recording the phones are known better: there they part lips, too, and a vowel between two
closing phones parts them in its middle.

Lower lip to upper teeth, as in f, is the phone's to decide: the sound tells it too badly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]

_LOWEST, _HIGHEST = 0.002, 0.998  # probabilities that count
_HELD_S = 0.08  # after its onset a phone's lips are shut for so long at most,
_DECIDED_S = 0.04  # and for so long after the phone is known, if it comes late,
_LATEST_S = 0.1  # but not this long after its onset
_EDGE_S = 0.02  # in which a phone's evidence rises and falls
_MIDDLE = 0.3  # of a vowel's duration on either side of its middle, where it counts
_PARTED, _WIDE_APART = 100.0, 300.0  # FAP units of opening
_ROUNDED = -100.0  # FAP units of width
_INNER_LIPS, _CORNERS = ([MOUTH_FAPS.index(fap) for fap in pair] for pair in ((4, 5), (6, 7)))


@dataclass(frozen=True, slots=True)
class ClosureRule:
    """How the evidence is weighed.

    Chosen on speakers left out of training.
    """

    sound: float = 2.0  # added to the sound's log odds: it rather misses a closure than invents one
    phone: float = 2.2  # log odds that a phone adds at most
    other: float = 0.0  # log odds that a phone which closes nothing takes away at most
    vowel: float = 0.0  # times its log odds that a vowel between two closing phones takes away
    doubt: float = 0.8  # log odds around 0 within which lips are led part of the way
    # log odds lost, unless a phone tells the closure, for each FAP unit
    parted: float = 0.02  # of an opening above 100, up to 300
    rounded: float = 0.012  # of a width below -100

    def log_odds(self, faps: Array, sound: float, phones: float) -> float:
        """Weigh the evidence of a closure.

        Parameters
        ----------
        faps
            The mouth that the sound tells, (num_mouth_faps,), FAP units.
        sound
            Log odds of a closure that the sound tells.
        phones
            Log odds that the recognised phones add.
        """
        opening = -float(faps[_INNER_LIPS].sum())
        width = float(faps[_CORNERS].sum())
        apart = self.parted * (min(max(opening, _PARTED), _WIDE_APART) - _PARTED)
        narrow = self.rounded * max(0.0, _ROUNDED - width)
        unsupported = 1.0 - phones / self.phone
        return self.sound + sound + phones - unsupported * (apart + narrow)


_UPPER_LIP = [(4, 51), (8, 55), (9, 56)]  # FAPs of the inner and the outer lip
_LOWER_LIP = [(5, 52), (10, 57), (11, 58)]


class ClosingPhones:
    """The recognised phones of one kind of closure, such as b p m.

    Parameters
    ----------
    inventory
        The language.
    viseme
        First viseme of the phones: "b" or "f".
    rule
        How much phones count.
    """

    def __init__(self, inventory: PhoneInventory, viseme: str, rule: ClosureRule) -> None:
        self._rule = rule
        self._silence = inventory.silence
        self._vowels = inventory.vowels
        self._symbols = {
            symbol for symbol, shares in inventory.visemes.items() if shares[0][0] == viseme
        }
        self._phones: dict[int, tuple[Phone, float]] = {}  # by index, with when they were known

    def accept(self, phone: Phone, now_s: float) -> None:
        """Take a phone or a revision; ``now_s`` is the time of the mouth that is due."""
        known, known_s = self._phones.pop(phone.index, (None, now_s))
        if known is not None and known.final and not phone.final:
            phone = known
        counts = not phone.is_withdrawn and (
            phone.symbol in self._symbols
            or (self._rule.other > 0.0 and phone.symbol != self._silence)
        )
        if counts and math.isfinite(phone.onset_s + phone.duration_s):
            self._phones[phone.index] = (phone, known_s)

    def forget_before(self, time_s: float) -> None:
        """Forget phones that began before a time."""
        self._phones = {i: each for i, each in self._phones.items() if each[0].onset_s >= time_s}

    def clear(self) -> None:
        """Forget all phones."""
        self._phones.clear()

    def log_odds(self, time_s: float) -> float:
        """Return what the phones add to the log odds of a closure at a time."""
        closing = [each for each in self._phones.values() if each[0].symbol in self._symbols]
        added = max((self._of(*each, time_s) for each in closing), default=0.0)
        if added > 0.0 or self._rule.other == 0.0:
            return added
        return -max(
            (
                self._against(phone, time_s)
                for phone, _ in self._phones.values()
                if phone.symbol not in self._symbols
                and phone.onset_s <= time_s < phone.onset_s + phone.duration_s
            ),
            default=0.0,
        )

    def _against(self, phone: Phone, time_s: float) -> float:
        """Return what a phone that closes nothing takes away during it."""
        log_odds = log_odds_of(max(phone.confidence, 0.5))
        taken = min(log_odds, self._rule.other)
        if phone.symbol in self._vowels and self._is_between_closures(phone):
            from_middle = abs((time_s - phone.onset_s) / phone.duration_s - 0.5)
            share = max(0.0, 1.0 - from_middle / _MIDDLE)
            taken = max(taken, self._rule.vowel * log_odds * share)
        return taken

    def _is_between_closures(self, phone: Phone) -> bool:
        neighbours = (self._phones.get(phone.index + step) for step in (-1, 1))
        return all(each is not None and each[0].symbol in self._symbols for each in neighbours)

    def _of(self, phone: Phone, known_s: float, time_s: float) -> float:
        most = min(log_odds_of(max(phone.confidence, 0.5)), self._rule.phone)
        end_s = phone.onset_s + min(phone.duration_s, _HELD_S)
        if known_s < phone.onset_s + _LATEST_S:
            end_s = max(end_s, known_s + _DECIDED_S)
        away_s = max(phone.onset_s - time_s, time_s - end_s, 0.0)
        return most * max(0.0, 1.0 - away_s / _EDGE_S)


def log_odds_of(probability: float) -> float:
    """Return the log odds of a probability, which counts from 0.002 to 0.998."""
    counted = min(max(probability, _LOWEST), _HIGHEST)
    return math.log(counted / (1.0 - counted))


def shut_share(log_odds: float, doubt: float) -> float:
    """Tell how far lips are led to their closure: 0, they stay as they are, to 1, shut."""
    part = min(max(0.5 + 0.5 * log_odds / doubt, 0.0), 1.0)
    return part * part * (3.0 - 2.0 * part)


def close_lips(faps: Array, share: float) -> None:
    """Lead both lips, FAPs (num_mouth_faps,), towards where they meet, in place."""
    _lead_home(faps, share, _UPPER_LIP + _LOWER_LIP)


def lip_to_teeth(faps: Array, share: float) -> None:
    """Lead the lower lip towards the upper teeth, in place."""
    _lead_home(faps, share, _LOWER_LIP)


def part_lips(faps: Array) -> None:
    """Take apart lips that pass through each other, in place."""
    for (upper, upper_outer), (lower, lower_outer) in zip(_UPPER_LIP, _LOWER_LIP, strict=True):
        crossed = max(0.0, faps[_column(upper)] + faps[_column(lower)])
        faps[[_column(fap) for fap in (upper, upper_outer, lower, lower_outer)]] -= 0.5 * crossed


def _lead_home(faps: Array, share: float, lips: list[tuple[int, int]]) -> None:
    """Lead inner lips to their place at rest; the outer ones go along."""
    for inner, outer in lips:
        moved = share * faps[_column(inner)]
        faps[_column(inner)] -= moved
        faps[_column(outer)] -= moved


def _column(fap: int) -> int:
    return MOUTH_FAPS.index(fap)
