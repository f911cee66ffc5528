"""Recognizes the formats of audio and other files by their first bytes.

puremagic 2.2 is not used: it does not recognize 9 of 28 formats that FFmpeg writes, such as MP2 and
MPEG transport streams.
"""

import codecs
import re
from typing import Literal

import av

NUM_BEGIN_BYTES = 16_384  # enough for all of this module; three frames of the largest size
_MAX_LEADING_ZEROS = 4  # zeros at the start that are part of a format
_MAX_ZERO_BYTES = 131_072  # padding before a format
_NUM_FRAMED_BYTES = 8192  # size of the checked start of a stream that may begin within a frame
_NUM_HEADER_BYTES = 4096  # size of the checked start of a WAV or MP4 file
_COMMON = {
    (0, b"RIFF"): "a WAV file", (0, b"RF64"): "a WAV file", (0, b"OggS"): "an Ogg file",
    (0, b"fLaC"): "a FLAC file", (0, b"ID3"): "an MP3 file", (0, b"FORM"): "an AIFF file",
    (0, b".snd"): "an AU file", (0, b"caff"): "a CAF file", (4, b"ftyp"): "an MP4 file",
    (0, b"\x1a\x45\xdf\xa3"): "WebM, the format of MediaRecorder",
}  # fmt: skip
NUM_MARK_BYTES = max(offset + len(mark) for offset, mark in _COMMON)  # enough for `audio_file_kind`
_MEDIA = (
    *_COMMON, (0, b"RIFX"), (0, b"BW64"), (0, b"riff\x2e\x91\xcf\x11"), (0, b"#!AMR"),
    (0, b"\x30\x26\xb2\x75\x8e\x66\xcf\x11"), (0, b"FLV"), (0, b"wvpk"), (0, b"TTA1"),
    (0, b"MAC "), (0, b"\0\0\1\xba"), (4, b"moov"), (4, b"mdat"), (4, b"wide"), (0, b".RMF"),
    (0, b".ra\xfd"), (0, b"Creative Voi"), (0, b"nut/multimed"), (0, b"\0\0\0\0\1\xbc"),
    (0, b"\6\x0e\x2b\x34"), (0, b"NIST_1A"), (0, b"\xb7\xd8\0\x20\x37\x49\xda\x11"), (0, b".SoX"),
    (0, b"XoS."), (0, b"MMMD"), (0, b"STRM\0"), (0, b"DSD "), (0, b"FRM8"), (0, b"tBaK"),
    (0, b"MPCK"), (0, b"#!iLBC"), (0, b" paf"), (0, b"fap "), (0, b"PVF1"), (0, b"2BIT"),
    (0, b"\2dss"), (0, b"\3ds2"), (0, b"\x72\xf8\x1f\x4e"), (0, b"MP+"), (0, b"ajkg"),
    *((0, bytes([0x64, 0xA3, kind, 0])) for kind in (1, 2, 3, 4)),  # IRCAM
    *((0, bytes([0, kind, 0xA3, 0x64])) for kind in (1, 2, 3, 4)),
)  # fmt: skip
# Formats that FFmpeg recognizes only by more bytes, with FFmpeg's names.
_UNPROBED = {
    "dts": (0, b"\x7f\xfe\x80\1"),
    "truehd": (4, b"\xf8\x72\x6f\xba"),
    "mlp": (4, b"\xf8\x72\x6f\xbb"),
}
# Codecs whose frames need no container, with the bits of a frame's first two bytes.
_FRAMED = (
    ("mp3", 0xFFE6, 0xFFE2),
    ("mp2", 0xFFE6, 0xFFE4),
    ("aac", 0xFFF6, 0xFFF0),
    ("ac3", 0xFFFF, 0x0B77),
    ("aac_latm", 0xFFE0, 0x56E0),
    ("sbc", 0xFF00, 0x9C00),
)
# Free and invalid bit rates are excluded, because quiet samples often look like them.
_FRAME = re.compile(rb"\xff(?:[\xe2\xe3\xf2\xf3\xfa\xfb][\x10-\xef]|[\xf0\xf1\xf8\xf9])")  # or ADTS
_TS_SYNC = 0x47
_TS_PACKETS = ((0, 188), (4, 192))  # the offset of the first byte, and the packet's size
MAX_OGG_PAGE_BYTES = 27 + 255 + 255 * 255
MIN_UNKNOWN_BYTES = 10**9  # headers of unknown length state 0, or this size or more
# Offset of a file's size, its number of bytes and their order, and the bytes that it excludes.
_SIZES: dict[bytes, tuple[int, int, Literal["little", "big"], int]] = {
    b"RIFF": (4, 4, "little", 8),
    b"RIFX": (4, 4, "big", 8),
    b"FORM": (4, 4, "big", 8),
    b"RF64": (20, 8, "little", 8),
    b"riff": (16, 8, "little", 0),
}
_MISREAD_WAV_CODECS = {0x38: "NMS ADPCM", 0x40: "G.721 ADPCM"}  # decoded wrongly by FFmpeg
_ASF_PROPERTIES = b"\xa1\xdc\xab\x8c\x47\xa9\xcf\x11"  # its size of the file follows
_OTHER = {
    b"PK\3\4": "a zip archive; unpack it first",
    b"\x1f\x8b": "a gzip archive; unpack it first",
    b"7z\xbc\xaf": "a 7z archive; unpack it first",
    b"Rar!": "a rar archive; unpack it first",
    b"%PDF": "a PDF document; use an audio file",
    b"\x89PNG": "a picture; use an audio file",
    b"\xff\xd8\xff": "a picture; use an audio file",
    b"GIF8": "a picture; use an audio file",
    b"glTF": "an avatar, not audio; show it with --head of kouxing run or render",
    **dict.fromkeys((b"#!SILK", b"\2#!SILK"), "a SILK voice message; convert it to wav first"),
    b"MThd": "a MIDI file, which contains notes, not audio; render it to wav with a synthesizer",
}


