"""Recognizes the format of a text and extracts the spoken text.

A format is recognized by its content, because a text may have no file name. Times and tags
are left out. A format whose text cannot be extracted is rejected by its name.
"""

import re
from collections.abc import Callable

from kouxing.services.cli.texts import markup, subtitles, transcripts
from kouxing.services.cli.texts.text_columns import remove_columns
from kouxing.shared.errors import UserError

_UNSUPPORTED_TEXTS = {  # text files without an extractor, by their first characters
    "Scenarist_SCC": "SCC captions",
    "#!MLF!#": "an HTK label file",
    "@UTF8": "a CHAT transcript",
    "@Begin": "a CHAT transcript",
    "\\documentclass": "a LaTeX document",
    "\\version": "a LilyPond file",
}
_INVISIBLE = re.compile("[\u00ad\u200b\u2060\ufeff]")  # places where a word may break, or may not
_REMAINING_TIME = re.compile(r"-->|\d{1,2}:\d{2}:\d{2}[.,]\d{2,3}")


def extract_text(text: str, *, is_markdown: bool = False) -> tuple[str, str]:
    """Return the spoken part of a text, and the text's format; empty for plain text.

    Raises ``UserError`` if the text has a format whose spoken text cannot be extracted; the message
    names it.
    """
    text = _INVISIBLE.sub("", text).lstrip()
    text = re.sub(r"\r*\n|\r", "\n", text)  # some programs convert line ends twice
    for beginning, name in _UNSUPPORTED_TEXTS.items():
        if text.startswith(beginning):
            raise UserError(f"this is {name}; keep only the spoken text")
    for format_name, is_format, extract in _FORMATS:
        if (is_markdown and format_name == "Markdown") or is_format(text):
            try:
                spoken = extract(text)
            except ValueError:
                raise UserError(
                    f"this is not valid {format_name}; keep only the spoken text"
                ) from None
            break
    else:
        spoken = remove_columns(text)
        format_name = "" if spoken == text else "a table of times or names"
    if _REMAINING_TIME.search(spoken):
        raise UserError("the text has times in an unknown format; keep only the spoken text")
    return spoken, format_name


def _starts_with(pattern: str) -> Callable[[str], object]:
    return re.compile(pattern).match


def _has_tag(pattern: str) -> Callable[[str], object]:
    return re.compile(rf"<(?:{pattern})\b", re.IGNORECASE).search


def _has_line(pattern: str) -> Callable[[str], object]:
    return re.compile(rf"^(?:{pattern})", re.MULTILINE).search


# In order: the lines of a format may also look like those of a later one.
_FORMATS: tuple[tuple[str, Callable[[str], object], Callable[[str], str]], ...] = (
    ("WebVTT", _starts_with("WEBVTT"), subtitles.read_cues),
    ("TextGrid", _starts_with('File type = "ooTextFile'), transcripts.read_text_grid),
    (
        "ASS or SSA",
        _starts_with(r"(?i)\[(Script Info|V4\+? Styles|Events)\]"),
        subtitles.read_ass_dialogue,
    ),
    ("JSON", _starts_with(r'\{\s*"|\[\s*[{"]'), transcripts.read_json),
    ("SubRip (SRT)", subtitles.CUE_TIMES.search, subtitles.read_cues),
    ("lyrics with times", _has_line(subtitles.LYRICS_TIME), subtitles.read_timed_lyrics),
    ("SBV", subtitles.SBV_TIMES.search, subtitles.read_sbv),
    ("LRC", _has_line(rf"[ \t]*{subtitles.LRC_TIME}"), subtitles.read_lrc),
    ("a transcript with times", transcripts.has_times, transcripts.read_timed_lines),
    ("a transcript with speakers", _has_line(transcripts.SPEAKER), transcripts.read_speakers),
    (
        "MicroDVD or MPL2",
        _starts_with(subtitles.FRAME_NUMBERS),
        subtitles.read_frame_timed_subtitles,
    ),
    (
        "a table of labels",
        _starts_with(rf"([^\n]*\n)?{transcripts.LABEL}"),
        transcripts.read_labels,
    ),
    ("SSML", _has_tag("speak"), markup.read_markup),
    ("TTML", _has_tag(r"(\w+:)?tt"), markup.read_markup),
    ("SAMI", _has_tag("sami"), markup.read_markup),
    ("a transcript in XML", _has_tag("transcript|timedtext"), markup.read_escaped_markup),
    ("HTML", _has_tag("!DOCTYPE html|html|body"), markup.read_markup),
    ("XML", _starts_with(r"<\?xml"), markup.reject_xml),
    ("Markdown", markup.MARKDOWN.search, markup.read_markdown),
    ("text with tags", markup.TAG.search, markup.read_markup),
    ("text with commands of a synthesizer", markup.COMMAND.search, markup.read_commands),
)
