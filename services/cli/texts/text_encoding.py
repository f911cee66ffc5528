"""Decodes text files. The encoding depends on the language of the text."""

import codecs
import contextlib
import re

import chardet

from kouxing.shared.audio.audio_formats import audio_file_kind
from kouxing.shared.errors import UserError

_BINARY_SIGNATURES = {  # by their first bytes; see also `audio_file_kind`
    b"%PDF": "a PDF document",
    b"{\\rtf": "an RTF document",
    b"PK\x03\x04": "a Word, OpenDocument, EPUB or zip file",
    b"\xd0\xcf\x11\xe0": "a Word or Office document",
    b"\x1f\x8b": "a gzip file",
    b"\x89PNG": "a picture",
    b"\xff\xd8\xff": "a picture",
}
_UNICODE = (
    *("ascii", "utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"),
    *("utf-32", "utf-32-le", "utf-32-be"),
)
_WESTERN = ("cp1252",)
_CHINESE = ("gb18030", "big5")
_ENCODINGS = {  # of each language, apart from Unicode
    **dict.fromkeys(("mandarin", "cantonese", "universal"), _CHINESE),
    **dict.fromkeys(("dutch", "english", "french", "german", "indonesian"), _WESTERN),
    **dict.fromkeys(("italian", "portuguese", "spanish", "swedish"), _WESTERN),
    **dict.fromkeys(("russian", "ukrainian"), ("cp1251",)),
    "japanese": ("euc-jp", "cp932"),
    "korean": ("cp949",),
    "polish": ("cp1250",),
    "turkish": ("cp1254",),
    "vietnamese": ("cp1258",),
}
_NOT_CHINESE = re.compile(
    "[\u0250-\u02af\u0400-\u0fff\u3040-\u30ff]"
)  # IPA, Hebrew, kana and others
_MIN_CONFIDENCE = 0.01  # an accented word has 0.02; damaged text that fits Windows-1252 has 0.001


def decode_text(content: bytes, language: str) -> tuple[str, str]:
    """Return the text of a file in a language, and its encoding; empty for UTF-8.

    Raises ``UserError`` if the file is not a text, or its encoding is unknown. If the file has a
    known binary format, the message names the format.
    """
    signatures = _BINARY_SIGNATURES.items()
    kind = next((kind for begin, kind in signatures if content.startswith(begin)), "")
    if b"\0" in content:  # a text may start with FORM, as AIFF files do
        kind = kind or audio_file_kind(content)
    if kind:
        raise UserError(f"this is {kind}; save the spoken text as a plain text file")
    encodings = _ENCODINGS.get(language, ())
    detected = chardet.detect(
        content,
        max_bytes=len(content) or 1,
        include_encodings=(*_UNICODE, *encodings, *(_WESTERN if encodings is _CHINESE else ())),
        no_match_encoding="utf-8",
    )
    likely = detected["encoding"] if detected["confidence"] >= _MIN_CONFIDENCE else None
    # chardet does not recognize some short texts, or reads them as rare Chinese characters
    if encodings is _CHINESE and _has_pinyin(content):
        likely = "gb18030"
    candidates = [(likely or "utf-8").lower(), *encodings]
    if b"\0" in content and not content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        is_big_endian = content[::2].count(0) > content[1::2].count(0)
        candidates.insert(0, "utf-16-be" if is_big_endian else "utf-16-le")
    unique = dict.fromkeys(candidates)
    for encoding in sorted(unique, key=lambda name: _has_rare_characters(content, name, language)):
        with contextlib.suppress(UnicodeDecodeError):
            text = content.decode(encoding)
            if all(ord(letter) >= 32 or letter.isspace() for letter in text):
                name = codecs.lookup(encoding).name.upper().replace("_", "-")
                return text, "" if name in ("ASCII", "UTF-8", "UTF-8-SIG") else name
    raise UserError(
        "this is not a text file, or its encoding is unknown; save the spoken text as plain"
        " text in UTF-8"
    )


def _has_pinyin(content: bytes) -> bool:
    """Return whether GB 2312 gives words with accents, which chardet reads as Chinese in Big5."""
    try:
        return re.search("[a-z][à-ǜ]|[à-ǜ][a-z]", content.decode("gb2312")) is not None
    except UnicodeDecodeError:
        return False


def _has_rare_characters(content: bytes, encoding: str, language: str) -> bool:
    """Return whether an encoding gives characters that are rare in Chinese texts.

    They are outside GB 2312 or level 1 of Big5, or not Chinese. ``universal`` allows other scripts.
    """
    try:
        text = content.decode(encoding)
        if language in ("mandarin", "cantonese") and _NOT_CHINESE.search(text):
            return True
        match encoding:
            case "gb18030":
                content.decode("gb2312")
            case "big5":
                return any(letter.encode("big5") >= b"\xc7" for letter in text)
    except UnicodeDecodeError:
        return True
    return False
