"""Reads the sound files and the spoken texts of commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.alignment import MIN_FIT, Alignment
from kouxing.services.recognizer.front_end.resample import Resampler
from kouxing.shared.audio_file import clipping_remarks, num_clipped, open_audio
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.shared.phones.transcript import Transcript
from kouxing.shared.terminal import print_message

_MAX_BYTES = 1024 * 1024


def read_mono_16k(path: Path) -> NDArray[np.float32]:
    """Return a file's samples as the recognizer uses them: 16 kHz mono, shape ``(n,)``.

    Prints a message if the file is truncated or clipped. Raises ``UserError`` as
    ``kouxing.shared.audio_file.open_audio``.
    """
    source = open_audio(path, block_s=1.0)
    resampler = Resampler(source.sample_rate_hz, source.num_channels)
    parts = []
    num_samples = clipped = 0
    for block in source.blocks:
        parts.append(resampler.accept_waveform(block))
        num_samples += block.size
        clipped += num_clipped(block)
    for remark in (*source.remarks, *clipping_remarks(str(path), clipped / max(1, num_samples))):
        print_message(remark)
    return np.concatenate([*parts, resampler.finish()])


def read_text(text: str, inventory: PhoneInventory) -> Transcript:
    """Return the syllables of a text or of a text file. Prints a message about ignored words.

    Raises ``UserError`` if the file or the text cannot be read, or the text has no syllables.
    """
    transcript = inventory.read(text_of(text))
    if transcript.dropped:
        words = ", ".join(repr(word) for word in transcript.dropped)
        print_message(f"ignored in the text: {words}; write them as they are spoken, in characters")
    if not transcript.syllables:
        raise UserError("the text is empty; give the spoken words")
    return transcript


def does_not_fit(audio: Path, alignment: Alignment) -> str:
    """Return the message that a text does not fit a recording."""
    return (
        f"{audio}: the text does not fit the sound (fit {alignment.fit:.2f}, normally at least"
        f" {MIN_FIT}); check that the text is complete and is what was said"
    )


def text_of(text: str) -> str:
    """Return a text, or the content of the text file of that name.

    Raises ``UserError`` if the file cannot be read, or is too large.
    """
    try:
        path = Path(text)
        if not path.is_file():
            if path.suffix.lower() == ".txt":
                raise UserError(f"{path}: no such file")
            return text
    except (OSError, ValueError):  # too long for a file name
        return text
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise UserError(f"{path}: a text file must not be larger than 1 MiB")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as UTF-8 text: {error}") from None
