"""Matches recognized syllables with a known text, for its captions.

The recognized syllables contain errors, so they are aligned with the text by edit distance. Common
phones lower the cost, syllables may be missing or inserted, and the text may continue.
"""

from collections.abc import Sequence

from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory, Syllable

Characters = Sequence[tuple[str, Syllable]]  # each character and its phones
GAP = 0.7  # cost of a missing or inserted syllable; a wrong one costs up to 1


def match_syllables(recognized: Sequence[Syllable], text: Sequence[Syllable]) -> list[int | None]:
    """Return the index in the text of each syllable recognized so far; None: not in the text."""
    # costs[i][j]: of i recognized syllables and j of the text
    costs = [[GAP * j for j in range(len(text) + 1)]]
    for i, syllable in enumerate(recognized, start=1):
        costs.append([GAP * i])
        for j, spoken in enumerate(text):
            both = costs[i - 1][j] + _syllable_distance(syllable, spoken)
            costs[i].append(min(both, GAP + costs[i - 1][j + 1], GAP + costs[i][j]))
    indices: list[int | None] = [None] * len(recognized)
    i = len(recognized)
    j = min(range(len(text) + 1), key=costs[i].__getitem__)  # the remaining text is not spoken yet
    while i and j:
        if costs[i][j] == costs[i - 1][j - 1] + _syllable_distance(recognized[i - 1], text[j - 1]):
            i, j = i - 1, j - 1
            indices[i] = j
        elif costs[i][j] == GAP + costs[i - 1][j]:
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
