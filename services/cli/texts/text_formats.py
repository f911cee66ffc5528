"""Extracts the spoken text from subtitles, markup and other files that contain more.

A format is recognized by its content, because a text may have no file name. Times and tags
are left out. A format whose text cannot be extracted is rejected by its name.

pysubs2 1.9 is not used. Of the subtitles in ``tests/unit/test_text_formats.py``, it rejects those
without hours and MicroDVD without a frame rate, and keeps entities and times within a line.
"""

import codecs
import contextlib
import html
import re
from collections.abc import Callable
from itertools import groupby, pairwise
from typing import NamedTuple

from kouxing.services.cli.texts.text_columns import remove_columns
from kouxing.shared.audio.audio_formats import audio_file_kind
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import parse_json

_BINARY_SIGNATURES = {  # by their first bytes; see also `audio_file_kind`
    b"%PDF": "a PDF document",
    b"{\\rtf": "an RTF document",
    b"PK\x03\x04": "a Word, OpenDocument, EPUB or zip file",
    b"\xd0\xcf\x11\xe0": "a Word or Office document",
    b"\x1f\x8b": "a gzip file",
    b"\x89PNG": "a picture",
    b"\xff\xd8\xff": "a picture",
}
_UNSUPPORTED_TEXTS = {  # text files without an extractor, by their first characters
    "Scenarist_SCC": "SCC captions",
    "#!MLF!#": "an HTK label file",
    "@UTF8": "a CHAT transcript",
    "@Begin": "a CHAT transcript",
    "\\documentclass": "a LaTeX document",
    "\\version": "a LilyPond file",
}
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_MIN_COMMON = 0.8  # fraction of common characters in a text that was decoded correctly

_TIME = r"(?:\d{1,3}[:：])?\d{1,2}[:：]\d{2}(?:[.,:]\d{1,3})?"
_LRC_TIME = r"\[(\d{1,3}):(\d{1,2}(?:[.:]\d{1,3})?)\]"
_FRAMES = r"(?:\{\d+\}\{\d*\}|\[\d+\]\[\d*\])"
_LABEL = (  # times of Audacity or CTM, or the name of a recording
    r"(?:\d+(?:\.\d+)?\t\d+(?:\.\d+)?\t|(?:\S+ \d )?\d+\.\d+ +\d+\.\d+ +"
    r"|[A-Za-z]+(?:[\w.-]*?\d){6}[\w.-]*[ \t]+)"
)
_TIMES = rf"{_TIME}(?:[ \t]*(?:--?>|[-–—~～→])[ \t]*{_TIME})?"
_SECONDS = r"\d+(?:\.\d+[ \t]*s?|[ \t]*s)"
_LINE_IN_SECONDS = (  # [0.00s -> 3.40s], as faster-whisper prints
    rf"[(\[]?{_SECONDS}[ \t]*(?:--?>|→)[ \t]*{_SECONDS}[)\]]?"
    rf"|[(\[]{_SECONDS}[ \t]*[-–—~][ \t]*{_SECONDS}[)\]]"
)
_TIME_IN_BRACKETS = rf"[(\[{{<（［【〔「]{_TIMES}[)\]}}>）］】〕」]"
_EXACT_TIME = r"0?0[:：]\d{2}(?:[:：]\d{2}(?:[.,:]\d{1,3})?|[.,]\d{1,3})"
_FIRST_TIME = rf"0?0[:：]\d{{2}}(?:[ \t]*[-–—~～→][ \t]*{_TIME})?"  # of a recording, not a clock
_TIMED_LINE = (  # also the line of a speaker, with the time at its end
    rf"(?:(?:{_TIME_IN_BRACKETS})+|{_TIMES}(?=[ \t]|$)|\S.{{,30}}?[ \t]+{_TIMES}[ \t]*$)[ \t]*"
)
_SPEAKER = (  # number of a speaker, such as SPEAKER_00: or 说话人 1：
    rf"[ \t]*(?:[A-Za-z]+[ _]?|(?:说话人|說話人|发言人|發言人)[ ]?)\d+(?:[ \t]+{_TIME})?[ \t]*[:：]"
)
_LYRICS_TIME = r"\[\d+,\d+\]"