def is_media_format(begin: bytes) -> bool:
    """Return whether an audio or video format starts with these bytes."""
    return (
        any(begin.startswith(mark, offset) for offset, mark in (*_MEDIA, *_UNPROBED.values()))
        or (begin.startswith(b"\x80\0") and b"(c)CRI" in begin)  # ADX
        or is_transport_stream(begin)
        or _consists_of_frames(begin)
    )


def audio_file_kind(begin: bytes) -> str:
    """Return the kind of a common audio or video file in words; empty for all other data."""
    kinds = (kind for (offset, mark), kind in _COMMON.items() if begin.startswith(mark, offset))
    return next(kinds, "")


def find_media_start(begin: bytes) -> int | None:
    """Return the offset of audio or video in the first bytes of a pipe; None if not found.

    Zeros may precede it. An MP3 or ADTS stream may begin within a frame.
    """
    num_zeros = len(begin) - len(begin.lstrip(b"\0"))
    offsets = [0, *range(max(1, num_zeros - _MAX_LEADING_ZEROS), num_zeros + 1)]
    offsets += [match.start() for match in _FRAME.finditer(begin, num_zeros)]
    return next(
        (start for start in offsets if is_media_format(begin[start:][:NUM_BEGIN_BYTES])), None
    )


def unprobed_format(begin: bytes) -> str | None:
    """Return FFmpeg's name of a format that FFmpeg does not recognize by its first bytes."""
    if begin.startswith(b"\x9c") and is_media_format(begin):
        return "sbc"
    names = (name for name, (offset, mark) in _UNPROBED.items() if begin.startswith(mark, offset))
    return next(names, None)


def needs_more(begin: bytes) -> bool:
    """Return whether more of the first bytes are needed to recognize a format."""
    if len(begin) < 12:
        return True
    content = begin.lstrip(b"\0")
    if len(content) >= NUM_BEGIN_BYTES or len(begin) >= NUM_BEGIN_BYTES + _MAX_ZERO_BYTES:
        return False
    if begin.startswith(b"RIFF") or begin[4:8] == b"ftyp":
        return len(begin) < _NUM_HEADER_BYTES
    if not content:
        return len(begin) < _MAX_ZERO_BYTES
    may_be = _TS_SYNC in (begin[0], begin[4]) or begin.startswith(b"\x80\0")
    may_be |= len(content) < _NUM_FRAMED_BYTES or _framed_codec(content) is not None
    return may_be and find_media_start(begin) is None


def non_audio_kind(begin: bytes) -> str:
    """Describe a file without audio, with a remedy; empty if the type is unknown."""
    for mark, kind in _OTHER.items():
        if begin.startswith(mark):
            return kind
    text = _text_of(begin)
    return f"text, not audio: {text.splitlines()[0][:60]!r}; use an audio file" if text else ""


def why_unreadable(begin: bytes, reason: str) -> str:
    """Return why FFmpeg cannot read a file with these first bytes."""
    if kind := non_audio_kind(begin):
        return f"cannot read audio: this is {kind}"
    if not any(begin):
        return "cannot read audio: the file has only zeros; copy or record it again"
    if begin[4:8] in (b"ftyp", b"mdat"):
        return "cannot read audio: the file is cut off before its index; copy or record it again"
    if is_media_format(begin):
        return f"cannot read audio: the file is damaged or cut off ({reason}); copy it again"
    return (
        f"cannot read audio from this file ({reason}); use wav, flac, mp3, m4a, mp4, webm or ogg."
        " Raw samples need: kouxing speak --raw"
    )


