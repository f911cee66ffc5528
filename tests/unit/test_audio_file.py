import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import soundfile

from kouxing.services.mono_audio import read_mono_16k
from kouxing.shared.audio.audio_file import open_audio, read_audio
from kouxing.shared.errors import UserError
from tests.system import VOWELS_FILE, samples_of_file
from tests.unit.media import samples_of
from tests.videos import write_video


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


def test_holds_the_samples_of_a_recording_only_once(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "long.wav", np.zeros(100 * 16_000, np.float32), 16_000)
    tracemalloc.start()
    samples = read_mono_16k(tmp_path / "long.wav")
    _, peak_bytes = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(samples) == 100 * 16_000
    assert peak_bytes < 1.3 * samples.nbytes


def test_rejects_a_file_without_usable_samples(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "low.wav", np.zeros(4000, np.float32), 4000)
    write_video(tmp_path / "mute.mp4", has_sound=False)
    for name, content, error in (
        ("empty.wav", b"", "empty"),
        ("text.wav", b"this is not audio", "cannot read audio"),
        ("header.wav", VOWELS_FILE.read_bytes()[:44], "no samples"),
        ("list.m3u8", b"#EXTM3U\n#EXTINF:5,\n" + bytes(VOWELS_FILE), "cannot read audio"),
        ("json.mp3", b'{"error": "quota"}', 'this is text, not audio: \'{"error"'),
        ("zeros.wav", bytes(5000), "only zeros"),
        ("zip.wav", b"PK\3\4" + bytes(100), "zip archive; unpack it"),
        ("my.vrm", b"glTF" + bytes(100), "this is an avatar, not audio; show it with --head"),
        ("cut.m4a", b"\0\0\0\x10ftypM4A \0\0\0\0\0\0\xff\xffmdat" + bytes(99), "before its index"),
        ("low.wav", (tmp_path / "low.wav").read_bytes(), "too low"),
        ("mute.mp4", (tmp_path / "mute.mp4").read_bytes(), "no audio track"),
        *((f"call.{suffix}", bytes(range(1, 200)), "without a header") for suffix in ("ul", "al")),
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


def test_rejects_integers_in_a_file_of_floats(tmp_path: Path) -> None:
    samples = samples_of_file(VOWELS_FILE)
    soundfile.write(tmp_path / "a.wav", samples * 32768, 16000, subtype="FLOAT")
    with pytest.raises(UserError, match="but full scale is 1; divide integers by 32768"):
        read_audio(tmp_path / "a.wav")
    soundfile.write(tmp_path / "a.wav", samples * 8, 16000, subtype="FLOAT")
    assert np.abs(read_audio(tmp_path / "a.wav")[0]).max() == 1


@pytest.mark.parametrize(
    ("gain", "offset", "warning"),
    [
        (1.0, 0.0, ""),
        (0.01, 0.02, "constant offset of 0.020, which hides quiet speech"),
        (0.01, -0.02, "constant offset of -0.020"),
        (0.0, 0.0005, ""),
        (30.0, 0.0, "% of the samples are clipped"),
    ],
)
def test_warns_about_the_level(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], gain: float, offset: float, warning: str
) -> None:
    samples = samples_of_file(VOWELS_FILE) * gain + offset
    soundfile.write(tmp_path / "a.wav", np.clip(samples, -1, 1), 16000)
    read_mono_16k(tmp_path / "a.wav")
    printed = " ".join(capsys.readouterr().err.split())
    assert warning in printed
    assert bool(printed) == bool(warning)


def test_a_short_sound_has_no_constant_offset(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    soundfile.write(tmp_path / "a.wav", [0.25], 16000)
    assert len(read_mono_16k(tmp_path / "a.wav")) == 1
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24"])
@pytest.mark.parametrize(
    ("riff_bytes", "data_bytes"),
    [(0, 0), (36, 0), (2_000_000_036, 2_000_000_000), (2**32 - 1, 2**32 - 1), (2**31 - 1, 2**31)],
)
def test_reads_a_wav_file_whose_header_states_no_length(
    tmp_path: Path, subtype: str, riff_bytes: int, data_bytes: int
) -> None:
    path = tmp_path / "piped.wav"
    sine = 0.5 * np.sin(np.arange(8000) * 0.1)
    soundfile.write(path, sine, 16000, subtype=subtype)
    data = bytearray(path.read_bytes())
    data[4:8] = riff_bytes.to_bytes(4, "little")
    place = data.index(b"data") + 4
    data[place : place + 4] = data_bytes.to_bytes(4, "little")
    path.write_bytes(data)
    source = open_audio(path)
    np.testing.assert_allclose(samples_of(source)[:, 0], sine, atol=1e-4)
    assert source.warnings == []


@pytest.mark.parametrize(
    ("file_format", "num_channels", "channel", "gain"),
    [
        ("WAVEX", 6, 2, 0.707),  # the speech of a film is in the center
        ("FLAC", 6, 2, 0.707),
        ("WAV", 4, 2, 0.707),  # a recorder's third track
        ("WAV", 8, 5, 0.354),
        ("WAV", 6, 3, 1.0),  # has no place in FFmpeg's mix, so it is used alone
        ("FLAC", 3, 2, 0.707),
        ("WAV", 16, 15, 1.0),
        ("WAV", 9, 8, 1.0),  # FFmpeg has no mix for this number
        ("WAV", 32, 31, 1.0),
    ],
)
def test_every_channel_is_audible_in_the_mix(
    tmp_path: Path, file_format: str, num_channels: int, channel: int, gain: float
) -> None:
    channels = np.zeros((8000, num_channels))
    channels[:, channel] = 0.5 * np.sin(np.arange(8000) * 0.1)
    soundfile.write(tmp_path / "a", channels, 16000, format=file_format)
    mixed = read_audio(tmp_path / "a")[0].mean(axis=1)
    np.testing.assert_allclose(mixed, gain * channels[:, channel], atol=1e-3)


def test_uses_one_channel_of_two_that_cancel_each_other(tmp_path: Path) -> None:
    sine = 0.5 * np.sin(np.arange(8000) * 0.1)
    soundfile.write(tmp_path / "a.wav", np.stack([sine, -0.95 * sine], axis=1), 16000)
    source = open_audio(tmp_path / "a.wav")
    np.testing.assert_allclose(samples_of(source).mean(axis=1), sine, atol=1e-4)
    (warning,) = source.warnings
    assert "only channel 1 is used" in warning


def test_two_channels_stay_unchanged(tmp_path: Path) -> None:
    samples = np.random.default_rng(2).uniform(-0.5, 0.5, (5000, 2)).astype(np.float32)
    samples[1000:2000, 1] = -samples[1000:2000, 0]  # cancels, but only for a while
    soundfile.write(tmp_path / "a.wav", samples, 16000, subtype="FLOAT")
    np.testing.assert_array_equal(read_audio(tmp_path / "a.wav")[0], samples)
