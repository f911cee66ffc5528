"""Captions of live speech: combines phones and their revisions into syllables.

The syllables are matched with a known text.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, Syllable

Characters = Sequence[tuple[str, Syllable]]  # each character and its phones
GAP_COST = 0.7  # cost of a missing or inserted syllable; a wrong one costs at most 1


def match_syllables(recognized: Sequence[Syllable], text: Sequence[Syllable]) -> list[int | None]:
    """Return each recognized syllable's index in the text, or None if the text lacks it.

    The recognized syllables contain errors, so they are aligned with the text by edit distance.
    Common phones lower the cost, syllables may be missing or inserted, and the text may continue.
    """
    # costs[i][j]: cost of aligning i recognized syllables with j syllables of the text
    costs = [[GAP_COST * j for j in range(len(text) + 1)]]
    for i, syllable in enumerate(recognized, start=1):
        costs.append([GAP_COST * i])
        for j, spoken in enumerate(text):
            both = costs[i - 1][j] + _syllable_distance(syllable, spoken)
            costs[i].append(min(both, GAP_COST + costs[i - 1][j + 1], GAP_COST + costs[i][j]))
    indices: list[int | None] = [None] * len(recognized)
    i = len(recognized)
    j = min(range(len(text) + 1), key=costs[i].__getitem__)  # the remaining text is not spoken yet
    while i and j:
        if costs[i][j] == costs[i - 1][j - 1] + _syllable_distance(recognized[i - 1], text[j - 1]):
            i, j = i - 1, j - 1
            indices[i] = j
        elif costs[i][j] == GAP_COST + costs[i - 1][j]:
            i -= 1
        else:
            j -= 1
    return indices


def _syllable_distance(recognized: Syllable, spoken: Syllable) -> float:
    """Return 0 for the same syllable, up to 1 without common phones."""
    return 1.0 - len({*recognized} & {*spoken}) / max(len(recognized), len(spoken))


def split_characters(text: str, inventory: PhoneInventory) -> Characters:
    """Return the spoken characters of a text, each with its phones.

    Raises ``UserError`` if the text cannot be read, or does not have one character per syllable.
    """
    characters = "".join(inventory.readable.findall(text))
    syllables = inventory.pronounce(characters)
    if len(syllables) != len(characters):
        raise UserError(
            f"{text!r}: {len(characters)} characters do not match {len(syllables)} syllables;"
            " write one character for each syllable"
        )
    return list(zip(characters, syllables, strict=True))


MAX_PHONES = 40  # phones that may still be revised; older ones are dropped


@dataclass(frozen=True, slots=True, kw_only=True)
class CaptionSyllable:
    """One syllable or pause. As with phones, another one with the same ``index`` is a revision."""

    index: int  # index of its first phone
    text: str  # "shi", or the character; the inventory's silence for a pause
    onset_s: float  # seconds from the session's first sample
    duration_s: float  # seconds; 0 withdraws the syllable
    final: bool


class _Source(NamedTuple):
    """Everything that determines a syllable's caption."""

    phones: list[Phone]
    place: int | None  # index of its character; None: it has no character
    next_phone: Phone | None  # first phone of the next syllable


class SyllableCaptions:
    """Combines phones into syllables: first only the initial, then the initial with its vowel.

    If the text is known, matching syllables are shown as its characters.
    """

    def __init__(self, inventory: PhoneInventory, characters: Characters = ()) -> None:
        self.inventory = inventory
        self._characters = characters
        self._num_dropped = 0  # characters before the first kept phone
        self._phones: dict[int, Phone] = {}
        # both by index of the first phone
        self._sources: dict[int, _Source] = {}
        self._syllables: dict[int, CaptionSyllable] = {}

    def reset(self) -> None:
        """Drop all phones when a session restarts."""
        self._phones.clear()
        self._sources.clear()
        self._syllables.clear()
        self._num_dropped = 0

    def update(self, phone: Phone) -> list[CaptionSyllable]:
        """Add or revise a phone; return the syllables that change."""
        if phone.is_withdrawn:
            self._phones.pop(phone.index, None)
        else:
            self._phones[phone.index] = phone
        groups = group_syllables(
            [phone for _, phone in sorted(self._phones.items())], self.inventory
        )
        places = self._places(groups)
        if len(self._phones) > MAX_PHONES:
            oldest, place = groups.pop(0), places.pop(0)
            self._num_dropped = self._num_dropped if place is None else place + 1
            self._sources.pop(oldest[0].index, None)
            self._syllables.pop(oldest[0].index, None)
            for dropped in oldest:
                del self._phones[dropped.index]
        sources = {
            group[0].index: _Source(group, place, following[0] if following else None)
            for place, (group, following) in zip(places, pairwise([*groups, []]), strict=True)
        }
        syllables = {
            index: self._syllables[index]
            if source == self._sources.get(index)
            else self._syllable(source)
            for index, source in sources.items()
        }
        withdrawn = [
            replace(old, duration_s=0.0, final=True)
            for index, old in self._syllables.items()
            if index not in syllables
        ]
        changed = [
            syllable
            for index, syllable in syllables.items()
            if syllable != self._syllables.get(index)
        ]
        self._sources, self._syllables = sources, syllables
        return withdrawn + changed

    def _places(self, groups: list[list[Phone]]) -> list[int | None]:
        """Return the index of each syllable's character; None: it has no character."""
        if not self._characters:
            return [None] * len(groups)
        silence = (self.inventory.silence,)
        symbols = [tuple(phone.symbol for phone in group) for group in groups]
        spoken = [syllable for syllable in symbols if syllable != silence]
        text = [phones for _, phones in self._characters[self._num_dropped :]]
        indices = iter(match_syllables(spoken, text) if text else [None] * len(spoken))
        places = (None if syllable == silence else next(indices) for syllable in symbols)
        return [None if place is None else place + self._num_dropped for place in places]

    def _syllable(self, source: _Source) -> CaptionSyllable:
        phones, place, next_phone = source
        first, last = phones[0], phones[-1]
        # The vowel of an initial may still follow.
        is_complete = last.symbol not in self.inventory.initials or (
            next_phone is not None and next_phone.final
        )
        spelling = self.inventory.spell(tuple(phone.symbol for phone in phones))
        return CaptionSyllable(
            index=first.index,
            text=spelling if place is None else self._characters[place][0],
            onset_s=first.onset_s,
            duration_s=max(0.0, last.end_s - first.onset_s),
            final=is_complete and all(phone.final for phone in phones),
        )


def group_syllables(phones: Sequence[Phone], inventory: PhoneInventory) -> list[list[Phone]]:
    """Group phones in order by syllable."""
    syllables: list[list[Phone]] = []
    for phone in phones:
        follows_initial = syllables and syllables[-1][-1].symbol in inventory.initials
        if follows_initial and phone.symbol in inventory.vowels:
            syllables[-1].append(phone)
        else:
            syllables.append([phone])
    return syllables