_CUE_TIMES = re.compile(rf"^[ \t]*{_TIME}[ \t]*-->[ \t]*{_TIME}", re.MULTILINE)
_SBV_TIMES = re.compile(r"^\d+:\d{2}:\d{2}\.\d{3},\d+:\d{2}:\d{2}\.\d{3}[ \t]*$", re.MULTILINE)
_LRC_FIELD = re.compile(r"\[[A-Za-z#]+:[^\]]*\]")
_LEFT_TIME = re.compile(r"-->|\d{1,2}:\d{2}:\d{2}[.,]\d{2,3}")
_COMMAND = re.compile(  # [laughter], [pause:500], [S1], <#0.5#>, <|zh|>, and prosody: #1 to #4
    r"\[/?[A-Za-z_]\w*(?:[ :=]+[\w.]+)?\]|<#[\d.]+#>|<\|[^|<>]*\|>|(?<=[^\0-\x7f])#[1-4](?!\d)"
)
_BRACES = re.compile(r"\{[^{}]*\}")
_CUE_NUMBER = re.compile(rf"^\d+[ \t]*\n\s*(?={_TIME}[ \t]*-->)", re.MULTILINE)
_SOUND_NAME = re.compile(r"\[[^][\n]*\]|【[^【】\n]*】|[♪♫]")
_INLINE_TIME = re.compile(r"<\d{1,3}:[\d:.]+>")
_TAG = re.compile(
    r"</?[A-Za-z][\w:.-]*(?:\s[^<>]*)?/?>|<!--|&(?:[A-Za-z]{2,8}|#\d+|#x[0-9A-Fa-f]+);"
)
_MARKUP = re.compile(  # matches in linear time
    r"<(?P<end>/?)(?P<tag>[A-Za-z][\w:.-]*)(?P<rest>[^<>]*)>|<[!?/][^<>]*>"
    r"|(?P<data><?[^<]+|<)"
)
_ALIAS = re.compile(r"""\balias\s*=\s*(["'])(.*?)\1""", re.DOTALL)
_STRING = re.compile(r'"((?:[^"]|"")*)"')
_CHINESE = re.compile("[〇\u3400-\u9fff]")

_UNSPOKEN_ELEMENTS = {
    *("script", "style", "title", "template", "rt", "rp"),
    *("metadata", "desc", "copyright", "lexicon", "styling", "layout"),
}
_LINE_ELEMENTS = {"br", "div", "h1", "h2", "h3", "h4", "li", "p", "s", "td", "text", "tr"}
_MAX_OPEN = 100  # nested elements; each end tag searches all of them
_UNSPOKEN_LABELS = {"sil", "sp", "spn", "pau", "silence", "<sil>", "<eps>", "#"}


class SpokenText(NamedTuple):
    """The spoken part of a text."""

    text: str
    format_name: str = ""  # format that the rest of the text has; empty: plain text


def decode_text(content: bytes) -> SpokenText:
    """Decode a text file. ``format_name`` is its encoding, unless it is UTF-8.

    charset-normalizer 3.5 is not used. Of 165 short Chinese sentences in GB 18030, it decodes 89
    correctly, and this function all.

    Raises ``UserError`` if the file is not a text; the message names its format.
    """
    signatures = _BINARY_SIGNATURES.items()
    name = next((name for begin, name in signatures if content.startswith(begin)), "")
    if b"\0" in content:  # a text may start with FORM, as AIFF files do
        name = name or audio_file_kind(content)
    if name:
        raise UserError(f"this is {name}; save the spoken text as a plain text file")
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS if content.startswith(mark)), "")
    if not encoding and b"\0" in content:
        encoding = "utf-16-be" if content[::2].count(0) > content[1::2].count(0) else "utf-16-le"
    texts: dict[str, str] = {}
    for name in [encoding] if encoding else ["utf-8", "gb18030", "big5"]:
        with contextlib.suppress(UnicodeDecodeError):
            texts[name] = content.decode(name)
    # bytes in Big5 are mostly valid in GB 18030 too, but give rare characters
    candidates = [
        name for name in texts if name != "gb18030" or _has_common_characters(texts[name])
    ]
    name = next(iter(candidates or texts), "")
    if not name or any(ord(letter) < 32 and not letter.isspace() for letter in texts[name]):
        raise UserError("this is not a text file; save the spoken text as plain text in UTF-8")
    return SpokenText(texts[name], "" if name.startswith("utf-8") else name.upper())


