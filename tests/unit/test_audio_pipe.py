"""Sound from pipes: formats by their first bytes, and raw samples."""

import io
import os
import sys
from pathlib import Path
from typing import Protocol

import numpy as np
import pytest
import soundfile
from numpy.typing import NDArray

from kouxing.shared.audio.audio_file import AudioSource, limited_blocks, open_audio, read_audio
from kouxing.shared.audio.audio_formats import NUM_BEGIN_BYTES, is_media_format
from kouxing.shared.audio.raw_format import RawFormat
from kouxing.shared.errors import UserError
from tests.system import DEMO
from tests.unit.media import CODECS, samples_of, write_audio

SPEECH = read_audio(DEMO / "hello-male.wav")[0][:32_000, 0]
RATE_HZ = 16_000


class Pipe(io.RawIOBase):
    """A stream that cannot seek and that returns few bytes at a time."""

    def __init__(self, data: bytes | bytearray) -> None:
        self._data = io.BytesIO(data)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
        return self._data.readinto(buffer[:777])


class Open(Protocol):
    def __call__(self, data: bytes | bytearray, raw: RawFormat | None = None) -> AudioSource: ...


@pytest.fixture
def open_pipe(monkeypatch: pytest.MonkeyPatch) -> Open:
    """Open data that arrives from standard input."""

    def open_stdin(data: bytes | bytearray, raw: RawFormat | None = None) -> AudioSource:
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BufferedReader(Pipe(data))))
        return open_audio(Path("-"), raw=raw)

    return open_stdin


@pytest.fixture(params=["file", "pipe"])
def open_either(request: pytest.FixtureRequest, tmp_path: Path, open_pipe: Open) -> Open:
    """Open data in a file or from standard input."""

    def open_file(data: bytes | bytearray, raw: RawFormat | None = None) -> AudioSource:
        (tmp_path / "a.wav").write_bytes(data)
        return open_audio(tmp_path / "a.wav", raw=raw)

    return open_file if request.param == "file" else open_pipe


def wav_file(
    samples: NDArray[np.floating],
    rate_hz: int = RATE_HZ,
    *,
    subtype: str = "PCM_16",
    format: str = "WAV",  # noqa: A002 - the name of the option in soundfile
) -> bytes:
    file = io.BytesIO()
    soundfile.write(file, samples, rate_hz, subtype, format=format)
    return file.getvalue()


RATES_HZ = {"amr": 8_000, "mmf": 8_000, "sbc": 16_000, "mp2": 16_000}


@pytest.mark.parametrize(
    "name",
    ["a.mp3", "a.ogg", "a.flac", "a.wav", "a.aiff", "a.au", "a.caf", "a.w64", "rf64.rf64",
     "fast.m4a", *(f"a.{suffix}" for suffix in CODECS)],
)  # fmt: skip
def test_decodes_a_pipe_like_a_file(tmp_path: Path, open_pipe: Open, name: str) -> None:
    path, suffix = tmp_path / name, name.rpartition(".")[2]
    options = {"movflags": "faststart"} if name == "fast.m4a" else {}
    rate_hz = RATES_HZ.get(suffix, 48_000 if suffix in CODECS else RATE_HZ)
    data = write_audio(path, SPEECH, rate_hz, **options)
    expected, rate_hz = read_audio(path)
    assert is_media_format(data[:NUM_BEGIN_BYTES])
    source = open_pipe(data)
    samples = samples_of(source)
    assert source.sample_rate_hz == rate_hz
    is_read_first = suffix in ("caf", "m4a", "mp4", "wv", "wtv")
    assert is_read_first or source.duration_s is None
    assert len(samples) == len(expected) or suffix == "mp3"  # its padding at the end
    np.testing.assert_array_equal(samples[: len(expected)], expected)
    assert source.warnings == source.notices == []


@pytest.mark.parametrize(
    ("name", "num_zeros", "num_lost"),
    [("a.mp3", 20_000, 0), ("a.mp3", 0, 700), ("a.flac", 100_000, 0), ("a.m4a", 999, 0)],
)
def test_finds_a_format_after_padding_and_within_an_mp3_frame(
    tmp_path: Path, open_pipe: Open, name: str, num_zeros: int, num_lost: int
) -> None:
    path = tmp_path / name
    data = write_audio(path, SPEECH, RATE_HZ, movflags="faststart")
    expected, _ = read_audio(path)
    source = open_pipe(bytes(num_zeros) + data[num_lost:])
    samples = samples_of(source)[:, 0]
    assert source.notices == []
    part = expected[16_000:20_000, 0]  # at another time, if the first frame is missing
    assert np.correlate(samples, part).max() > 0.99 * float(part @ part)


