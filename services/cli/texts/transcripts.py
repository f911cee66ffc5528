"""Extracts the spoken text from transcripts with times, speakers or labels.

praatio 6.2 is not used: it rejects a TextGrid in which any field is missing. The other formats are
habits of programs and people, which no package reads.
"""

import re
from itertools import pairwise

from kouxing.services.cli.texts.subtitles import CLOCK
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import parse_json

_TO = r"[ \t]*(?:--?>|[-–—~～→])[ \t]*"
_CLOCKS = rf"{CLOCK}(?:{_TO}{CLOCK})?"
_SECONDS = r"\d+(?:\.\d+(?:[ \t]?s)?|[ \t]?s)"
# A time near 0 with hours or decimals is a timestamp. Other times may be part of the spoken text.
_EXACT_START = r"0?0[:：]\d{2}(?:[:：]\d{2}(?:[.,:]\d{1,3})?|[.,]\d{1,3})"
_STAMP = re.compile(  # the time at the start of a line, or at the end after a speaker's name
    rf"""[ \t]*(?:
        (?P<of_recording>
            (?:[(\[{{<（［【〔「] (?:{_CLOCKS}|{_SECONDS}{_TO}{_SECONDS}) [)\]}}>）］】〕」])+
            |{_SECONDS}[ \t]*(?:--?>|→)[ \t]*{_SECONDS}
            |{_EXACT_START}(?:{_TO}{CLOCK})?(?=[ \t]|$)
        )
        |{_CLOCKS}(?=[ \t]|$)
        |\S.{{,30}}?[ \t]{_CLOCKS}[ \t]*$
    )[ \t]*[:：]?[ \t]*""",
    re.VERBOSE,
)
_ZERO = re.compile(r"(?:^|[ \t])0?0[:：]")
_MAX_LINES_BETWEEN_TIMES = 4
LABEL = (  # times of Audacity or CTM, or the name of a recording
    r"(?:\d+(?:\.\d+)?\t\d+(?:\.\d+)?\t|(?:\S+ \d )?\d+\.\d+ +\d+\.\d+ +"
    r"|[A-Za-z](?:(?:[^\W\d]|[.-])*\d){6}[\w.-]*[ \t]+)"
)
SPEAKER = (  # number of a speaker, such as SPEAKER_00: or 说话人 1：
    r"[ \t]*(?:(?i:speaker|spk|spkr|voice|person|participant|channel|s)[ _]?"
    rf"|(?:说话人|說話人|发言人|發言人)[ ]?)\d+(?:[ \t]+{CLOCK})?[ \t]*[:：]"
)
_STRING = re.compile(r'"((?:[^"]|"")*)"')
_CHINESE = re.compile("[〇\u3400-\u9fff]")
_TIERS_OF_WORDS = (["characters"], ["words"])  # of kouxing align, and of other aligners
_UNSPOKEN_LABELS = {"sil", "sp", "spn", "pau", "silence", "<sil>", "<eps>", "#"}
_JSON_NAMES = ("text", "content", "segments", "body", "syllables")
_MAX_DEPTH = 20  # of JSON


def has_times(text: str) -> bool:
    """Return whether the lines of a text contain timestamps, as opposed to spoken times."""
    lines = text.split("\n")
    first, *others = stamps = [_STAMP.match(line) for line in lines]
    if any(stamp and stamp["of_recording"] for stamp in stamps):
        return True
    if first is None or not _ZERO.search(first[0]):
        return False
    return first.end() < len(lines[0]) or any(others[:_MAX_LINES_BETWEEN_TIMES])


def read_timed_lines(text: str) -> str:
    """Extract the lines without their times.

    If several lines have a time and each is followed by a line without one, the timed lines
    contain speaker names, and are omitted.
    """
    lines = [(_STAMP.match(line), line) for line in text.split("\n")]
    are_names = sum(stamp is not None for stamp, _ in lines) > 1 and all(
        stamp is None or (following is None and next_line.strip())
        for (stamp, _), (following, next_line) in pairwise([*lines, (None, "")])
    )
    return "\n".join(
        line if stamp is None else "" if are_names else line[stamp.end() :] for stamp, line in lines
    )


def read_speakers(text: str) -> str:
    """Remove the numbers of speakers from the lines."""
    return re.sub(rf"^{SPEAKER}", "", text, flags=re.MULTILINE)


def read_labels(text: str) -> str:
    """Extract the labels of Audacity, Whisper, CTM or a list of recordings."""
    return "\n".join(re.findall(rf"^{LABEL}(.*)", text, re.MULTILINE))


def read_text_grid(text: str) -> str:
    """Extract the labels of the first tier with Chinese characters or words, or of the only tier.

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
    chosen = [tier for tier in tiers if _CHINESE.search("".join(tier[1:]))]
    chosen = chosen or [tier for tier in tiers if tier[:1] in _TIERS_OF_WORDS] or tiers
    if len(chosen) > 1 and chosen is tiers:
        names = ", ".join(repr(tier[0]) for tier in tiers if tier)
        raise UserError(
            f"this TextGrid has the tiers {names}, none with Chinese characters; keep only"
            " the spoken text"
        )
    labels = chosen[0][1:] if chosen else []
    return "\n".join(label for label in labels if label.lower() not in _UNSPOKEN_LABELS)


def read_json(text: str) -> str:
    """Extract the text of a transcript: of Whisper, of players, or of ``kouxing align``."""
    return _find_text(parse_json(text))


def _find_text(value: object, depth: int = 0) -> str:
    if isinstance(value, str):
        return value
    values = value if isinstance(value, list) else []
    if isinstance(value, dict):
        values = [value[name] for name in _JSON_NAMES if name in value][:1]
    if not values or depth == _MAX_DEPTH:
        raise UserError("this is JSON without the text of a transcript; keep only the spoken text")
    return "\n".join(_find_text(inner, depth + 1) for inner in values)
