"""Places visemes and silences on the time axis.

Source: Li et al. 2011, 2.3.1 (compound finals become several visemes), Wang & Cai 2003, section 3
(positions of the silence models).

The *apex* of a viseme is the time of its maximum effect (the papers' center). Deviations: The apex
of a viseme longer than twice ``EDGE_S`` is an interval, so that a long vowel is held instead of
fading from its middle. Eq. 5 then uses the distance to the nearer end. Live, an expected viseme
follows the last known phone, because a vowel follows every initial and an initial follows most
vowels. The mouth therefore starts in time for a phone that will be recognized late.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX, visemes_of
from kouxing.services.synthesizer.lips.known_phones import RECOGNIZED_AFTER_S
from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.shared.fast_record import Record, replace
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory

EXPECTED_PHONE_INDEX = -1  # index of a viseme that is expected but not yet recognized
MAX_HOLD_S = 1.5  # limit for extending a phone beyond its estimated end if nothing follows
_HOLD_SOFTNESS_S = 0.03
_HOLD_FACTOR = 2.0  # with lower values, a long vowel half closes before it is held
_EXPECTED_AFTER_S = 0.3  # the mouth relaxes after the expected viseme has lasted this long
# expected visemes: a medium vowel; after a vowel, a less open mouth that keeps its rounding
_EXPECTED_AFTER_INITIAL, _EXPECTED_AFTER_VOWEL, _EXPECTED_AFTER_ROUNDED = "ei", "i", "u"
_ROUNDED_AT_THE_END = frozenset({"o", "ou", "u", "v", "w", "oe", "oeh", "aw"})
EDGE_S = 0.08  # maximum distance of a viseme's apex from its start and end
_MIN_PHONE_S = 0.01
_TOUCHING_S = 0.03  # shorter gaps between phones are rounding errors
_MAX_ERROR_S = 0.3  # an estimated end may be too early by this time
_EXPECTED_EDGE_S = 0.02


class OpenPhone(Record, frozen=True):
    """The last phone, if its successor is unknown.

    It is the second-last viseme of the timeline, before the expected viseme and the last silence.
    """

    end_s: float  # estimated, seconds
    is_held: bool  # whether it ends in a vowel, which may be held


class Timeline(Record, frozen=True, kw_only=True):
    """Visemes sorted by time, and the silences before, between and after words."""

    viseme: NDArray[np.intp]  # (num_visemes,) rows of VisemeParameters
    apex_start_s: Doubles  # (num_visemes,) seconds
    apex_end_s: Doubles  # (num_visemes,) seconds, not before apex_start_s
    phone_index: Integers  # (num_visemes,) Phone.index, or EXPECTED_PHONE_INDEX
    silence_start_s: Doubles  # (num_silences,) end of speech; -inf before all speech
    silence_end_s: Doubles  # (num_silences,) start of speech; inf after all speech
    syllable_s: Doubles  # (num_syllables,) onset of each syllable's vowel
    open_phone: OpenPhone | None = None

    def select(self, selected: Mask | NDArray[np.intp]) -> Timeline:
        """Return a timeline with selected visemes (mask or rows), all silences and syllables."""
        return Timeline(
            viseme=self.viseme[selected],
            apex_start_s=self.apex_start_s[selected],
            apex_end_s=self.apex_end_s[selected],
            phone_index=self.phone_index[selected],
            silence_start_s=self.silence_start_s,
            silence_end_s=self.silence_end_s,
            syllable_s=self.syllable_s,
        )

    def has_same_visemes(self, other: Timeline) -> bool:
        """Return whether another timeline has the same visemes and phones; times may differ."""
        return (self.viseme.tobytes(), self.phone_index.tobytes()) == (
            other.viseme.tobytes(),
            other.phone_index.tobytes(),
        )

    def nearest(self, time_s: float) -> int | None:
        """Return the ``VisemeParameters`` row of the viseme nearest to a time; None if empty."""
        if not len(self.viseme):
            return None
        distance_s = np.maximum(self.apex_start_s - time_s, time_s - self.apex_end_s)
        return int(self.viseme[distance_s.argmin()])

    def extend_open_phone(self, known_s: float) -> Timeline:
        """Extend the open phone, given that the audio is known up to ``known_s``.

        A successor that started `RECOGNIZED_AFTER_S` earlier would be known. The phone's end moves
        smoothly from the estimate to that time. A held phone moves beyond it, because a long phone
        is likely to continue. The extension is at most ``MAX_HOLD_S``.
        """
        if self.open_phone is None:
            return self
        no_successor_before_s = known_s - RECOGNIZED_AFTER_S
        overdue_s = _HOLD_SOFTNESS_S * np.logaddexp(
            0.0, (no_successor_before_s - self.open_phone.end_s) / _HOLD_SOFTNESS_S
        )
        factor = _HOLD_FACTOR if self.open_phone.is_held else 1.0
        later_s = min(factor * float(overdue_s), MAX_HOLD_S)
        start_s, end_s = self.apex_start_s.copy(), self.apex_end_s.copy()
        silence_start_s = self.silence_start_s.copy()
        start_s[-1] += later_s
        end_s[-2:] += later_s
        silence_start_s[-1] += later_s
        return replace(
            self,
            apex_start_s=start_s,
            apex_end_s=end_s,
            silence_start_s=silence_start_s,
            open_phone=None,
        )


def build_timeline(
    phones: Sequence[Phone],
    inventory: PhoneInventory,
    speech_ends_s: Sequence[float] = (),
    *,
    is_live: bool = False,
) -> Timeline:
    """Place visemes and silences.

    ``phones`` may be in any order. Silence and ``speech_ends_s`` end the speech before them.
    If ``is_live``, more phones may follow: the last phone is open unless speech has ended, and the
    durations of phones that are not final are estimates.
    """
    in_order = sorted(phones, key=lambda phone: (phone.onset_s, phone.index))
    silence = inventory.silence
    pauses_s = sorted(
        [*speech_ends_s, *(phone.onset_s for phone in in_order if phone.symbol == silence)]
    )
    spoken = [phone for phone in in_order if phone.symbol != silence]

    visemes: list[_PlacedViseme] = []
    silences: list[tuple[float, float]] = []
    open_phone: OpenPhone | None = None
    if spoken:
        silences.append((-np.inf, spoken[0].onset_s))
    for number, phone in enumerate(spoken):
        following = spoken[number + 1] if number + 1 < len(spoken) else None
        next_onset_s = following.onset_s if following is not None else np.inf
        if not phone.final and next_onset_s - phone.onset_s < _MIN_PHONE_S:
            continue  # revised to almost nothing
        pause_s = next((time_s for time_s in pauses_s if time_s > phone.onset_s), np.inf)
        max_end_s = min(pause_s, next_onset_s)
        end_s = _end_of(phone, max_end_s, is_estimate=is_live and not phone.final)
        if is_live and max_end_s == np.inf:
            open_phone = OpenPhone(end_s, _is_held(phone.symbol, inventory))
        is_touching = end_s == next_onset_s
        if not is_touching:
            silence_s = end_s if open_phone is None else end_s + _EXPECTED_AFTER_S
            silences.append((silence_s, next_onset_s))
        end_s = max(end_s, phone.onset_s + _MIN_PHONE_S)
        next_symbol = following.symbol if following is not None and is_touching else None
        visemes += _place_visemes(phone, next_symbol, end_s, inventory)
    visemes.sort(key=lambda placed: placed[1:])  # by time
    if open_phone is not None:
        expected = _PlacedViseme(
            row=VISEME_INDEX[_expected_after(spoken[-1].symbol, inventory)],
            apex_start_s=open_phone.end_s + _EXPECTED_EDGE_S,
            apex_end_s=open_phone.end_s + _EXPECTED_AFTER_S,
            phone_index=EXPECTED_PHONE_INDEX,
        )
        visemes.append(expected)
    return Timeline(
        viseme=np.array([placed.row for placed in visemes], dtype=np.intp),
        apex_start_s=np.array([placed.apex_start_s for placed in visemes], dtype=float),
        apex_end_s=np.array([placed.apex_end_s for placed in visemes], dtype=float),
        phone_index=np.array([placed.phone_index for placed in visemes], dtype=np.int64),
        silence_start_s=np.array([start_s for start_s, _ in silences], dtype=float),
        silence_end_s=np.array([end_s for _, end_s in silences], dtype=float),
        syllable_s=np.array(
            [phone.onset_s for phone in spoken if phone.symbol not in inventory.initials]
        ),
        open_phone=open_phone,
    )


class _PlacedViseme(NamedTuple):
    """One viseme of the timeline."""

    row: int  # in VisemeParameters
    apex_start_s: float
    apex_end_s: float
    phone_index: int


def _end_of(phone: Phone, max_end_s: float, *, is_estimate: bool) -> float:
    """Return the end of a phone, extended to ``max_end_s``, the next phone or pause, if near."""
    end_s = min(phone.onset_s + max(phone.duration_s, _MIN_PHONE_S), max_end_s)
    max_gap_s = _MAX_ERROR_S if is_estimate else _TOUCHING_S
    return max_end_s if max_end_s - end_s < max_gap_s else end_s


def _place_visemes(
    phone: Phone, next_symbol: str | None, end_s: float, inventory: PhoneInventory
) -> list[_PlacedViseme]:
    """Place the visemes of a phone that lasts until ``end_s``."""
    placed, start_s = [], phone.onset_s
    for viseme, fraction in visemes_of(phone.symbol, next_symbol, inventory):
        length_s = fraction * (end_s - phone.onset_s)
        edge_s = min(0.5 * length_s, EDGE_S)
        apex_s = (start_s + edge_s, start_s + length_s - edge_s)
        placed.append(_PlacedViseme(VISEME_INDEX[viseme], *apex_s, phone.index))
        start_s += length_s
    return placed


def _expected_after(symbol: str, inventory: PhoneInventory) -> str:
    """Return the viseme expected after the last known phone."""
    if symbol in inventory.initials:
        return _EXPECTED_AFTER_INITIAL
    if inventory.visemes[symbol][-1][0] in _ROUNDED_AT_THE_END:
        return _EXPECTED_AFTER_ROUNDED
    return _EXPECTED_AFTER_VOWEL


def _is_held(symbol: str, inventory: PhoneInventory) -> bool:
    """Return whether a phone ends in the last viseme of a vowel."""
    last_viseme = inventory.visemes[symbol][-1][0]
    return any(inventory.visemes[vowel][-1][0] == last_viseme for vowel in inventory.vowels)