def _has_common_characters(text: str) -> bool:
    """Return whether most characters of a text are among the 7000 that GB 2312 has."""
    characters = [letter for letter in text if not letter.isascii()]
    common = sum(bool(letter.encode("gb2312", "ignore")) for letter in characters)
    return common >= _MIN_COMMON * len(characters)


def extract_text(text: str, *, is_markdown: bool = False) -> SpokenText:
    """Extract the spoken text from a text of any format.

    Raises ``UserError`` if the text has a format whose spoken text cannot be extracted; the message
    names it.
    """
    text = text.lstrip("\ufeff \t\r\n").replace("\r\n", "\n").replace("\r", "\n")
    for beginning, name in _UNSUPPORTED_TEXTS.items():
        if text.startswith(beginning):
            raise UserError(f"this is {name}; keep only the spoken text")
    for format_name, pattern, extract in _FORMATS:
        if (is_markdown and format_name == "Markdown") or pattern.search(text):
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
    if _LEFT_TIME.search(spoken):
        raise UserError("the text has times in an unknown format; keep only the spoken text")
    return SpokenText(spoken, format_name)


def _read_cues(text: str) -> str:
    """Extract the text from SubRip or WebVTT, without the names of sounds, such as [掌声]."""
    cues: list[list[str]] = [[]]
    for block in re.split(r"\n[ \t]*\n", _CUE_NUMBER.sub("", text)):
        lines = block.strip("\n").split("\n")
        if re.match(r"WEBVTT|NOTE\b|STYLE$|REGION$", lines[0]):
            continue
        for number, line in enumerate(lines):
            times = _CUE_TIMES.match(line)
            if times is None:
                cues[-1].append(_SOUND_NAME.sub("", _BRACES.sub("", line)))
                continue
            if number == 1 or (number and lines[number - 1].strip().isdigit()):
                cues[-1].pop()  # the name of the cue
            rest = line[times.end() :]  # settings, or the text itself
            cues.append([rest] if _CHINESE.search(rest) else [])
    return "\n".join(_remove_repeats([_read_markup("\n".join(cue)).split("\n") for cue in cues]))


def _remove_repeats(cues: list[list[str]]) -> list[str]:
    """Return the lines of cues. In rolling captions, a cue repeats the last line of the one before.

    A cue of a single line may really be spoken twice. It is a repeat only if other cues roll.
    """
    cues = [lines for cue in cues if (lines := [line.strip() for line in cue if line.strip()])]
    is_rolling = any(len(cue) > 1 and cue[0] == last[-1] for last, cue in pairwise(cues))
    lines = [line for cue in cues for line in cue]
    return [line for line, _ in groupby(lines)] if is_rolling else lines


def _read_sbv(text: str) -> str:
    return _SBV_TIMES.sub("", text).replace("[br]", "\n")


def _read_lrc(text: str) -> str:
    """Extract the lines in the order of their times. A line with several times is repeated."""
    timed: list[tuple[float, str]] = []
    for line in text.split("\n"):
        if _LRC_FIELD.fullmatch(line.strip()):
            continue
        first = re.match(rf"[ \t]*(?:{_LRC_TIME}[ \t]*)*", line)
        times_s = [
            60 * int(minutes) + float(seconds.replace(":", "."))
            for minutes, seconds in re.findall(_LRC_TIME, first[0] if first else "")
        ]
        words = _INLINE_TIME.sub("", re.sub(_LRC_TIME, "", line))
        timed += [(time_s, words) for time_s in times_s or [timed[-1][0] if timed else 0.0]]
    return "\n".join(words for _, words in sorted(timed, key=lambda item: item[0]))


def _read_frame_numbers(text: str) -> str:
    words = re.sub(rf"^{_FRAMES}", "", text, flags=re.MULTILINE)
    return _BRACES.sub("", words).replace("|", "\n")


def _read_events(text: str) -> str:
    """Extract the dialogue from ASS or SSA, in the order of its times."""
    fields = ["layer", "start", "end", "style", "name", "l", "r", "v", "effect", "text"]
    events = []
    for line in text.split("\n"):
        kind, _, rest = line.partition(":")
        if kind.strip() == "Format" and "text" in rest.lower():
            fields = [name.strip().lower() for name in rest.split(",")]
        if kind.strip() == "Dialogue":
            values = dict(zip(fields, rest.strip().split(",", len(fields) - 1), strict=False))
            spoken = values.get("text", "")
            if not re.search(r"\{[^}]*\\p[1-9]", spoken):  # a drawing
                start = [float(part) for part in values.get("start", "0").split(":")]
                events.append((start, re.sub(r"\\[Nnh]", "\n", _BRACES.sub("", spoken))))
    return "\n".join(spoken for _, spoken in sorted(events, key=lambda event: event[0]))


