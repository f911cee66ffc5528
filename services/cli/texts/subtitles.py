"""Extracts the spoken text from subtitles, without times, styles and names of sounds.

pysubs2 1.8 is not used. Of the subtitles in ``tests/unit/test_text_formats.py``, it rejects LRC,
those without hours, and MicroDVD without a frame rate. It ignores the order of columns in ASS. It
also needs quadratic time for unclosed braces: 3.6 s for 40 kB. srt 3.5 and webvtt-py 0.6 read only
one of the formats.
"""

import re
from itertools import groupby, pairwise

from kouxing.services.cli.texts.markup import TIME_TAG, read_markup
from kouxing.shared.errors import UserError

CLOCK = r"(?:\d{1,3}[:：])?\d{1,2}[:：]\d{2}(?:[.,:]\d{1,3})?"  # 0:05, 00:00:05.200
_CUE = rf"[ \t]*{CLOCK}[ \t]*-->[ \t]*{CLOCK}"
_SETTINGS = r"(?:[ \t]+(?:vertical|line|position|size|align|region|[XY][12]):\S+)*"
CUE_TIMES = re.compile(rf"^{_CUE}{_SETTINGS}", re.MULTILINE)
_CUE_NUMBER = re.compile(  # directly above the times, or in a paragraph of its own
    rf"(?:^[ \t]*\d+[ \t]*\n|(?:\A|(?<=\n\n))[ \t]*\d+\s*\n)(?={_CUE})", re.MULTILINE
)
_SOUND_NAME = re.compile(r"\[[^][\n]*\]|【[^【】\n]*】|[♪♫]")
_BRACES = re.compile(r"\{[^{}]*\}")
SBV_TIMES = re.compile(r"^\d+:\d{2}:\d{2}\.\d{3},\d+:\d{2}:\d{2}\.\d{3}[ \t]*$", re.MULTILINE)
LRC_TIME = r"\[(\d{1,3}):(\d{1,2}(?:[.:]\d{1,3})?)\]"
_MAX_LRC_CHARACTERS = 8 << 20  # a short text may repeat a long line thousands of times
_LRC_FIELD = re.compile(r"\[[A-Za-z#]+:[^\]]*\]")
LYRICS_TIME = r"\[\d+,\d+\]"
FRAME_NUMBERS = r"(?:\{\d+\}\{\d*\}|\[\d+\]\[\d*\])"
_FRAME_RATE = re.compile(r"\A\{[01]\}\{[01]\}[\d.]+[ \t]*(?:\n|$)")  # the first line of some files


def read_cues(text: str) -> str:
    """Extract the text from SubRip or WebVTT."""
    cues: list[list[str]] = [[]]
    for block in re.split(r"\n[ \t]*\n", _CUE_NUMBER.sub("", text)):
        lines = block.strip("\n").split("\n")
        if re.match(r"WEBVTT|NOTE\b|STYLE$|REGION$", lines[0]):
            continue
        times = [CUE_TIMES.match(line) for line in lines]
        if times[0] is None and any(times[1:2]):
            del lines[0], times[0]  # the name of the cue
        for line, match in zip(lines, times, strict=True):
            if match:
                cues.append([])
            words = line[match.end() :] if match else line
            cues[-1].append(_SOUND_NAME.sub("", _BRACES.sub("", words)))
    return "\n".join(_remove_repeats([read_markup("\n".join(cue)).split("\n") for cue in cues]))


def _remove_repeats(cues: list[list[str]]) -> list[str]:
    """Return the lines of all cues, without the repeated lines of rolling captions.

    In rolling captions, a cue starts with the last line of the previous cue. Two equal one-line
    cues may really be spoken twice, so they are merged only if another cue shows rolling captions.
    """
    cues = [lines for cue in cues if (lines := [line.strip() for line in cue if line.strip()])]
    is_rolling = any(len(cue) > 1 and cue[0] == last[-1] for last, cue in pairwise(cues))
    lines = [line for cue in cues for line in cue]
    return [line for line, _ in groupby(lines)] if is_rolling else lines


def read_sbv(text: str) -> str:
    """Extract the text from SBV (YouTube)."""
    return SBV_TIMES.sub("", text).replace("[br]", "\n")


def read_lrc(text: str) -> str:
    """Extract the lines in the order of their times. A line with several times is repeated.

    Raises ``UserError`` if the repeated lines are too long.
    """
    timed: list[tuple[float, str]] = []
    num_characters = 0
    for line in text.split("\n"):
        if _LRC_FIELD.fullmatch(line.strip()):
            continue
        first = re.match(rf"(?:[ \t]*{LRC_TIME})*", line)
        times_s = [
            60 * int(minutes) + float(seconds.replace(":", "."))
            for minutes, seconds in re.findall(LRC_TIME, first[0] if first else "")
        ]
        words = TIME_TAG.sub("", re.sub(LRC_TIME, "", line))
        num_characters += len(words) * len(times_s)
        if num_characters > _MAX_LRC_CHARACTERS:
            raise UserError(
                f"the repeated lines have more than {_MAX_LRC_CHARACTERS} characters; keep only the"
                " spoken text"
            )
        timed += [(time_s, words) for time_s in times_s or [timed[-1][0] if timed else 0.0]]
    return "\n".join(words for _, words in sorted(timed, key=lambda item: item[0]))


def read_timed_lyrics(text: str) -> str:
    """Extract the text from lyrics with the times of words, such as YRC."""
    return re.sub(rf"{LYRICS_TIME}|[(<]\d+(?:,\d+)+[)>]", "", text)


def read_frame_timed_subtitles(text: str) -> str:
    """Extract the text from MicroDVD or MPL2."""
    words = re.sub(rf"^{FRAME_NUMBERS}", "", _FRAME_RATE.sub("", text, 1), flags=re.MULTILINE)
    return _BRACES.sub("", words).replace("|", "\n")


def read_ass_dialogue(text: str) -> str:
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
            if not re.search(r"\{[^{}]*\\p[1-9]", spoken):  # a drawing
                start = [float(part) for part in values.get("start", "0").split(":")]
                events.append((start, re.sub(r"\\[Nnh]", "\n", _BRACES.sub("", spoken))))
    return "\n".join(spoken for _, spoken in sorted(events, key=lambda event: event[0]))
