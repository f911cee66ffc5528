"""Captions are correct after phones, revisions and withdrawals in any order."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import load_inventory
from kouxing.shared.phones.known_text import characters_of
from kouxing.shared.phones.syllables import MAX_PHONES, Syllable, SyllableTrack

pytestmark = pytest.mark.property
MANDARIN = load_inventory("mandarin")
SYMBOLS = [*sorted(MANDARIN.initials), *sorted(MANDARIN.vowels), MANDARIN.silence, "?"]
PHONES = st.builds(
    Phone,
    index=st.integers(0, MAX_PHONES - 1),
    symbol=st.sampled_from(SYMBOLS),
    onset_s=st.floats(0, 100),
    duration_s=st.sampled_from([0.0, 0.1]),  # 0: withdrawn
    confidence=st.just(1.0),
    final=st.booleans(),
)


@given(phones=st.lists(PHONES, max_size=30), text=st.sampled_from(["", "你好欢迎来到"]))
def test_shows_exactly_the_phones_that_are_not_withdrawn(phones: list[Phone], text: str) -> None:
    track = SyllableTrack(MANDARIN, characters_of(text, MANDARIN))
    shown: dict[int, Syllable] = {}
    current: set[int] = set()
    for phone in phones:
        current.add(phone.index)
        if phone.is_withdrawn:
            current.remove(phone.index)
        for syllable in track.update(phone):
            shown[syllable.index] = syllable
            if syllable.duration_s == 0.0:
                del shown[syllable.index]
        assert shown.keys() <= current
