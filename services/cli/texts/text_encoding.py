"""Decodes text files. The encoding depends on the language of the text."""

import codecs
import contextlib
import re
from typing import NamedTuple

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
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_CHINESE = ("gb18030", "big5")
_WESTERN = ("cp1252",)
_ENCODINGS = {  # of each language, apart from Unicode; the first one that fits is used
    **dict.fromkeys(("mandarin", "cantonese", "universal"), _CHINESE),
    **dict.fromkeys(("dutch", "english", "french", "german", "indonesian"), _WESTERN),
    **dict.fromkeys(("italian", "portuguese", "spanish", "swedish"), _WESTERN),
    **dict.fromkeys(("russian", "ukrainian"), ("cp1251",)),
    "japanese": ("euc_jp", "cp932"),
    "korean": ("cp949",),
    "polish": ("cp1250",),
    "turkish": ("cp1254",),
    "vietnamese": ("cp1258",),
}
_MIN_COMMON_FRACTION = 0.8  # of the characters of a text that was decoded correctly


class DecodedText(NamedTuple):
    """A text and its encoding."""

    text: str
    encoding: str = ""  # empty: UTF-8


def decode_text(content: bytes, language: str) -> DecodedText:
    """Decode a text file in a language.

    charset-normalizer 3.5 is not used. Of 165 short Chinese sentences in GB 18030, it decodes 89
    correctly, and this function decodes all of them. For other languages, no detection is needed.

    Raises ``UserError`` if the file is not a text, or its encoding is unknown. If the file has a
    known binary format, the message names the format.
    """
    signatures = _BINARY_SIGNATURES.items()
    kind = next((kind for begin, kind in signatures if content.startswith(begin)), "")
    if b"\0" in content:  # a text may start with FORM, as AIFF files do
        kind = kind or audio_file_kind(content)
    if kind:
        raise UserError(f"this is {kind}; save the spoken text as a plain text file")
    texts: dict[str, str] = {}
    for encoding in _possible_encodings(content, language):
        with contextlib.suppress(UnicodeDecodeError):
            texts[encoding] = content.decode(encoding)
    # Big5 bytes are usually also valid GB 18030, but then decode to rare characters
    candidates = [
        encoding
        for encoding in texts
        if encoding != "gb18030" or _has_common_characters(texts[encoding])
    ]
    encoding = next(iter(candidates or texts), "")
    if not encoding or any(ord(letter) < 32 and not letter.isspace() for letter in texts[encoding]):
        raise UserError(
            "this is not a text file, or its encoding is unknown; save the spoken text as plain"
            " text in UTF-8"
        )
    return DecodedText(
        texts[encoding], "" if encoding.startswith("utf-8") else encoding.upper().replace("_", "-")
    )


def _possible_encodings(content: bytes, language: str) -> tuple[str, ...]:
    """Return the encodings to try, in order."""
    for mark, encoding in _BYTE_ORDER_MARKS:
        if content.startswith(mark):
            return (encoding,)
    if b"\0" in content:
        is_big_endian = content[::2].count(0) > content[1::2].count(0)
        return ("utf-16-be" if is_big_endian else "utf-16-le",)
    encodings = _ENCODINGS.get(language, ())
    if encodings is _CHINESE and _has_accented_letters(content):
        encodings = _WESTERN
    return ("utf-8", *encodings)


def _has_accented_letters(content: bytes) -> bool:
    """Return whether most non-ASCII bytes are isolated Windows-1252 letters in ASCII text.

    In Chinese encodings, most characters have two non-ASCII bytes, or a first byte below C0.
    """
    runs = re.findall(rb"[\x80-\xff]+", content)
    accented = [run for run in runs if len(run) == 1 and run >= b"\xc0"]
    num_letters = len(re.findall(rb"[a-z]", content))
    return len(accented) > len(runs) / 2 and num_letters > sum(map(len, runs))


def _has_common_characters(text: str) -> bool:
    """Return whether most characters of a text are among the 7000 that GB 2312 has."""
    characters = [letter for letter in text if not letter.isascii()]
    common = sum(bool(letter.encode("gb2312", "ignore")) for letter in characters)
    return common >= _MIN_COMMON_FRACTION * len(characters)
