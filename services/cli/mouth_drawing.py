"""The 2-D mouth of a sound: videos, pictures of the key frames, and tables of the contour.

What Zhang et al. 2021 do: text and its timing give key frames of the opening R, these R(t), and
that the contour.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from kouxing.services.cli.options import Timing
from kouxing.services.cli.sound_file import read_mono_16k
from kouxing.services.cli.spoken_text import does_not_fit, read_text
from kouxing.services.driver.video.writer import VideoWriter, write_picture
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.alignment import align_syllables, spoken, timed_syllables
from kouxing.services.recognizer.front_end.pcm import progress_of
from kouxing.services.recognizer.offline import recognize
from kouxing.services.recognizer.transcriber import SherpaTranscriber
from kouxing.services.synthesizer.lips.ferguson import drawing
from kouxing.services.synthesizer.lips.ferguson.contour import LINES, contour
from kouxing.services.synthesizer.lips.ferguson.motion import KeyFrames
from kouxing.services.synthesizer.lips.ferguson.openings import anchors_of, key_frames_of
from kouxing.services.synthesizer.lips.ferguson.table import load_table
from kouxing.services.synthesizer.lips.ferguson.timing import time_text
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, load_inventory
from kouxing.shared.phones.transcript import TimedSyllable, Transcript
from kouxing.shared.terminal import CONSOLE, check_output, print_message, write_text

Span = tuple[float, float, str]  # from, to (seconds): what is said

FRAME_RATE_HZ = 25.0
SUFFIXES = (".svg", ".png", ".mp4", ".csv")
CSV_COLUMNS = ("time_s", "opening", "line", "point", "x", "y")
_VIDEO_SIZE_PX = (640, 480)
_MOUTHS_A_ROW, _MOUTH_PX = 8, 150.0
_MAX_MOUTHS = 400  # of one picture
_BLOCK = 250  # frames whose contours are computed at once


def draw_mouth(
    source: Path,
    text: str | None,
    output: Path,
    *,
    timing: Timing | None = None,
    smooth: bool = False,
    num_points: int = 21,
    speech_to_text: Path | None = None,
) -> None:
    """Write the mouth of a sound; the suffix of ``output`` tells how.

    Parameters
    ----------
    source
        A sound file.
    text
        What is said; None: the phones are recognised.
    output
        ``.svg`` or ``.png``: the mouths at the key frames; ``.mp4``: a video with sound; ``.csv``:
        the contour of every frame.
    timing
        For a text; None: by endpoints.
    smooth
        Whether the opening has a continuous velocity between key frames.
    num_points
        Of each line, in a ``.csv``.
    speech_to_text
        Folder of a model that tells what is said, instead of ``text``.

    Raises
    ------
    UserError
        If a file cannot be read or written, or the options do not fit each other.
    """
    kind = output.suffix.lower()
    if kind not in SUFFIXES:
        raise UserError(f"{output}: give a name that ends in {', '.join(SUFFIXES)}")
    if text is not None and speech_to_text is not None:
        raise UserError("give a text or --speech-to-text, not both")
    if text is None and speech_to_text is None and timing is not None:
        raise UserError("--timing is for a text; give what is said, before the output's name")
    check_output(output)
    samples = read_mono_16k(source)
    inventory = load_inventory()
    if speech_to_text is not None:
        text = _recognised_text(source, samples, speech_to_text)
    transcript = None if text is None else read_text(text, inventory)
    with CONSOLE.status(f"timing {len(samples) / MEDIA_RATE_HZ:.0f} s"):
        phones = spoken(
            _timed_phones(source, samples, transcript, timing or Timing.ENDPOINTS), inventory
        )
    if not phones:
        print_message(f"{source}: no speech was found; the mouth stays closed")
    motion = key_frames_of(phones, load_table(inventory), inventory.silence)
    if kind == ".csv":
        num_frames = _write_csv(output, motion, len(samples), num_points, smooth=smooth)
        print_message(f"wrote {output}: {num_frames} frames")
        return
    syllables = (
        timed_syllables(phones, transcript, inventory)
        if transcript is not None
        else _recognised_syllables(phones, inventory)
    )
    labels = _labels(syllables, are_pixels=kind != ".svg")
    if kind == ".mp4":
        num_frames = _write_video(output, motion, phones, labels, samples, smooth=smooth)
        print_message(f"wrote {output}: {num_frames} images, {len(phones)} phones")
    else:
        moments = key_moments(motion, phones, labels, inventory.silence)
        if len(moments) > _MAX_MOUTHS:
            raise UserError(
                f"{source} needs {len(moments)} mouths, one picture holds {_MAX_MOUTHS}; cut it,"
                " or write .mp4 or .csv"
            )
        picture = drawing.strip(moments, _MOUTHS_A_ROW, _MOUTH_PX)
        if kind == ".svg":
            write_text(output, drawing.svg(picture))
        else:
            write_picture(output, drawing.rasterize(picture))
        print_message(f"wrote {output}: {len(moments)} key frames, {len(phones)} phones")


def _recognised_text(source: Path, samples: NDArray[np.float32], model: Path) -> str | None:
    text = SherpaTranscriber(model).transcribe(samples)
    print_message(f"{source}: {text or 'no words were recognised'}")
    return text or None


def _timed_phones(
    source: Path, samples: NDArray[np.float32], transcript: Transcript | None, timing: Timing
) -> list[Phone]:
    """Return the phones of a sound, 16 kHz mono, shape (n,); recognise them without a text."""
    if transcript is not None and timing is Timing.ENDPOINTS:
        return time_text(progress_of(samples), transcript.phones, load_table(load_inventory()))
    model = load_live_model()
    if transcript is None:
        return recognize(model, samples, MEDIA_RATE_HZ)
    alignment = align_syllables(model, samples, MEDIA_RATE_HZ, transcript.phones)
    if not alignment.fits:
        print_message(does_not_fit(source, alignment))
    return alignment.phones


def key_moments(
    motion: KeyFrames, phones: Sequence[Phone], labels: Sequence[Span], silence: str
) -> list[drawing.Moment]:
    """Return the key frames of phones; closed mouths before and after speech have no phone."""
    syllables = {onset_s: label for onset_s, _, label in labels}
    anchors = anchors_of(phones, silence) or [(0.0, silence)]
    return [
        drawing.Moment(
            time_s,
            float(opening),
            "" if phone == silence else phone,
            syllables.get(time_s, ""),
        )
        for (time_s, phone), opening in zip(anchors, motion.openings, strict=True)
        if time_s >= 0.0
    ]


def syllables_of(phones: Sequence[Phone], inventory: PhoneInventory) -> list[list[Phone]]:
    """Group phones, in order and without pauses, by their syllables."""
    syllables: list[list[Phone]] = []
    for phone in phones:
        follows_initial = syllables and syllables[-1][-1].symbol in inventory.initials
        if follows_initial and phone.symbol in inventory.vowels:
            syllables[-1].append(phone)
        else:
            syllables.append([phone])
    return syllables


def _recognised_syllables(
    phones: Sequence[Phone], inventory: PhoneInventory
) -> list[TimedSyllable]:
    """Return the syllables of recognised phones, which have no tones."""
    timed = []
    for syllable in syllables_of(phones, inventory):
        spelling = inventory.spell(tuple(phone.symbol for phone in syllable))
        end_s = syllable[-1].onset_s + syllable[-1].duration_s
        onset_s = syllable[0].onset_s
        timed.append(TimedSyllable(spelling, spelling, onset_s, end_s - onset_s))
    return timed


def _labels(syllables: Sequence[TimedSyllable], *, are_pixels: bool) -> list[Span]:
    """Return onset, end and label of each syllable: what is written, and its spelling.

    A picture of pixels needs a font for characters; without one, the spelling stands alone.
    """
    texts = [one.text for one in syllables if one.text != one.spelling]
    shows_text = not are_pixels or drawing.can_draw("".join(texts))
    if not shows_text:
        print_message(
            "labels are pinyin alone: no font with Chinese characters was found (Debian: "
            "fonts-noto-cjk)"
        )
    return [
        (
            one.onset_s,
            one.onset_s + one.duration_s,
            f"{one.text} {one.spelling}"
            if shows_text and one.text != one.spelling
            else one.spelling,
        )
        for one in syllables
    ]


def _write_video(
    output: Path,
    motion: KeyFrames,
    phones: Sequence[Phone],
    labels: Sequence[Span],
    samples: NDArray[np.float32],
    *,
    smooth: bool,
) -> int:
    symbols = [(phone.onset_s, phone.onset_s + phone.duration_s, phone.symbol) for phone in phones]
    times_s = _frame_times(len(samples))
    openings = motion.openings_at(times_s, smooth=smooth)
    with (
        VideoWriter(output, *_VIDEO_SIZE_PX, FRAME_RATE_HZ, MEDIA_RATE_HZ) as writer,
        Progress(console=CONSOLE, transient=True, disable=not CONSOLE.is_interactive) as progress,
    ):
        writer.write_sound(samples)
        for time_s, opening in progress.track(
            list(zip(times_s.tolist(), openings.tolist(), strict=True)), description="drawing"
        ):
            moment = drawing.Moment(
                time_s, opening, _spoken_at(time_s, symbols), _spoken_at(time_s, labels)
            )
            writer.write_image(drawing.rasterize(drawing.image(moment, *_VIDEO_SIZE_PX)))
    return len(times_s)


def _spoken_at(time_s: float, spans: Sequence[Span]) -> str:
    return next((text for start_s, end_s, text in spans if start_s <= time_s < end_s), "")


def _write_csv(
    output: Path, motion: KeyFrames, num_samples: int, num_points: int, *, smooth: bool
) -> int:
    times_s = _frame_times(num_samples)
    try:
        with output.open("w", encoding="utf-8") as file:
            file.write(",".join(CSV_COLUMNS) + "\n")
            for first in range(0, len(times_s), _BLOCK):
                block_s = times_s[first : first + _BLOCK]
                openings = motion.openings_at(block_s, smooth=smooth)
                file.writelines(_csv_rows(block_s, openings, num_points))
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}") from None
    return len(times_s)


def _csv_rows(
    times_s: NDArray[np.float64], openings: NDArray[np.float64], num_points: int
) -> Iterator[str]:
    for time_s, opening, lines in zip(
        times_s, openings, contour(openings, num_points), strict=True
    ):
        for name, line in zip(LINES, lines, strict=True):
            for number, (x, y) in enumerate(line):
                yield f"{time_s:.3f},{opening:.4f},{name},{number},{x:.5f},{y:.5f}\n"


def _frame_times(num_samples: int) -> NDArray[np.float64]:
    return np.arange(int(num_samples / MEDIA_RATE_HZ * FRAME_RATE_HZ) + 1) / FRAME_RATE_HZ
