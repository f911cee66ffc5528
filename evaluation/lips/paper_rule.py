"""The output rule of Li et al. 2011, section 2.2, without kouxing's corrections.

A phone is emitted once N = 3 frames agree on it, and never corrected (eq. 4, figure 3). A wrong
phone stays, and its duration stays the mean. In scheme 4 a phone counts when the rule emits the
next one; by then the search has measured its duration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest

from kouxing.corpora.scoring import is_emitted
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.shared.phones.events import Phone, SoundEvent, SpeechChange


def paper_config(acoustic: str) -> RecognizerConfig:
    """Return the configuration of a recognizer with the paper's output rule."""
    return RecognizerConfig(acoustic=acoustic, num_stable_frames=3, min_confidence=0.0)


def without_corrections(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Keep only the phones that the rule emits, renumbered, and all other events: scheme 3."""
    kept: list[SoundEvent] = []
    num_phones = 0
    for event, after in zip_longest(events, events[1:]):
        if not isinstance(event, Phone):
            kept.append(event)
        elif _is_emitted(event, after):
            kept.append(replace(event, index=num_phones))
            num_phones += 1
    return kept


def delay_by_one_phone(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Keep each phone once, when the next is emitted or speech ends: scheme 4."""
    kept: list[SoundEvent] = []
    latest: dict[int, Phone] = {}  # revision of each phone, by index
    middle_s = 0.0  # of the last phone kept; a phone that starts earlier is not new
    for event, after in zip_longest(events, events[1:]):
        delayed = None
        if isinstance(event, Phone):
            latest[event.index] = event
            if _is_emitted(event, after):
                delayed = latest.get(event.index - 1)
        elif isinstance(event, SpeechChange) and not event.active and latest:
            delayed = latest[max(latest)]
        if delayed is not None and delayed.onset_s >= middle_s and not delayed.is_withdrawn:
            kept.append(delayed)
            middle_s = delayed.onset_s + 0.5 * delayed.duration_s
        if not isinstance(event, Phone):
            kept.append(event)
    return kept


def _is_emitted(phone: Phone, after: SoundEvent | None) -> bool:
    return is_emitted(phone, after if isinstance(after, Phone) else None)
