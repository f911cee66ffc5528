"""Captions: what they contain, where they are drawn, and slow motion."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.progress import Progress

from kouxing.services.cli.options import CaptionKind
from kouxing.services.cli.recordings.animation import FaceMotion, animate, slow_down
from kouxing.services.cli.recordings.captions import make_captions, spell_syllables
from kouxing.services.driver.render.captions import Caption, CaptionDrawer, band_height_px
from kouxing.services.driver.video.time_stretch import stretch_time
from kouxing.shared import fonts
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory
from tests import lips

MANDARIN = load_inventory()
SIZE = (320, 180)
YELLOW = (255, 210, 63)
PHONES = [
    lips.phone(number, symbol, 0.2 * number, 0.2)
    for number, symbol in enumerate(("l", "v", "sh", "iii", "g", "uei"))
]


def motion_of(text: str | None = None) -> FaceMotion:
    transcript = None if text is None else MANDARIN.read(text)
    syllables = spell_syllables(PHONES, transcript, MANDARIN)
    return FaceMotion([(0.0, np.zeros(68, np.float32))], 50.0, 25.0, None, PHONES, syllables)


@pytest.mark.parametrize(
    ("text", "texts", "spellings"),
    [
        (None, "lü shi gui", "lü shi gui"),
        ("绿是贵", "绿 是 贵", "lǜ shì guì"),
        ("lv4 shi4 gui4", "lǜ shì guì", "lǜ shì guì"),
    ],
)
def test_writes_syllables_as_printed(text: str | None, texts: str, spellings: str) -> None:
    syllables = motion_of(text).syllables
    assert [syllable.text for syllable in syllables] == texts.split()
    assert [syllable.spelling for syllable in syllables] == spellings.split()


def test_highlights_only_the_current_caption_below_the_picture() -> None:
    captions = make_captions(CaptionKind.PHONES, motion_of(), SIZE)
    assert captions is not None
    picture = np.full((SIZE[1] - captions.height_px, SIZE[0], 3), 7, np.uint8)
    places = []
    for time_s in (0.1, 1.1):
        drawn = captions.add_below(picture, time_s)
        assert drawn.shape == (SIZE[1], SIZE[0], 3)
        np.testing.assert_array_equal(drawn[: len(picture)], picture)
        places.append(np.nonzero((drawn == YELLOW).all(axis=2))[1])
    assert places[0].max() < places[1].min()
    assert not (captions.add_below(picture, 9.0) == YELLOW).all(axis=2).any()
    clear = captions.add_below(np.zeros((*picture.shape[:2], 4), np.uint8), 0.1)
    assert clear[-1, :, 3].max() == 0, "the band of a transparent picture is transparent"


def test_a_vowel_joins_its_initial() -> None:
    captions = make_captions(CaptionKind.PHONES, motion_of(), SIZE)
    assert captions is not None
    (line,) = captions._lines
    assert [caption.text for caption in line] == ["l", "ü", "sh", "i", "g", "ui"]
    assert [caption.is_joined for caption in line] == [False, True] * 3


def test_phones_of_other_languages_are_ipa() -> None:
    phones = [lips.phone(number, symbol, 0.2 * number, 0.2) for number, symbol in enumerate("vi")]
    motion = FaceMotion(motion_of().frames, 50.0, 25.0, None, phones, language="german")
    german = make_captions(CaptionKind.PHONES, motion, SIZE)
    assert german is not None
    assert [caption.text for line in german._lines for caption in line] == ["v", "i"]


def test_long_texts_and_pauses_start_a_new_line() -> None:
    words = [Caption(0.1 * number, 0.1 * number + 0.1, "zhuang") for number in range(40)]
    captions = CaptionDrawer([*words, Caption(9.0, 9.2, "a")], SIZE)
    picture = np.zeros((SIZE[1] - band_height_px(SIZE), SIZE[0], 3), np.uint8)
    bands = [captions.add_below(picture, time_s)[len(picture) :] for time_s in (0.0, 3.9, 9.3)]
    assert len({band.tobytes() for band in bands}) == 3
    margins = np.concatenate([band[:, :4] for band in bands])
    assert (margins == margins[0, 0]).all(), "the lines fit"


def test_checks_the_characters_and_their_font_before_the_sound_is_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    options: dict[str, Any] = {"live": False, "mouth": None, "expressiveness": None}
    options |= {"captions": CaptionKind.CHARACTERS, "language": DEFAULT_LANGUAGE}
    monkeypatch.setattr(fonts, "_chinese_font", lambda _size_px: None)
    for text, message in (
        ("lv4 shi4 gui4", "needs a text in characters"),
        ("绿是贵", "no font with Chinese characters was found; install one"),
    ):
        with Progress(disable=True) as progress, pytest.raises(UserError, match=message):
            animate(Path("no.wav"), ["learned"], progress, text=text, **options)


def test_slow_motion_keeps_the_pitch_and_moves_everything() -> None:
    slow = slow_down(motion_of(), 0.5)
    assert [phone.onset_s for phone in slow.phones or ()] == pytest.approx(np.arange(6) * 0.4)
    assert slow.syllables[1].onset_s == pytest.approx(0.8)
    times_s = np.arange(16_000) / 16_000
    tone = np.sin(2 * np.pi * 440 * times_s).astype(np.float32) * (times_s > 0.5)
    slow_tone = stretch_time(tone.astype(np.float32), 0.25)
    assert len(slow_tone) == 64_000
    loud = np.flatnonzero(np.abs(slow_tone) > 0.3)
    assert loud[0] / 16_000 == pytest.approx(2.0, abs=0.15)
    spectrum = np.abs(np.fft.rfft(slow_tone))
    assert spectrum.argmax() / 4 == pytest.approx(440, abs=2)
