"""Extracts the spoken text from SSML, TTML, HTML, Markdown, and commands of a synthesizer."""

import html
import re

from kouxing.services.cli.texts.text_columns import remove_columns
from kouxing.shared.errors import UserError

# in brackets, for Bark, ChatTTS, CosyVoice, Dia and ElevenLabs; other words in brackets are text
_COMMANDS = (
    "laugh|laughs|laughing|laughter|chuckles|giggles|sigh|sighs|cough|gasps|sobs|crying|wheezing"
    "|snorts|clears|starts|whispers|whispering|breath|quick_breath|inhales|exhales|hissing|clucking"
    "|lipsmack|noise|vocalized-noise|music|accent|mn|angry|curious|excited|happy|sad|sarcastic"
    "|angrily|calmly|cheerfully|curiously|dramatically|excitedly|gently|happily|hesitantly|loudly"
    "|mischievously|nervously|playfully|quickly|quietly|sadly|sarcastically|slowly|softly"
    "|pause|silence|break|uv_break|lbreak|oral|speed|emphasis|strong|spk_emb|[SEP]tts|S[1-9]"
)
COMMAND = re.compile(  # [laughter], [pause:500], [S1], <#0.5#>, <|zh|>, and prosody: #1 to #4
    rf"\[/?(?:{_COMMANDS})(?:[_ :=]+[\w.]+)?\]|<#[\d.]+#>|<\|[^|<>]*\|>"
    r"|(?<=[^\0-\x7f])#[1-4](?!\d)",
    re.IGNORECASE,
)
MARKDOWN = re.compile(r"^#{1,6} |^```|\]\([^])\s]+\)", re.MULTILINE)
TAG = re.compile(
    r"</?[A-Za-z][\w:.-]*(?:\s[^<>]*)?/?>|<!--|&(?:[A-Za-z]{2,8}|#\d+|#x[0-9A-Fa-f]+);"
)
TIME_TAG = re.compile(r"<\d{1,3}:[\d:.]+>")
_MARKUP = re.compile(  # matches in linear time
    r"<(?P<end>/?)(?P<tag>[A-Za-z][\w:.-]*+)"
    r"""(?P<rest>(?:[^<>"']|"[^"<]*"|'[^'<]*')*+(?=>)|[^<>]*)>"""  # a value may contain ">"
    r"|<[!?/][^<>]*>"
    r"|(?P<data><?[^<]+|<)"
)
_ALIAS = re.compile(r"""\balias\s*=\s*(["'])(.*?)\1""", re.DOTALL)
_UNSPOKEN_ELEMENTS = {
    *("script", "style", "title", "template", "rt", "rp"),
    *("metadata", "desc", "copyright", "lexicon", "styling", "layout"),
}
_ANNOTATIONS = {"rt", "rp"}  # they also end with their <ruby>
_LINE_ELEMENTS = {"br", "div", "h1", "h2", "h3", "h4", "li", "p", "s", "td", "text", "tr"}
_MAX_OPEN = 100  # nested elements; each end tag searches all of them


def read_commands(text: str) -> str:
    """Remove commands of a synthesizer."""
    return remove_columns(COMMAND.sub("", text))


def read_markdown(text: str) -> str:
    """Extract the text from Markdown, without metadata, code, pictures and rules."""
    text = re.sub(r"\A---\n.*?\n---\n", "", text, flags=re.DOTALL)  # metadata
    text = re.sub(r"^(```|~~~).*?^\1[^\n]*$", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"!\[[^][]*\]\([^()]*\)", "", text)  # pictures
    text = re.sub(r"\[([^][]*)\](?:\([^()]*\)|\[[^][]*\])", r"\1", text)  # links
    lines = (line for line in text.split("\n") if "-" not in line or line.strip(" \t:|-"))
    text = "\n".join(lines)  # without rules
    text = re.sub(r"^[ \t]*(?:#{1,6}|>+|[-*+]|\d+[.)])[ \t]+", "", text, flags=re.MULTILINE)
    return read_markup(re.sub(r"[*`|]|~~", "", text))


def read_markup(text: str) -> str:
    """Extract the text from SSML, TTML, HTML and subtitles with tags.

    ``html.parser`` and selectolax 1.0 are not used, because they need quadratic time for damaged or
    deeply nested text: more than 20 s for 500 kB. lxml 6.1 drops text after unclosed tags, and
    needs 12 MB. Entities that a document defines are not expanded, so they cannot exhaust memory.
    """
    first, *others = TIME_TAG.sub("", text).split("<!--")
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


def read_escaped_markup(text: str) -> str:
    """Extract the text from XML that contains HTML, such as ``it&amp;#39;s`` of YouTube."""
    return html.unescape(read_markup(text))


def _handle_tag(tag: re.Match[str], spoken: list[str], unspoken: list[str]) -> None:
    name = tag["tag"].lower().rpartition(":")[2]
    if tag["end"]:
        ended = _ANNOTATIONS if name == "ruby" else {name}
        first = next((n for n, element in enumerate(unspoken) if element in ended), len(unspoken))
        del unspoken[first:]
        return
    if name in _LINE_ELEMENTS:
        spoken.append("\n")
    alias = _ALIAS.search(tag["rest"]) if name == "sub" else None
    if alias and not unspoken:
        spoken.append(html.unescape(alias[2]))
    is_open = not tag["rest"].endswith("/") and len(unspoken) < _MAX_OPEN
    if is_open and (name in _UNSPOKEN_ELEMENTS or alias):
        unspoken.append(name)


def reject_xml(text: str) -> str:
    """Raise ``UserError`` with the name of the root element."""
    root = re.search(r"<([A-Za-z][\w:.-]*)", text)
    name = f" with the root element {root[1]!r}" if root else ""
    raise UserError(f"this is XML{name}; keep only the spoken text")