def _read_labels(text: str) -> str:
    """Extract the labels of Audacity, Whisper, CTM or a list of recordings."""
    return "\n".join(re.findall(rf"^{_LABEL}(.*)", text, re.MULTILINE))


def _read_timed_lyrics(text: str) -> str:
    return re.sub(rf"{_LYRICS_TIME}|[(<]\d+(?:,\d+)+[)>]", "", text)


def _read_timed_lines(text: str) -> str:
    """Extract the lines without their times.

    If each of several timed lines is followed by an untimed line, they contain speakers' names.
    """
    lines = [(re.match(_TIMED_LINE, line), line) for line in text.split("\n")]
    are_names = sum(match is not None for match, _ in lines) > 1 and all(
        match is None or (following is None and next_line.strip())
        for (match, _), (following, next_line) in pairwise([*lines, (None, "")])
    )
    return "\n".join(
        line if match is None else "" if are_names else line[match.end() :] for match, line in lines
    )


def _read_speakers(text: str) -> str:
    return re.sub(rf"^{_SPEAKER}", "", text, flags=re.MULTILINE)


def _read_lines_in_seconds(text: str) -> str:
    return re.sub(rf"^[ \t]*(?:{_LINE_IN_SECONDS})[:：]?", "", text, flags=re.MULTILINE)


def _read_text_grid(text: str) -> str:
    """Extract the labels of the first tier with Chinese characters, or of the only tier.

    The long and the short form have the same strings: two of the header, then the class, the name
    and the labels of each tier.
    """
    tiers: list[list[str]] = []
    for match in _STRING.finditer(text):
        string = match[1].replace('""', '"').strip()
        if string in ("IntervalTier", "TextTier"):
            tiers.append([])
        elif tiers:
            tiers[-1].append(string)
    chosen = [tier for tier in tiers if _CHINESE.search("".join(tier[1:]))] or tiers
    if len(chosen) > 1 and chosen is tiers:
        names = ", ".join(repr(tier[0]) for tier in tiers if tier)
        raise UserError(
            f"this TextGrid has the tiers {names}, none with Chinese characters; keep only"
            " the spoken text"
        )
    labels = chosen[0][1:] if chosen else []
    return "\n".join(label for label in labels if label.lower() not in _UNSPOKEN_LABELS)


def _read_commands(text: str) -> str:
    return remove_columns(_COMMAND.sub("", text))


def _read_json(text: str) -> str:
    return _find_json_text(parse_json(text))


def _find_json_text(value: object) -> str:
    """Extract the text of a transcript: of Whisper, of players, or of ``kouxing align``."""
    if isinstance(value, str):
        return value
    if isinstance(value, list) and value:
        return "\n".join(map(_find_json_text, value))
    if isinstance(value, dict):
        for name in ("text", "content", "segments", "body", "syllables"):
            if name in value:
                return _find_json_text(value[name])
    raise UserError("this is JSON without the text of a transcript; keep only the spoken text")


