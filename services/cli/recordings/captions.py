"""Writes the syllables of a recording, and makes the captions of its video."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from kouxing.services.cli.options import CaptionKind
from kouxing.services.driver.render.captions import Caption, CaptionDrawer
from kouxing.services.recognizer.offline.alignment import find_syllable_times
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.fonts import NO_CHINESE_FONT, can_draw
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory
from kouxing.shared.phones.syllable_captions import group_syllables
from kouxing.shared.phones.transcript import SpokenSyllable, TimedSyllable, Transcript

if TYPE_CHECKING:
    from kouxing.services.cli.recordings.animation import FaceMotion


def spell_syllables(
    phones: Sequence[Phone], transcript: Transcript | None, inventory: PhoneInventory
) -> list[TimedSyllable]:
    """Return the syllables of the text, with tones, or of recognized phones, without tones.

    The text of a syllable is its character, or its spelling if it has no character.
    """
    if transcript is None:
        return [_join_phones(group, inventory) for group in group_syllables(phones, inventory)]
    syllables = []
    for timed in find_syllable_times(phones, transcript, inventory):
        text, spelling = _write(timed, inventory)
        syllables.append(replace(timed, text=text, spelling=spelling))
    return syllables


def check_characters(transcript: Transcript, inventory: PhoneInventory) -> None:
    """Check that captions can show the characters of a text. Call this before long work.

    Raises ``UserError`` if the text has no characters, or no font has them.
    """
    written = [_write(syllable, inventory) for syllable in transcript.syllables]
    if all(text == spelling for text, spelling in written):
        raise UserError(
            "--captions characters needs a text in characters, and this one is pinyin; use"
            " --captions pinyin"
        )
    if not can_draw("".join(text for text, _ in written)):
        raise UserError(f"--captions characters: {NO_CHINESE_FONT}, or use --captions pinyin")


def _write(syllable: SpokenSyllable | TimedSyllable, inventory: PhoneInventory) -> tuple[str, str]:
    """Return the text of a syllable (its character, if it has one) and its spelling."""
    spelling = inventory.write(syllable.spelling)
    has_character = inventory.readable.search(syllable.text)
    return syllable.text if has_character else spelling, spelling


def _join_phones(group: Sequence[Phone], inventory: PhoneInventory) -> TimedSyllable:
    spelling = inventory.spell(tuple(phone.symbol for phone in group))
    onset_s = group[0].onset_s
    return TimedSyllable(spelling, spelling, onset_s, group[-1].end_s - onset_s)


def make_captions(
    kind: CaptionKind | None, motion: FaceMotion, size_px: tuple[int, int]
) -> CaptionDrawer | None:
    """Return the captions of a video of this size, if any."""
    if kind is None:
        return None
    captions: list[Caption] = []
    if kind is CaptionKind.PHONES:
        captions = _phone_captions(motion.phones or [], load_inventory(motion.language))
    else:
        is_text = kind is CaptionKind.CHARACTERS
        captions = [
            Caption(item.onset_s, item.end_s, item.text if is_text else item.spelling)
            for item in motion.syllables
        ]
    return CaptionDrawer(captions, size_px)


def _phone_captions(phones: Sequence[Phone], inventory: PhoneInventory) -> list[Caption]:
    return [
        Caption(phone.onset_s, phone.end_s, inventory.write(phone.symbol), is_joined=number > 0)
        for group in group_syllables(phones, inventory)
        for number, phone in enumerate(group)
    ]
