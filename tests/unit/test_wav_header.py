"""The header of a WAV file in a stream."""

from __future__ import annotations

import io
import struct
import wave

import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.wav_header import WavHeader, read_wav_header

pytestmark = pytest.mark.unit


def wav(rate_hz: int = 22050, num_channels: int = 1, sample_bytes: int = 2) -> bytes:
    file = io.BytesIO()
    with wave.open(file, "wb") as writer:
        writer.setframerate(rate_hz)
        writer.setnchannels(num_channels)
        writer.setsampwidth(sample_bytes)
        writer.writeframes(bytes(8 * num_channels * sample_bytes))
    return file.getvalue()


def test_reads_the_format() -> None:
    assert read_wav_header(wav(24000, 2)) == WavHeader(
        sample_rate_hz=24000, num_channels=2, encoding="s16le", num_bytes=44
    )
    assert read_wav_header(bytes(100)) is None
    extensible = struct.pack("<HHIIHHHHI", 0xFFFE, 1, 48000, 0, 4, 32, 22, 32, 4) + b"\3\0"
    chunks = b"LIST\3\0\0\0abc\0fmt " + struct.pack("<I", 40) + extensible.ljust(40, b"\0")
    header = b"RIFF\0\0\0\0WAVE" + chunks + b"data\xff\xff\xff\xff"
    assert read_wav_header(header + bytes(4)) == WavHeader(
        sample_rate_hz=48000, num_channels=1, encoding="f32le", num_bytes=len(header)
    )


def test_rejects_other_formats() -> None:
    with pytest.raises(UserError, match="format 1 with 8 bits; use 16-bit PCM"):
        read_wav_header(wav(sample_bytes=1))
    with pytest.raises(UserError, match="incomplete"):
        read_wav_header(wav()[:30])
