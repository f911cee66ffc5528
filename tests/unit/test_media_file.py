"""The times, tracks and damage of media files."""

from pathlib import Path

import av
import numpy as np
import pytest
import soundfile

from kouxing.corpora.lip_tracking import read_video
from kouxing.shared.audio.audio_file import (
    AudioSource,
    check_video,
    limited_blocks,
    open_audio,
    read_audio,
)
from kouxing.shared.errors import UserError
from tests.unit.media import samples_of, write_audio, write_media, write_tracks

RATE_HZ = 48_000
TONE = (0.5 * np.sin(np.arange(RATE_HZ) * 0.1)).astype(np.float32)  # 1 s


def _read(source: AudioSource) -> np.ndarray:
    return samples_of(source)[:, 0]


def _spans(samples: np.ndarray) -> list[tuple[float, float]]:
    """Return the seconds between which there is sound."""
    slices = samples[: len(samples) // 480 * 480].reshape(-1, 480)
    is_loud = np.abs(slices).max(axis=1) > 0.1
    edges = np.flatnonzero(np.diff([False, *is_loud, False])) / 100
    return list(zip(edges[::2], edges[1::2], strict=True))


@pytest.mark.parametrize(
    ("name", "codec"),
    [("a.webm", "libopus"), ("a.mkv", "pcm_s16le"), ("a.mkv", "aac"), ("a.mp4", "aac"),
     ("a.ts", "aac"), ("a.ogg", "libopus"), ("a.mka", "libmp3lame"), ("a.asf", "libmp3lame")],
)  # fmt: skip
def test_gaps_in_timestamps_become_silence(tmp_path: Path, name: str, codec: str) -> None:
    write_tracks(tmp_path / name, codec, [[(0.0, TONE), (5.0, TONE)]], RATE_HZ)
    source = open_audio(tmp_path / name)
    first, second = _spans(_read(source))
    assert first == pytest.approx((0.0, 1.0), abs=0.06)
    assert second == pytest.approx((5.0, 6.0), abs=0.06)
    assert source.warnings == []


@pytest.mark.parametrize(
    ("name", "codec", "start_s", "video_s", "heard_s"),
    [
        ("a.mkv", "aac", 2.0, 5.0, 2.0),
        ("a.mp4", "aac", 2.0, 5.0, 2.0),
        ("a.ts", "aac", 2.0, 5.0, 2.0),
        ("a.mov", "pcm_s16le", 2.0, 5.0, 2.0),
        ("a.mkv", "pcm_s16le", 2.0, 0.0, 2.0),
        ("a.mkv", "pcm_s16le", 40_000.0, 0.0, 0.0),  # the time of day
    ],
)
def test_honors_the_start_of_a_track(
    tmp_path: Path, name: str, codec: str, start_s: float, video_s: float, heard_s: float
) -> None:
    write_media(tmp_path / name, codec, TONE, RATE_HZ, start_s=start_s, video_s=video_s)
    source = open_audio(tmp_path / name)
    assert _spans(_read(source)) == [pytest.approx((heard_s, heard_s + 1.0), abs=0.06)]
    assert source.warnings == []


@pytest.mark.parametrize(
    ("name", "codec", "rates_hz"),
    [("a.ogg", "libopus", [48_000, 48_000]), ("a.ts", "aac", [48_000, 48_000]),
     ("a.aac", "aac", [16_000, 44_100]), ("a.mp3", "libmp3lame", [44_100, 44_100]),
     ("a.wav", "pcm_s16le", [16_000, 16_000])],
)  # fmt: skip
def test_reads_files_that_were_joined(
    tmp_path: Path, name: str, codec: str, rates_hz: list[int]
) -> None:
    data = b""
    for rate_hz in rates_hz:
        write_media(tmp_path / name, codec, TONE[:rate_hz], rate_hz)
        data += (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(data)
    source = open_audio(tmp_path / name)
    samples = _read(source)
    assert source.sample_rate_hz == rates_hz[0]
    assert len(samples) / rates_hz[0] == pytest.approx(2.0, abs=0.25)
    assert np.abs(samples[-rates_hz[0] // 2 : -rates_hz[0] // 4]).max() > 0.3


def test_says_where_a_joined_file_cannot_be_read(tmp_path: Path) -> None:
    data = b""
    for rate_hz in (16_000, 8_000):
        soundfile.write(tmp_path / "a.ogg", TONE[:rate_hz], rate_hz)
        data += (tmp_path / "a.ogg").read_bytes()
    (tmp_path / "a.ogg").write_bytes(data)
    source = open_audio(tmp_path / "a.ogg")
    assert len(_read(source)) == pytest.approx(16_000, abs=600)
    (warning,) = source.warnings
    assert "cannot be read after 1.0 s" in warning


@pytest.mark.parametrize("codec", ["aac", "pcm_s16le"])
def test_mixes_eight_channels(tmp_path: Path, codec: str) -> None:
    channels = np.zeros((RATE_HZ, 8), np.float32)
    channels[:, 2] = TONE
    with av.open(tmp_path / "a.mka", "w") as container:
        stream = container.add_stream(codec, rate=RATE_HZ, layout="7.1")
        assert isinstance(stream, av.AudioStream)
        frame = av.AudioFrame.from_ndarray(channels.reshape(1, -1), format="flt", layout="7.1")
        frame.sample_rate = RATE_HZ
        resampler = av.AudioResampler(stream.format.name, "7.1", RATE_HZ, frame_size=1024)
        for part in [*resampler.resample(frame), *resampler.resample(None)]:
            container.mux(stream.encode(part))
        container.mux(stream.encode(None))
    mixed = read_audio(tmp_path / "a.mka")[0].mean(axis=1)
    assert np.abs(mixed[2000:-2000]).max() == pytest.approx(0.35, abs=0.02)


def test_reads_the_default_track(tmp_path: Path) -> None:
    tracks = [[(0.0, np.zeros_like(TONE))], [(0.0, TONE)]]
    write_tracks(tmp_path / "a.mkv", "pcm_s16le", tracks, RATE_HZ, default_track=2)
    source = open_audio(tmp_path / "a.mkv")
    np.testing.assert_allclose(_read(source), TONE, atol=1e-4)
    assert "This reads track 2" in source.notices[0]


def test_lists_the_tracks_and_reads_the_chosen_one(tmp_path: Path) -> None:
    path = tmp_path / "obs.mkv"
    tracks = [[(0.0, np.zeros_like(TONE))], [(0.0, TONE)]]
    write_tracks(path, "pcm_s16le", tracks, RATE_HZ, titles=["Desktop", "Mic"])
    source = open_audio(path)
    assert _spans(_read(source)) == []
    (notice,) = source.notices
    assert "1 'Desktop' (pcm_s16le, 48000 Hz, 1 ch); 2 'Mic' (" in notice
    assert "--track" in notice
    source = open_audio(path, track=2)
    np.testing.assert_allclose(_read(source), TONE, atol=1e-4)
    assert source.notices == []
    with pytest.raises(
        UserError, match=r"there is no track 3; the tracks are: 1 'Desktop' .* 2 'Mic'"
    ):
        open_audio(path, track=3)


@pytest.mark.parametrize(
    "name",
    [f"a.{suffix}" for suffix in "wav rf64 w64 aiff caf flac mp3 mkv mp4 avi wma opus".split()],
)
def test_warns_about_a_file_that_is_cut_off(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    data = write_audio(path, np.tile(TONE, 3), RATE_HZ, movflags="faststart")
    source = open_audio(path)
    assert len(_read(source)) >= 3 * RATE_HZ
    assert source.warnings == []
    path.write_bytes(data[: len(data) // 2 + 1])
    source = open_audio(path)
    delay_s = 0.08 if name == "a.wma" else 0.0  # of its encoder
    assert _spans(_read(source)[:RATE_HZ]) == [pytest.approx((delay_s, 1.0), abs=0.06)]
    (warning,) = source.warnings
    assert "cut off after" in warning
    assert "of 3." in warning or name == "a.opus"  # its header states no length


@pytest.mark.parametrize(
    "name", [f"a.{suffix}" for suffix in "wav w64 aiff caf flac mp3 m4a mkv mp4 wma opus".split()]
)
def test_a_file_that_states_a_long_duration_is_rejected_before_it_is_decoded(
    tmp_path: Path, name: str
) -> None:
    write_audio(tmp_path / name, np.tile(TONE, 4), RATE_HZ)
    with pytest.raises(UserError, match="the audio is longer than"):
        next(limited_blocks(open_audio(tmp_path / name), 2.0))


@pytest.mark.parametrize("name", ["a.flac", "a.mp3", "a.mp4", "a.opus"])
def test_checking_the_duration_does_not_change_the_samples(tmp_path: Path, name: str) -> None:
    write_audio(tmp_path / name, np.tile(TONE, 4), RATE_HZ)
    checked = open_audio(tmp_path / name)
    assert not checked.is_longer_than(3.9)  # a little more may be padding
    np.testing.assert_array_equal(_read(checked), _read(open_audio(tmp_path / name)))


@pytest.mark.parametrize("name", ["a.flac", "a.mkv", "a.mp4", "a.wav"])
def test_a_file_that_is_cut_off_may_state_a_long_duration(tmp_path: Path, name: str) -> None:
    data = write_audio(tmp_path / name, np.tile(TONE, 4), RATE_HZ, movflags="faststart")
    (tmp_path / name).write_bytes(data[: len(data) // 4])
    source = open_audio(tmp_path / name)
    assert sum(len(block) for block in limited_blocks(source, 2.0)) < 1.5 * RATE_HZ
    assert "cut off after" in source.warnings[0]


def test_a_header_that_states_too_little_does_not_matter(tmp_path: Path) -> None:
    data = bytearray(write_audio(tmp_path / "a.flac", np.tile(TONE, 4), RATE_HZ))
    data[22:26] = (RATE_HZ).to_bytes(4, "big")  # of 4 * RATE_HZ samples
    (tmp_path / "a.flac").write_bytes(data)
    source = open_audio(tmp_path / "a.flac")
    assert source.duration_s == pytest.approx(1.0)
    with pytest.raises(UserError, match="the audio is longer than"):
        list(limited_blocks(source, 2.0))


@pytest.mark.parametrize(
    ("name", "codec", "starts_s", "video_s"),
    [("a.mkv", "aac", [0.0], 4.0), ("a.avi", "libmp3lame", [0.0, 5.0], 0.0)],
    ids=["before the video", "after a gap"],
)
def test_a_track_that_ends_early_is_not_cut_off(
    tmp_path: Path, name: str, codec: str, starts_s: list[float], video_s: float
) -> None:
    track = [(start_s, TONE) for start_s in starts_s]
    write_tracks(tmp_path / name, codec, [track], RATE_HZ, video_s=video_s)
    source = open_audio(tmp_path / name)
    assert len(_read(source)) == pytest.approx(len(starts_s) * RATE_HZ, abs=4000)
    assert source.warnings == []


def test_leaves_out_damage_and_reports_it(tmp_path: Path) -> None:
    noise = np.random.default_rng(1).uniform(-0.5, 0.5, 4 * RATE_HZ)
    soundfile.write(tmp_path / "a.flac", noise, RATE_HZ)
    data = bytearray((tmp_path / "a.flac").read_bytes())
    data[len(data) // 2 : len(data) // 2 + 20_000] = bytes(20_000)
    (tmp_path / "a.flac").write_bytes(data)
    source = open_audio(tmp_path / "a.flac")
    samples = _read(source)
    np.testing.assert_allclose(samples[-RATE_HZ:], noise[-RATE_HZ:], atol=1e-4)
    assert len(samples) == 4 * RATE_HZ
    (warning,) = source.warnings
    assert "damaged near 2." in warning


def test_rejects_encrypted_sound(tmp_path: Path) -> None:
    key = {
        "encryption_scheme": "cenc-aes-ctr",
        "encryption_key": "01" * 16,
        "encryption_kid": "02" * 16,
    }
    write_media(tmp_path / "a.mp4", "aac", TONE, RATE_HZ, options=key)
    with pytest.raises(UserError, match="encrypted"):
        open_audio(tmp_path / "a.mp4")


def test_a_cover_picture_is_not_a_video(tmp_path: Path) -> None:
    soundfile.write(tmp_path / "a.mp3", TONE, RATE_HZ)
    picture = b"\0image/png\0\3\0\x89PNG" + bytes(70_000)
    frame = b"APIC" + len(picture).to_bytes(4, "big") + b"\0\0" + picture
    size = bytes((len(frame) >> shift) & 127 for shift in (21, 14, 7, 0))
    data = b"ID3\3\0\0" + size + frame + (tmp_path / "a.mp3").read_bytes()
    (tmp_path / "a.mp3").write_bytes(data)
    source = open_audio(tmp_path / "a.mp3")
    assert len(_read(source)) == RATE_HZ
    assert source.warnings == []
    with pytest.raises(UserError, match="must have images"):
        check_video(tmp_path / "a.mp3")


def test_images_and_sound_of_a_video_share_their_times(tmp_path: Path) -> None:
    write_media(tmp_path / "a.mkv", "pcm_s16le", TONE, RATE_HZ, start_s=1.0, video_s=3.0)
    times_s: list[float] = []
    samples = read_video(tmp_path / "a.mkv", lambda time_s, _image: times_s.append(time_s))
    assert times_s == pytest.approx(np.arange(75) / 25, abs=0.001)
    assert np.flatnonzero(np.abs(samples) > 0.1)[[0, -1]] / 16_000 == pytest.approx(
        [1.0, 2.0], abs=0.01
    )