def _read_markdown(text: str) -> str:
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)  # metadata
    text = re.sub(r"^(```|~~~).*?^\1[^\n]*$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"!\[[^][]*\]\([^()]*\)", "", text)  # pictures
    text = re.sub(r"\[([^][]*)\](?:\([^()]*\)|\[[^][]*\])", r"\1", text)  # links
    lines = (line for line in text.split("\n") if "-" not in line or line.strip(" \t:|-"))
    text = "\n".join(lines)  # without rules
    text = re.sub(r"^[ \t]*(?:#{1,6}|>+|[-*+]|\d+[.)])[ \t]+", "", text, flags=re.MULTILINE)
    return _read_markup(re.sub(r"[*`|]|~~", "", text))


def _read_markup(text: str) -> str:
    """Extract the text from SSML, TTML, HTML and subtitles with tags.

    ``html.parser`` is not used, because it needs quadratic time for a damaged text. Entities that
    a document defines are not expanded, so they cannot exhaust memory.
    """
    first, *others = _INLINE_TIME.sub("", text).split("<!--")
    text = first + "".join(comment.partition("-->")[2] for comment in others)
    first, *others = text.split("<![CDATA[")
    sections = (other.partition("]]>") for other in others)
    text = first + "".join(html.escape(plain) + rest for plain, _, rest in sections)
    spoken: list[str] = []
    unspoken: list[str] = []  # open elements whose text is not spoken
    for match in _MARKUP.finditer(text):
        if match["tag"]:
            _handle_tag(match, spoken, unspoken)
        elif not unspoken:
            spoken.append(html.unescape(match["data"] or ""))
    return "".join(spoken)


def _handle_tag(tag: re.Match[str], spoken: list[str], unspoken: list[str]) -> None:
    name = tag["tag"].lower().rpartition(":")[2]
    if tag["end"]:
        if name in unspoken:
            del unspoken[unspoken.index(name) :]
        return
    if name in _LINE_ELEMENTS:
        spoken.append("\n")
    alias = _ALIAS.search(tag["rest"]) if name == "sub" else None
    if alias and not unspoken:
        spoken.append(html.unescape(alias[2]))
    is_open = not tag["rest"].endswith("/") and len(unspoken) < _MAX_OPEN
    if is_open and (name in _UNSPOKEN_ELEMENTS or alias):
        unspoken.append(name)


def _reject_xml(text: str) -> str:
    root = re.search(r"<([A-Za-z][\w:.-]*)", text)
    name = f" with the root element {root[1]!r}" if root else ""
    raise UserError(f"this is XML{name}; keep only the spoken text")


_FORMATS: tuple[tuple[str, re.Pattern[str], Callable[[str], str]], ...] = (
    ("WebVTT", re.compile(r"\AWEBVTT"), _read_cues),
    ("TextGrid", re.compile(r'\AFile type = "ooTextFile'), _read_text_grid),
    ("ASS or SSA", re.compile(r"\A\[(Script Info|V4\+? Styles|Events)\]", re.I), _read_events),
    ("JSON", re.compile(r'\A(\{\s*"|\[\s*[{"])'), _read_json),
    ("SubRip (SRT)", _CUE_TIMES, _read_cues),
    ("lyrics with times", re.compile(rf"^{_LYRICS_TIME}", re.MULTILINE), _read_timed_lyrics),
    ("SBV", _SBV_TIMES, _read_sbv),
    ("LRC", re.compile(rf"^[ \t]*{_LRC_TIME}", re.MULTILINE), _read_lrc),
    (
        "a transcript with times",
        re.compile(rf"^[ \t]*(?:{_LINE_IN_SECONDS})", re.MULTILINE),
        _read_lines_in_seconds,
    ),
    (
        "a transcript with times",
        re.compile(rf"^[ \t]*(?:{_TIME_IN_BRACKETS}|{_EXACT_TIME}(?=[ \t]))", re.MULTILINE),
        _read_timed_lines,
    ),
    ("a transcript with times", re.compile(rf"\A{_FIRST_TIME}[ \t]"), _read_timed_lines),
    ("a transcript with speakers", re.compile(rf"^{_SPEAKER}", re.MULTILINE), _read_speakers),
    ("MicroDVD or MPL2", re.compile(rf"\A{_FRAMES}"), _read_frame_numbers),
    ("a table of labels", re.compile(rf"\A([^\n]*\n)?{_LABEL}"), _read_labels),
    ("SSML", re.compile(r"<speak\b", re.I), _read_markup),
    ("TTML", re.compile(r"<(\w+:)?tt\b", re.I), _read_markup),
    ("SAMI", re.compile(r"<sami\b", re.I), _read_markup),
    ("a transcript in XML", re.compile(r"<(transcript|timedtext)\b", re.I), _read_markup),
    ("HTML", re.compile(r"<(!DOCTYPE html|html|body)\b", re.I), _read_markup),
    ("XML", re.compile(r"\A<\?xml"), _reject_xml),
    ("Markdown", re.compile(r"^#{1,6} |^```|\]\([^)\s]+\)", re.MULTILINE), _read_markdown),
    ("text with tags", _TAG, _read_markup),
    ("text with commands of a synthesizer", _COMMAND, _read_commands),
    (
        "a transcript with times",
        re.compile(
            rf"\A(?=(?:.{{,30}}[ \t])?[(\[【]?0?0:){_TIMED_LINE}.*\n(.*\n){{,3}}?{_TIMED_LINE}",
            re.MULTILINE,
        ),
        _read_timed_lines,
    ),
)