@pytest.mark.parametrize("subtype", ["G721_32", "NMS_ADPCM_32"])
def test_wav_codecs_that_ffmpeg_misidentifies_are_rejected(open_either: Open, subtype: str) -> None:
    with pytest.raises(UserError, match=r"ADPCM is not supported; export"):
        open_either(wav_file(SPEECH, subtype=subtype))


@pytest.mark.parametrize("subtype", ["PCM_16", "FLOAT", "PCM_24", "PCM_U8", "ALAW", "ULAW"])
def test_reads_every_encoding_of_a_wav_pipe(open_pipe: Open, subtype: str) -> None:
    data = wav_file(np.full((3000, 2), 0.25), 24_000, subtype=subtype)
    source = open_pipe(data + b"LIST\4\0\0\0abcd")  # which is not sound
    assert (source.sample_rate_hz, source.num_channels) == (24_000, 2)
    samples = samples_of(source)
    assert len(samples) == 3000
    np.testing.assert_allclose(samples, 0.25, atol=0.01)


@pytest.mark.parametrize("name", ["a.flac", "a.mkv", "a.m4a", "a.au", "a.aiff", "a.w64", "a.flv"])
def test_a_pipe_that_states_a_long_duration_is_rejected_at_once(
    tmp_path: Path, open_pipe: Open, name: str
) -> None:
    data = write_audio(tmp_path / name, SPEECH, RATE_HZ, movflags="faststart")
    assert len(list(limited_blocks(open_pipe(data), 2.5))) >= 100
    with pytest.raises(UserError, match="the audio is longer than"):
        next(limited_blocks(open_pipe(data), 0.9))


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24"])
def test_a_wav_pipe_that_states_a_long_duration_is_rejected_at_once(
    open_pipe: Open, subtype: str
) -> None:
    data = wav_file(SPEECH, subtype=subtype)
    with pytest.raises(UserError, match="the audio is longer than"):
        next(limited_blocks(open_pipe(data), 0.9))
    placeholder = (0x7FFFF000).to_bytes(4, "little")  # as SoX writes it
    place = data.find(b"data") + 4
    data = data[:4] + placeholder + data[8:place] + placeholder + data[place + 4 :]
    assert len(list(limited_blocks(open_pipe(data), 2.0))) == 100


def test_reads_all_parts_of_a_wav_file(open_either: Open) -> None:
    data = wav_file(SPEECH)
    data = data[:4] + (2 * len(data)).to_bytes(4, "little") + data[8:]
    source = open_either(data + b"LIST\4\0\0\0abcd" + data[data.index(b"data") :])
    np.testing.assert_allclose(samples_of(source)[:, 0], np.tile(SPEECH, 2), atol=1e-4)
    assert source.warnings == []


@pytest.mark.parametrize(("bits", "valid_bits"), [(32, 24), (32, 20), (32, 16), (24, 20)])
def test_reads_wav_samples_with_unused_bits(open_either: Open, bits: int, valid_bits: int) -> None:
    data = bytearray(wav_file(SPEECH, subtype=f"PCM_{bits}", format="WAVEX"))
    place = data.find(b"fmt ") + 8 + 18
    data[place : place + 2] = valid_bits.to_bytes(2, "little")
    np.testing.assert_allclose(samples_of(open_either(data))[:, 0], SPEECH, atol=1e-4)


@pytest.mark.parametrize(
    ("place", "field", "message"),
    [
        (0, b"RIFX", "big-endian WAV file"),
        (20, b"\0\0", "the codec of audio track 1 is unknown"),
        (22, b"\0\0", "nothing can be decoded"),
        (40, (32_000).to_bytes(4, "little"), "cut off after 0.5 s of 1.0 s"),
    ],
)
def test_reports_a_wrong_wav_header(
    open_either: Open, place: int, field: bytes, message: str
) -> None:
    data = bytearray(wav_file(np.full(8000, 0.25)))
    data[place : place + len(field)] = field
    data[4:8] = (32_036).to_bytes(4, "little")
    try:
        source = open_either(data)
        assert len(samples_of(source)) == 8000
        text = source.warnings[0]
    except UserError as error:
        text = str(error)
    assert message in text


