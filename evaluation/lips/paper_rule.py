"""What a face is told by the output rule of Li et al. 2011, section 2.2, to the letter.

A phone is emitted once N = 3 frames agree on it, and never corrected (eq. 4, figure 3): neither a
wrong one nor its duration, which stays the mean. Phones that the rule passed over are never told.
In scheme 4 the phone before a new one is told when the rule emits the new one, as the search has it
then; so it has its measured duration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import zip_longest

from kouxing.corpora.scoring import is_emitted
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.shared.phones.events import Phone, SoundEvent, SpeechChange


def paper_config(acoustic: str) -> RecognizerConfig:
    """Return the settings of a recognizer that emits phones as the paper's does."""
    return RecognizerConfig(acoustic=acoustic, num_stable_frames=3, min_confidence=0.0)


def as_emitted(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Leave the phones as the rule emits them, numbered anew, and all other events: scheme 3."""
    told: list[SoundEvent] = []
    num_phones = 0
    for event, after in zip_longest(events, events[1:]):
        if not isinstance(event, Phone):
            told.append(event)
        elif _is_emitted(event, after):
            told.append(replace(event, index=num_phones))
            num_phones += 1
    return told


def once_the_next_is_emitted(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Tell each phone once, when the next is emitted or speech ends: scheme 4."""
    told: list[SoundEvent] = []
    known: dict[int, Phone] = {}  # the newest revisions, by index
    middle_s = 0.0  # of the last phone told; what begins before is no new one
    for event, after in zip_longest(events, events[1:]):
        waiting = None
        if isinstance(event, Phone):
            known[event.index] = event
            if _is_emitted(event, after):
                waiting = known.get(event.index - 1)
        elif isinstance(event, SpeechChange) and not event.active and known:
            waiting = known[max(known)]
        if waiting is not None and waiting.onset_s >= middle_s and not waiting.is_withdrawn:
            told.append(waiting)
            middle_s = waiting.onset_s + 0.5 * waiting.duration_s
        if not isinstance(event, Phone):
            told.append(event)
    return told


def _is_emitted(phone: Phone, after: SoundEvent | None) -> bool:
    return is_emitted(phone, after if isinstance(after, Phone) else None)
