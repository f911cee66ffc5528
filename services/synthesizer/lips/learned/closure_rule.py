"""Decides from predicted lips and recognized phones when the lips close.

Both sources have errors: phone recognition confuses p with t, and the lip predictor smooths
closures. Their evidence is added as log odds. A recognized b, p or m raises the odds of a closure;
a high predicted probability needs no phone. Without a phone, the odds decrease with the predicted
opening, so that lips open in time, and with rounding, because lips nearly meet in u and w. Phones
are not evidence against a closure, so a p recognized as t cannot open closed lips. A phone alone
cannot close lips that are predicted to be wide open. In a complete recording, phones are more
reliable: other phones open the lips, even in the middle of a vowel between two closing phones.
Only phones move the lower lip to the upper teeth (f), because the lip predictor does not predict
this well.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Doubles
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.face.smoothing import smooth_step
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

_MIN_PROBABILITY, _MAX_PROBABILITY = 0.002, 0.998  # probabilities are clipped to this range
# maximum duration of a closure after the onset of its phone; a phone known later closes nothing
_HOLD_S = 0.08
_EDGE_S = 0.02  # rise and fall time of a phone's evidence
_MIDDLE_HALF_WIDTH = 0.3  # of a vowel, as a fraction of its duration
_PARTED, _WIDE_APART = 100.0, 300.0  # opening, FAP units
_ROUNDED = -100.0  # width, FAP units
_INNER_UPPER, _INNER_LOWER, _LEFT_CORNER, _RIGHT_CORNER = map(MOUTH_FAPS.index, (4, 5, 6, 7))


@dataclass(frozen=True, slots=True)
class ClosureRule:
    """Weights of the evidence, tuned on held-out speakers."""

    sound: float = 2.0  # added to the predictor's log odds, because it misses closures
    phone: float = 4.0  # maximum log odds added by a closing phone
    other: float = 0.0  # maximum log odds subtracted by another phone
    vowel: float = 0.0  # factor of the log odds subtracted by a vowel between two closing phones
    doubt: float = 0.8  # log odds around 0 at which lips close partly
    # log odds subtracted per FAP unit, unless a phone supports the closure
    parted: float = 0.02  # for an opening above 100, up to 300
    rounded: float = 0.012  # for a width below -100

    def log_odds(self, faps: Doubles, sound: float, phones: float) -> float:
        """Return the log odds of a closure.

        ``faps`` are the predicted mouth FAPs (num_mouth_faps,). ``sound`` are the predicted log
        odds, and ``phones`` are the log odds that recognized phones add.
        """
        opening = -float(faps[_INNER_UPPER] + faps[_INNER_LOWER])
        width = float(faps[_LEFT_CORNER] + faps[_RIGHT_CORNER])
        apart = self.parted * (min(max(opening, _PARTED), _WIDE_APART) - _PARTED)
        narrow = self.rounded * max(0.0, _ROUNDED - width)
        unsupported = 1.0 - phones / self.phone
        return self.sound + sound + phones - unsupported * (apart + narrow)


# columns of the middle, left and right points of a lip; the outer lip moves with the inner lip
_UPPER, _UPPER_OUTER, _LOWER, _LOWER_OUTER = (
    np.array([MOUTH_FAPS.index(fap) for fap in faps])
    for faps in ((4, 8, 9), (51, 55, 56), (5, 10, 11), (52, 57, 58))
)
_INNER = np.concatenate([_UPPER, _LOWER])
_OUTER = np.concatenate([_UPPER_OUTER, _LOWER_OUTER])
_BOTH = np.stack([_UPPER, _UPPER_OUTER, _LOWER, _LOWER_OUTER])


class ClosingPhones:
    """The recognized phones with one kind of closure: their first viseme is "b" (b p m) or "f"."""

    def __init__(self, inventory: PhoneInventory, viseme: str, rule: ClosureRule) -> None:
        self._rule = rule
        self._silence = inventory.silence
        self._vowels = inventory.vowels
        self._symbols = {
            symbol for symbol, visemes in inventory.visemes.items() if visemes[0][0] == viseme
        }
        self._phones: dict[int, Phone] = {}  # by index

    def add(self, phone: Phone) -> None:
        """Add a phone or a revision."""
        known = self._phones.pop(phone.index, None)
        if known is not None and known.final and not phone.final:
            phone = known
        counts = not phone.is_withdrawn and (
            phone.symbol in self._symbols
            or (self._rule.other > 0.0 and phone.symbol != self._silence)
        )
        if counts and math.isfinite(phone.end_s):
            self._phones[phone.index] = phone

    def forget_before(self, time_s: float) -> None:
        """Forget phones that ended before a time."""
        self._phones = {
            index: phone for index, phone in self._phones.items() if phone.end_s >= time_s
        }

    def clear(self) -> None:
        """Forget all phones."""
        self._phones.clear()

    def log_odds(self, time_s: float) -> float:
        """Return the log odds of a closure that the phones add at a time."""
        closing = [phone for phone in self._phones.values() if phone.symbol in self._symbols]
        added = max((self._closing_phone_log_odds(phone, time_s) for phone in closing), default=0.0)
        if added > 0.0 or self._rule.other == 0.0:
            return added
        return -max(
            (
                self._open_phone_log_odds(phone, time_s)
                for phone in self._phones.values()
                if phone.symbol not in self._symbols and phone.onset_s <= time_s < phone.end_s
            ),
            default=0.0,
        )

    def _open_phone_log_odds(self, phone: Phone, time_s: float) -> float:
        """Return the log odds that a phone without closure subtracts."""
        log_odds = log_odds_of(max(phone.confidence, 0.5))
        subtracted = min(log_odds, self._rule.other)
        if phone.symbol in self._vowels and self._is_between_closures(phone):
            from_middle = abs((time_s - phone.onset_s) / phone.duration_s - 0.5)
            weight = max(0.0, 1.0 - from_middle / _MIDDLE_HALF_WIDTH)
            subtracted = max(subtracted, self._rule.vowel * log_odds * weight)
        return subtracted

    def _is_between_closures(self, phone: Phone) -> bool:
        neighbors = (self._phones.get(phone.index + step) for step in (-1, 1))
        return all(
            neighbor is not None and neighbor.symbol in self._symbols for neighbor in neighbors
        )

    def _closing_phone_log_odds(self, phone: Phone, time_s: float) -> float:
        maximum = min(log_odds_of(max(phone.confidence, 0.5)), self._rule.phone)
        end_s = phone.onset_s + min(phone.duration_s, _HOLD_S)
        outside_s = max(phone.onset_s - time_s, time_s - end_s, 0.0)
        return maximum * max(0.0, 1.0 - outside_s / _EDGE_S)


def log_odds_of(probability: float) -> float:
    """Return the log odds of a probability clipped to 0.002 to 0.998."""
    clipped = min(max(probability, _MIN_PROBABILITY), _MAX_PROBABILITY)
    return math.log(clipped / (1.0 - clipped))


def compute_closure_amount(log_odds: float, doubt: float) -> float:
    """Return how far lips move to their closure, from 0 (unchanged) to 1 (closed)."""
    return smooth_step(0.5 + 0.5 * log_odds / doubt)


def close_lips(faps: Doubles, amount: float) -> None:
    """Move both lips, FAPs (num_mouth_faps,), toward their closure, in place."""
    _move_to_rest(faps, amount, _INNER, _OUTER)


def move_lip_to_teeth(faps: Doubles, amount: float) -> None:
    """Move the lower lip toward the upper teeth, in place."""
    _move_to_rest(faps, amount, _LOWER, _LOWER_OUTER)


def separate_lips(faps: Doubles) -> None:
    """Separate lips that pass through each other, in place."""
    crossed = faps[_UPPER] + faps[_LOWER]
    if (crossed > 0.0).any():
        faps[_BOTH] -= 0.5 * np.maximum(crossed, 0.0)


def _move_to_rest(
    faps: Doubles, amount: float, inner: NDArray[np.intp], outer: NDArray[np.intp]
) -> None:
    """Move inner lips toward rest, and the outer lips by the same distance."""
    if amount > 0.0:
        moved = amount * faps[inner]
        faps[inner] -= moved
        faps[outer] -= moved
