"""The text of a recording as the commands read it."""

from __future__ import annotations

from pathlib import Path

from kouxing.services.recognizer.alignment import MIN_FIT, Alignment
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.shared.phones.transcript import Transcript
from kouxing.shared.terminal import print_message

_MAX_BYTES = 1024 * 1024


def read_text(text: str, inventory: PhoneInventory) -> Transcript:
    """Read a text, or the file of that name; tell the user what was dropped.

    Raises
    ------
    UserError
        If the file or the text cannot be read, or nothing is left of it.
    """
    transcript = inventory.read(text_of(text))
    if transcript.dropped:
        words = ", ".join(repr(word) for word in transcript.dropped)
        print_message(f"left out of the text: {words}; write in characters how they are spoken")
    if not transcript.syllables:
        raise UserError("the text is empty; give the words that are spoken")
    return transcript


def does_not_fit(audio: Path, alignment: Alignment) -> str:
    """Tell the user that a text does not fit a recording."""
    return (
        f"{audio}: the text does not fit the sound (fit {alignment.fit:.2f}, {MIN_FIT} or more is"
        " usual); is it what was said, all of it?"
    )


def text_of(text: str) -> str:
    """Return a text, or what the file of that name holds.

    Raises
    ------
    UserError
        If the file cannot be read, or is too large.
    """
    try:
        path = Path(text)
        if not path.is_file():
            if path.suffix.lower() == ".txt":
                raise UserError(f"{path}: there is no such file")
            return text
    except (OSError, ValueError):  # too long for a name
        return text
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise UserError(f"{path}: this is no text of a recording; it is larger than 1 MiB")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: cannot be read as a text in UTF-8: {error}") from None
