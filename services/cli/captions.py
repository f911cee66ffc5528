"""Writes the syllables of a recording, and makes the captions of its video."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

from kouxing.services.cli.options import CaptionKind
from kouxing.services.driver.render.captions import Caption, CaptionDrawer
from kouxing.services.recognizer.alignment import find_syllable_times
from kouxing.shared.errors import UserError
from kouxing.shared.fast_record import replace
from kouxing.shared.fonts import NO_CHINESE_FONT, can_draw
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory
from kouxing.shared.phones.syllable_captions import group_syllables
from kouxing.shared.phones.transcript import TimedSyllable, Transcript

if TYPE_CHECKING:
    from kouxing.services.cli.animation import FaceMotion


def write_syllables(
    phones: Sequence[Phone], transcript: Transcript | None, inventory: PhoneInventory
) -> list[TimedSyllable]:
    """Return the syllables of the text, with tones, or of recognized phones, without tones.

    The text of a syllable is its character, or else its spelling.
    """
    if transcript is None:
        return [_join_phones(group, inventory) for group in group_syllables(phones, inventory)]
    syllables = []
    for timed in find_syllable_times(phones, transcript, inventory):
        spelling = inventory.write(timed.spelling)
        text = timed.text if inventory.readable.search(timed.text) else spelling
        syllables.append(replace(timed, text=text, spelling=spelling))
    return syllables


def _join_phones(group: Sequence[Phone], inventory: PhoneInventory) -> TimedSyllable:
    spelling = inventory.spell(tuple(phone.symbol for phone in group))
    onset_s, end_s = group[0].onset_s, group[-1].onset_s + group[-1].duration_s
    return TimedSyllable(spelling, spelling, onset_s, end_s - onset_s)


def make_captions(
    kind: CaptionKind | None, motion: FaceMotion, size_px: tuple[int, int]
) -> CaptionDrawer | None:
    """Return the captions of a video of this size, if any.

    Raises ``UserError`` if characters are required, but there is no text with characters, or no
    font has them.
    """
    if kind is None:
        return None
    captions: list[Caption] = []
    if kind is CaptionKind.PHONES:
        captions = _phone_captions(motion.phones or [], load_inventory(motion.language))
    else:
        is_text = kind is CaptionKind.CHARACTERS
        if is_text and all(syllable.text == syllable.spelling for syllable in motion.syllables):
            raise UserError("--captions characters needs a text in characters; this one is pinyin")
        captions = [
            Caption(
                syllable.onset_s,
                syllable.onset_s + syllable.duration_s,
                syllable.text if is_text else syllable.spelling,
            )
            for syllable in motion.syllables
        ]
    if not can_draw("".join(caption.text for caption in captions)):
        raise UserError(f"--captions characters: {NO_CHINESE_FONT}, or use --captions pinyin")
    return CaptionDrawer(captions, size_px)


def _phone_captions(phones: Sequence[Phone], inventory: PhoneInventory) -> list[Caption]:
    joined = {
        phone.index
        for before, phone in pairwise(phones)
        if before.symbol in inventory.initials and phone.symbol in inventory.vowels
    }
    return [
        Caption(
            phone.onset_s,
            phone.onset_s + phone.duration_s,
            inventory.write(phone.symbol),
            is_joined=phone.index in joined,
        )
        for phone in phones
    ]