def read_stated_size(begin: bytes) -> int | None:
    """Return the size that a WAV, W64, AVI, AIFF, CAF or WMA header states; None if unknown."""
    if begin.startswith(b"caff"):
        return _stated_bytes_of_caf(begin)
    for mark, (start, size, order, num_before) in _SIZES.items():
        if begin.startswith(mark):
            stated = int.from_bytes(begin[start : start + size], order) + num_before
            return stated if stated < MIN_UNKNOWN_BYTES else None
    if (offset := begin.find(_ASF_PROPERTIES)) > 0:
        return int.from_bytes(begin[offset + 40 : offset + 48], "little")
    return None


def _stated_bytes_of_caf(begin: bytes) -> int | None:
    offset = 8
    while offset + 12 <= len(begin):
        end = offset + 12 + int.from_bytes(begin[offset + 4 : offset + 12], "big", signed=True)
        if begin[offset : offset + 4] == b"data":
            return end if end > offset + 12 else None
        offset = max(end, offset + 12)
    return None


def is_cut_ogg(end: bytes) -> bool:
    """Return whether the last page of an Ogg stream is incomplete."""
    page = end[end.rfind(b"OggS") :]
    num_segments = page[26] if len(page) > 26 else 1
    return b"OggS" in end and len(page) < 27 + num_segments + sum(page[27:][:num_segments])


def codec_of_padded_wav(begin: bytes) -> str | None:
    """Return the codec of a WAV file whose samples have unused bits, such as 24 bits of 32.

    FFmpeg reads such samples as smaller samples.
    """
    header = begin[begin.find(b"fmt ") + 8 :]
    kind, valid, subtype = (
        int.from_bytes(header[offset : offset + 2], "little") for offset in (0, 18, 24)
    )
    bits = int.from_bytes(header[14:16], "little")
    is_padded = kind == 0xFFFE and subtype == 1 and bits in (24, 32) and 8 < valid < bits
    return f"pcm_s{bits}le" if begin[8:12] == b"WAVE" and is_padded else None


def misread_wav_codec(begin: bytes) -> str | None:
    """Return the codec of a WAV file if FFmpeg mistakes it for another one."""
    offset = begin.find(b"fmt ") + 8
    kind = int.from_bytes(begin[offset : offset + 2], "little")
    return _MISREAD_WAV_CODECS.get(kind) if begin[8:12] == b"WAVE" else None


def needs_whole_file(begin: bytes) -> bool:
    """Return whether a file can be decoded only when it is complete."""
    if begin.startswith((b"caff", b"wvpk", b"\xb7\xd8\0\x20")):
        return True
    return begin[4:8] in (b"ftyp", b"mdat", b"wide") and not _has_index_first(begin)


def _has_index_first(begin: bytes) -> bool:
    offset = 0
    while offset + 8 <= len(begin):
        kind = begin[offset + 4 : offset + 8]
        if kind == b"moov":
            return True
        size = int.from_bytes(begin[offset : offset + 4], "big")
        if kind == b"mdat" or size < 8:
            return False
        offset += size
    return False


def is_transport_stream(begin: bytes) -> bool:
    """Return whether the first bytes are packets of MPEG."""
    return any(
        len(syncs := begin[offset::size]) >= 5 and set(syncs[:5]) == {_TS_SYNC}
        for offset, size in _TS_PACKETS
    )


def _framed_codec(begin: bytes) -> tuple[str, int, int] | None:
    start = int.from_bytes(begin[:2], "big")
    return next((kind for kind in _FRAMED if start & kind[1] == kind[2]), None)


def _consists_of_frames(begin: bytes) -> bool:
    """Return whether a codec's parser finds frame after frame from the first byte."""
    kind = _framed_codec(begin)
    if kind is None:
        return False
    codec, mask, sync = kind
    packets = [bytes(packet) for packet in av.CodecContext.create(codec, "r").parse(begin)]
    return (
        len(packets) >= 3
        and len(set(begin)) > 2  # not constant samples
        and begin.startswith(b"".join(packets))
        and all(int.from_bytes(packet[:2], "big") & mask == sync for packet in packets)
    )


def _text_of(begin: bytes) -> str:
    """Return the text, or an empty string if the bytes are not text."""
    try:
        text = codecs.getincrementaldecoder("utf-8-sig")().decode(begin)
    except UnicodeDecodeError:
        return ""
    return text.strip() if all(c.isprintable() or c.isspace() for c in text) else ""
