"""Captions of a text that is known: which of its syllables is spoken, as far as has been heard.

What is recognised has errors, so it is aligned with the text by edit distance: phones that agree
count, syllables may be missed or one too many, and the text need not have come to its end.
"""

from __future__ import annotations

from collections.abc import Sequence

from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory, Syllable

Characters = Sequence[tuple[str, Syllable]]  # what is written, and its phones
GAP = 0.7  # cost of a syllable that was missed, or one too many; a wrong one costs 1


def place_in_text(heard: Sequence[Syllable], text: Sequence[Syllable]) -> list[int | None]:
    """Return the syllable of the text that each heard one stands for; None: none does.

    Parameters
    ----------
    heard
        The syllables so far, each as phones.
    text
        All syllables of the text, each as phones.
    """
    costs = [[GAP * j for j in range(len(text) + 1)]]  # [i][j]: of i heard and j of the text
    for i, syllable in enumerate(heard, start=1):
        costs.append([GAP * i])
        for j, spoken in enumerate(text):
            both = costs[i - 1][j] + _difference(syllable, spoken)
            costs[i].append(min(both, GAP + costs[i - 1][j + 1], GAP + costs[i][j]))
    places: list[int | None] = [None] * len(heard)
    i = len(heard)
    j = min(range(len(text) + 1), key=costs[i].__getitem__)  # the rest is still to come
    while i and j:
        if costs[i][j] == costs[i - 1][j - 1] + _difference(heard[i - 1], text[j - 1]):
            i, j = i - 1, j - 1
            places[i] = j
        elif costs[i][j] == GAP + costs[i - 1][j]:
            i -= 1
        else:
            j -= 1
    return places


def _difference(heard: Syllable, spoken: Syllable) -> float:
    """Return 0 for the same syllable, up to 1 where no phone agrees."""
    return 1.0 - len({*heard} & {*spoken}) / max(len(heard), len(spoken))


def characters_of(text: str, inventory: PhoneInventory) -> Characters:
    """Return the characters of a text that are spoken, each with its phones.

    Raises
    ------
    UserError
        If the text cannot be read, or is not written with one character a syllable.
    """
    characters = "".join(inventory.readable.findall(text))
    syllables = inventory.pronounce(characters)
    if len(syllables) != len(characters):
        raise UserError(f"{text!r} has {len(syllables)} syllables and {len(characters)} characters")
    return list(zip(characters, syllables, strict=True))
