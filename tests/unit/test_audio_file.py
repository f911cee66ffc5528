from __future__ import annotations

import io
import struct
import tracemalloc
from pathlib import Path

import av
import numpy as np
import pytest
import soundfile

from kouxing.shared.audio_file import open_audio, raw_audio, read_audio
from kouxing.shared.errors import UserError
from kouxing.shared.wav_header import WavHeader, read_wav_header
from tests.system import VOWELS_FILE


@pytest.mark.parametrize("subtype", ["PCM_U8", "PCM_24", "FLOAT", "DOUBLE"])
def test_scales_every_sample_format_to_one(tmp_path: Path, subtype: str) -> None:
    sine = 0.5 * np.sin(np.arange(4000) * 0.1)
    soundfile.write(tmp_path / "a.wav", sine, 16000, subtype=subtype)
    read, _ = read_audio(tmp_path / "a.wav")
    np.testing.assert_allclose(read[:, 0], sine, atol=0.01)


def test_resamples_rates_above_48_khz(tmp_path: Path) -> None:
    sine = 0.5 * np.sin(2 * np.pi * 440 * np.arange(192000) / 192000)
    soundfile.write(tmp_path / "a.wav", sine, 192000)
    read, rate_hz = read_audio(tmp_path / "a.wav")
    assert rate_hz == 48000
    expected = 0.5 * np.sin(2 * np.pi * 440 * np.arange(48000) / 48000)
    np.testing.assert_allclose(read[1000:-1000, 0], expected[1000:-1000], atol=1e-3)


def test_reads_a_long_file_in_little_memory(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "long.flac", np.zeros(600 * 8000, np.float32), 8000)
    tracemalloc.start()
    source = open_audio(tmp_path / "long.flac", block_s=1.0)
    num_samples = sum(len(block) for block in source.blocks)
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (num_samples, source.duration_s) == (600 * 8000, 600)
    assert peak_bytes < 1e6


def test_rejects_a_file_without_samples(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "low.wav", np.zeros(4000, np.float32), 4000)
    for name, content, error in (
        ("empty.wav", b"", "empty"),
        ("text.wav", b"this is not audio", "cannot read audio"),
        ("header.wav", VOWELS_FILE.read_bytes()[:44], "no samples"),
        ("list.m3u8", b"#EXTM3U\n#EXTINF:5,\n" + bytes(VOWELS_FILE), "cannot read audio"),
        ("low.wav", (tmp_path / "low.wav").read_bytes(), "too low"),
    ):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(UserError, match=rf"{name}.*{error}"):
            open_audio(tmp_path / name)
    with pytest.raises(UserError, match="folder"):
        open_audio(tmp_path)


def test_rejects_nan_and_reports_its_time(tmp_path: Path) -> None:
    samples = np.zeros(32000, np.float32)
    samples[24000] = np.inf
    soundfile.write(tmp_path / "a.wav", samples, 16000, subtype="FLOAT")
    with pytest.raises(UserError, match=r"near 1\.50 s"):
        read_audio(tmp_path / "a.wav")


@pytest.mark.parametrize("suffix", ["wav", "mp3", "mkv"])
def test_remarks_on_a_file_that_is_cut_off(tmp_path: Path, suffix: str) -> None:
    sine = (0.5 * np.sin(2 * np.pi * 440 * np.arange(32000) / 16000)).astype(np.float32)
    path = tmp_path / f"a.{suffix}"
    if suffix == "mkv":
        _write_media(path, "pcm_s16le", sine, 16000)
    else:
        soundfile.write(path, sine, 16000)
    remarks = []
    for _ in range(2):
        source = open_audio(path)
        assert sum(len(block) for block in source.blocks) > 0
        remarks.append([*source.remarks])
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 + 1])
    whole, (cut,) = remarks
    assert whole == []
    assert "cut off" in cut
    assert suffix == "mkv" or "of 2.0 s" in cut


def test_ignores_the_unknown_length_of_a_pipe(tmp_path: Path) -> None:
    path = tmp_path / "piped.wav"
    soundfile.write(path, np.zeros(1600, np.float32), 16000)
    data = bytearray(path.read_bytes())
    data[4:8] = data[40:44] = b"\xff\xff\xff\xff"  # as written to a pipe
    path.write_bytes(data)
    source = open_audio(path)
    assert sum(len(block) for block in source.blocks) == 1600
    assert source.remarks == []


