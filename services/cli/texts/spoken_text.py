"""Reads the spoken text of a command: an argument, or the content of a file."""

import os
import re
from pathlib import Path

from kouxing.services.cli.texts.text_encoding import decode_text
from kouxing.services.cli.texts.text_formats import extract_text
from kouxing.services.recognizer.offline.alignment import MIN_FIT, Alignment
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import read_file
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory
from kouxing.shared.phones.transcript import Transcript

MAX_TEXT_BYTES = 8 << 20
_MAX_CHARACTERS = 150_000
_MAX_DIGITS = 10_000  # converting numbers to words is slow
_MAX_NAMED = 20  # words in a message
_CLOCK_TIME = re.compile(r"\d{1,2}[:：]\d{2}(?=[ \t])")  # or the time of a recording
_LABEL = re.compile(  # a speaker, the number of a line, or a stage direction
    r"^[ \t]*(\w{1,12}(?: \w{1,12})?[:：](?!\d)|\d{1,3}[.、)](?!\d)"
    r"|[\[【（(][^\n]{1,12}?[\]】）)])",
    re.MULTILINE,
)
_TEXT_SUFFIXES = {
    *(".txt", ".text", ".md", ".markdown", ".html", ".htm", ".xml", ".ssml", ".json", ".textgrid"),
    *(".srt", ".vtt", ".lrc", ".ass", ".ssa", ".sbv", ".sub", ".ttml", ".dfxp", ".smi", ".tsv"),
    *(".pdf", ".rtf", ".doc", ".docx", ".odt", ".csv", ".xlsx"),
    *(".svg", ".png", ".mp4", ".mp3", ".wav", ".flac", ".m4a"),
}
_TABLE_SUFFIXES = {".csv", ".xlsx"}
_MARKDOWN_SUFFIXES = {".md", ".markdown"}


def read_transcript(text: str, inventory: PhoneInventory) -> Transcript:
    """Return the syllables of a text or of a text file.

    Prints a message about words that cannot be read, and about a format with more than the text.
    Raises ``UserError`` if the file or the text cannot be read, or the text has no syllables.
    """
    spoken = read_spoken_text(text, inventory.language)
    for kind, limit, number in (
        ("characters", _MAX_CHARACTERS, len(spoken)),
        ("digits", _MAX_DIGITS, sum(map(str.isdigit, spoken))),
    ):
        if number > limit:
            raise UserError(f"the spoken text has more than {limit} {kind}; split it")
    transcript = inventory.read(spoken)
    words = [repr(word) for word in dict.fromkeys(transcript.dropped)]
    named = ", ".join(words[:_MAX_NAMED])
    if len(words) > _MAX_NAMED:
        named += f" and {len(words) - _MAX_NAMED} more"
    advice = (
        "write them in characters or pinyin (for Mandarin, the default language); for other"
        " languages, add --language, such as --language en"
        if inventory.language == DEFAULT_LANGUAGE
        else "write them as they are spoken, or use another --language"
    )
    if not transcript.syllables:
        if words:
            raise UserError(f"no word of the text can be read: {named}; {advice}")
        raise UserError("the text is empty; write the spoken words")
    if words:
        print_message(f"words that cannot be read were ignored: {named}; {advice}")
    return transcript


def report_mismatch(audio: Path, alignment: Alignment) -> None:
    """Print a message if a text does not fit a recording."""
    if not alignment.fits:
        print_mismatch(audio, f"fit {alignment.fit:.2f}, normally at least {MIN_FIT}")


def print_mismatch(audio: Path, reason: str) -> None:
    """Report that a text does not fit a recording, and how to fix it."""
    print_message(
        f"{audio}: the text does not fit the audio ({reason}); check that the text is complete"
        " and matches what was said"
    )


def read_spoken_text(text: str, language: str = DEFAULT_LANGUAGE) -> str:
    """Extract the spoken text from a text in a language, or from the file that it names.

    Prints the format if it is not plain text. Raises ``UserError`` if the file cannot be read, or
    its format is not supported.
    """
    path, encoding = _find_file(text), ""
    if path is None:
        if re.search("[\ud800-\udfff]", text):  # it does not have the terminal's encoding
            text, encoding = decode_text(os.fsencode(text), language)
        spoken, format_name = extract_text(text)
    else:
        content = read_file(path, MAX_TEXT_BYTES)
        try:
            spoken, format_name, encoding = _extract_from(content, path.suffix.lower(), language)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
    formats = [name for name in (format_name, encoding) if name]
    if formats:
        name = "the text" if path is None else str(path)
        remedy = "; if its characters are wrong, save it in UTF-8" if encoding else ""
        print_message(f"{name} was read as {' in '.join(formats)}{remedy}")
    elif time := _CLOCK_TIME.match(spoken):
        print_message(f"{time[0]} is read as a spoken time of day; delete it if it is not spoken")
    if len(labels := _LABEL.findall(spoken)) > 1:
        print_message(
            f"{labels[0]!r} is read as spoken text; delete such labels if they are not spoken"
        )
    return spoken


def _find_file(text: str) -> Path | None:
    """Return the file that a text names; None if the text is not a file name."""
    try:
        path = Path(text)
        if path.suffix.lower() in _TEXT_SUFFIXES or (path.exists() and not path.is_dir()):
            return path
    except (OSError, ValueError):  # too long for a file name
        pass
    return None


def _extract_from(content: bytes, suffix: str, language: str) -> tuple[str, str, str]:
    """Return the spoken text of a file, its format and its encoding."""
    if suffix in _TABLE_SUFFIXES:
        raise UserError(f"this is a table ({suffix}); save the spoken text as a plain text file")
    text, encoding = decode_text(content, language)
    return *extract_text(text, is_markdown=suffix in _MARKDOWN_SUFFIXES), encoding