def test_reports_the_length_of_a_cut_wav_pipe_with_a_high_rate(open_pipe: Open) -> None:
    source = open_pipe(wav_file(np.full(4 * 96_000, 0.25), 96_000)[: 2 * 96_000 * 2 + 44])
    samples_of(source)
    assert "cut off after 2.0 s of 4.0 s" in source.warnings[0]


@pytest.mark.parametrize("name", ["a.wav", "a.mp3", "a.webm"])
def test_samples_arrive_before_the_pipe_ends(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    data = write_audio(path, SPEECH.repeat(3), 48_000)
    os.mkfifo(tmp_path / "fifo")
    writer = os.open(tmp_path / "fifo", os.O_RDWR)
    os.write(writer, data[: len(data) // 3])
    source = open_audio(tmp_path / "fifo")
    assert len(next(source.blocks)) == source.sample_rate_hz // 50
    os.close(writer)
    [*source.blocks]  # noqa: B018 - it ends in the middle of a packet


def test_reports_a_cut_flv_pipe(open_pipe: Open, tmp_path: Path) -> None:
    data = write_audio(tmp_path / "a.flv", SPEECH.repeat(3), 48_000)
    for share in np.linspace(0.4, 0.9, 20):  # FFmpeg takes some of these ends for a new track
        assert [*open_pipe(data[: int(len(data) * share)]).blocks]


def test_raw_samples_are_read_with_a_notice_if_no_format_fits(open_pipe: Open) -> None:
    values = np.arange(-1000, 1000, dtype="<i2")
    source = open_pipe(values.tobytes() + b"\x01")
    np.testing.assert_allclose(samples_of(source).ravel() * 32768, values)
    (notice,) = source.notices
    assert "raw samples: 16-bit, mono, 16000 Hz" in notice
    source = open_pipe(values.tobytes(), RawFormat(24_000, 2))
    assert (source.sample_rate_hz, source.num_channels, source.notices) == (24_000, 2, [])


def test_a_voice_in_one_of_many_raw_channels_stays_loud(open_pipe: Open) -> None:
    channels = np.zeros((3200, 8), "<i2")
    channels[:, 5] = 16_384 * np.sin(np.arange(3200) * 0.1)
    source = open_pipe(channels.tobytes(), RawFormat(16_000, 8))
    samples = samples_of(source)
    assert source.num_channels == samples.shape[1] == 2
    np.testing.assert_allclose(samples.mean(axis=1) * 32_768, channels[:, 5], atol=1)


def test_quiet_raw_samples_are_not_taken_for_frames() -> None:
    rng = np.random.default_rng(0)
    pieces = [rng.integers(-low, low + 1, 2048) for low in (1, 2, 9, 300, 3000) for _ in range(99)]
    assert not any(is_media_format(b"\xff\xfb" + piece.astype("<i2").tobytes()) for piece in pieces)
    assert not any(is_media_format(b"\xff\xff" + piece.astype("<i2").tobytes()) for piece in pieces)
    assert not is_media_format(b"\x9c\0" * 2048)


@pytest.mark.parametrize(
    ("data", "raw", "message"),
    [
        (b"", None, "no audio arrived"),
        (b'{"error": "invalid key"}', None, 'this is text, not audio: \'{"error": "invalid key'),
        (b"\x1f\x8b\x08" + bytes(99), None, "gzip archive; unpack"),
        (b"\2#!SILK_V3" + bytes(99), None, "SILK voice message"),
        (b"\0" * 99, RawFormat(4_000), "4000 Hz is too low"),
        (b"RIFF" + bytes(99), RawFormat(), "a WAV file, not raw samples; leave out --raw"),
    ],
)
def test_rejects_a_pipe_that_is_not_sound(
    open_pipe: Open, data: bytes, raw: RawFormat | None, message: str
) -> None:
    with pytest.raises(UserError, match=f"standard input: .*{message}"):
        open_pipe(data, raw)


@pytest.mark.parametrize("num_bytes", [0, 300, 3000, 9000])
@pytest.mark.parametrize("name", ["a.mp3", "a.flac", "a.wav", "a.ogg"])
def test_ctrl_c_ends_reading_at_any_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, num_bytes: int
) -> None:
    class InterruptedPipe(Pipe):
        def readinto(self, buffer: memoryview) -> int:  # type: ignore[override]
            size = super().readinto(buffer)
            if size == 0:
                raise KeyboardInterrupt
            return size

    pipe = InterruptedPipe(write_audio(tmp_path / name, SPEECH, RATE_HZ)[:num_bytes])
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BufferedReader(pipe)))
    with pytest.raises(KeyboardInterrupt):
        [*open_audio(Path("-")).blocks]