def test_reads_raw_audio_in_odd_pieces() -> None:
    values = np.arange(-1000, 1000, dtype="<i2")
    source = raw_audio(io.BytesIO(values.tobytes() + b"\x01"), 16000, 2)
    read = np.concatenate(list(source.blocks))
    np.testing.assert_allclose(read.ravel() * 32768, values)


@pytest.mark.parametrize(
    ("subtype", "expected"), [("PCM_16", 0.25), ("FLOAT", 0.25), ("PCM_24", "use 16-bit PCM")]
)
def test_reads_the_wav_header_of_a_pipe(subtype: str, expected: float | str) -> None:
    file = io.BytesIO()
    soundfile.write(file, np.full((3000, 2), 0.25), 24000, subtype=subtype, format="WAV")
    file.seek(0)
    if isinstance(expected, str):
        with pytest.raises(UserError, match=expected):
            raw_audio(file, 16000, 1)
        return
    source = raw_audio(file, 16000, 1)
    assert (source.sample_rate_hz, source.num_channels) == (24000, 2)
    np.testing.assert_array_equal(np.concatenate([*source.blocks])[:3000], expected)


def _write_media(path: Path, codec: str, samples: np.ndarray, rate_hz: int) -> None:
    with av.open(path, "w") as container:
        stream = container.add_stream(codec, rate=rate_hz, layout="mono")
        assert isinstance(stream, av.AudioStream)
        resampler = av.AudioResampler(stream.format.name, "mono", rate_hz, frame_size=960)
        frame = av.AudioFrame.from_ndarray(samples[None], format="fltp", layout="mono")
        frame.sample_rate = rate_hz
        for part in [*resampler.resample(frame), *resampler.resample(None)]:
            container.mux(stream.encode(part))
        container.mux(stream.encode(None))


@pytest.mark.parametrize(
    ("name", "codec", "rate_hz"),
    [
        ("a.mp3", "libmp3lame", 32000),
        ("a.m4a", "aac", 44100),
        ("a.webm", "libopus", 48000),
        ("a.mkv", "pcm_s16le", 22050),
    ],
)
def test_reads_the_formats_of_phones_and_browsers(
    tmp_path: Path, name: str, codec: str, rate_hz: int, capfd: pytest.CaptureFixture[str]
) -> None:
    sine = (0.5 * np.sin(2 * np.pi * 440 * np.arange(rate_hz) / rate_hz)).astype(np.float32)
    _write_media(tmp_path / name, codec, sine, rate_hz)
    source = open_audio(tmp_path / name)
    blocks = list(source.blocks)
    samples = np.concatenate(blocks)[:, 0]
    assert (source.sample_rate_hz, source.num_channels) == (rate_hz, 1)
    assert source.duration_s == pytest.approx(1.0, abs=0.1)
    assert {len(block) for block in blocks[:-1]} == {round(0.02 * rate_hz)}
    assert len(samples) / rate_hz == pytest.approx(1.0, abs=0.1)
    assert np.argmax(np.abs(np.fft.rfft(samples[:rate_hz]))) == pytest.approx(440, abs=10)
    assert source.remarks == []


def test_rejects_media_without_audio_and_playlists(tmp_path: Path) -> None:
    with av.open(tmp_path / "mute.mp4", "w") as container:
        stream = container.add_stream("mpeg4", rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.width = stream.height = 32
        stream.pix_fmt = "yuv420p"
        picture = av.VideoFrame.from_ndarray(np.zeros((32, 32, 3), np.uint8), format="rgb24")
        container.mux(stream.encode(picture))
        container.mux(stream.encode(None))
    with pytest.raises(UserError, match="has no audio"):
        open_audio(tmp_path / "mute.mp4")


def test_reads_the_header_of_a_stream() -> None:
    assert read_wav_header(bytes(100)) is None
    extensible = struct.pack("<HHIIHHHHI", 0xFFFE, 1, 48000, 0, 4, 32, 22, 32, 4) + b"\3\0"
    chunks = b"LIST\3\0\0\0abc\0fmt " + struct.pack("<I", 40) + extensible.ljust(40, b"\0")
    header = b"RIFF\0\0\0\0WAVE" + chunks + b"data\xff\xff\xff\xff"
    assert read_wav_header(header + bytes(4)) == WavHeader(
        sample_rate_hz=48000, num_channels=1, encoding="f32le", num_bytes=len(header)
    )
    with pytest.raises(UserError, match="incomplete"):
        read_wav_header(header[:30])
