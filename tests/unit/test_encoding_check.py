"""Data of another encoding that a client announced as s16le is rejected; loud sound is not."""

import io
from pathlib import Path

import av
import numpy as np
import pytest
import soundfile
from numpy.typing import NDArray

from kouxing.shared.audio.encoding_check import EncodingCheck
from kouxing.shared.errors import UserError
from tests.system import DEMO, samples_of_file
from tests.unit.media import write_media

RATE_HZ = 16000
RANDOM = np.random.default_rng(0)
TIME_S = np.arange(2 * RATE_HZ) / RATE_HZ
Samples = NDArray[np.float64]


def speech(gain: float = 1.0) -> Samples:
    """Return speech whose peak is at the gain, clipped to full scale."""
    samples = samples_of_file(DEMO / "hello-male.wav").astype(np.float64)
    scaled: Samples = np.clip(samples / np.abs(samples).max() * gain, -1.0, 1.0)
    return scaled


def raw(samples: Samples, subtype: str = "PCM_16", endian: str = "LITTLE") -> bytes:
    file = io.BytesIO()
    soundfile.write(file, samples, RATE_HZ, subtype, endian, "RAW")
    return file.getvalue()


def stereo(samples: Samples, right: float) -> Samples:
    return np.stack([samples, right * samples], axis=1)


def send(data: bytes, num_channels: int = 1, num_bytes: int = 640) -> EncodingCheck:
    check = EncodingCheck(num_channels)
    for begin in range(0, len(data), num_bytes):
        check.check(data[begin : begin + num_bytes])
    return check


def tone(frequency_hz: float) -> Samples:
    wave: Samples = np.sin(2 * np.pi * frequency_hz * TIME_S + 0.1)
    return wave


@pytest.mark.parametrize(
    ("subtype", "endian", "kind"),
    [
        ("ULAW", "LITTLE", "mu-law"),
        ("ALAW", "LITTLE", "A-law"),
        ("PCM_U8", "LITTLE", "unsigned 8-bit samples"),
        ("PCM_16", "BIG", "16-bit big-endian samples"),
        ("PCM_24", "LITTLE", "24-bit samples"),
        ("PCM_32", "LITTLE", "32-bit samples"),
        ("FLOAT", "LITTLE", "32-bit float samples"),
        ("DOUBLE", "LITTLE", "64-bit float samples"),
    ],
)
@pytest.mark.parametrize(("gain", "num_bytes"), [(0.1, 640), (0.89, 999)])
def test_the_error_names_the_encoding_of_speech(
    subtype: str, endian: str, kind: str, gain: float, num_bytes: int
) -> None:
    gain = 0.89 if subtype == "PCM_U8" else gain  # 8 bits make quiet speech silent
    for samples in (speech(gain), stereo(speech(gain), 0.5)):
        data = bytes(12_000) + raw(samples, subtype, endian)
        with pytest.raises(UserError, match=f"expected s16le.*looks like noise, perhaps .*{kind}"):
            send(data, samples.ndim, num_bytes)


@pytest.mark.parametrize("subtype", ["FLOAT", "PCM_24"])
def test_one_silent_channel_does_not_hide_a_wrong_encoding(subtype: str) -> None:
    with pytest.raises(UserError, match="perhaps"):
        send(raw(stereo(speech(0.3), 0.0), subtype), 2)


def test_refuses_all_later_messages() -> None:
    check = EncodingCheck(1)
    data = raw(speech(), "ULAW")
    for message in (data, bytes(640)):
        with pytest.raises(UserError, match="mu-law"):
            check.check(message)


@pytest.mark.parametrize(("name", "codec"), [("a.mp3", "mp3"), ("a.wav", "pcm_s16le")])
def test_refuses_a_file_with_its_header(name: str, codec: str, tmp_path: Path) -> None:
    path = tmp_path / name
    write_media(path, codec, speech().astype(np.float32), RATE_HZ)
    check = EncodingCheck(1)
    for message in (path.read_bytes(), raw(speech())):
        with pytest.raises(UserError, match=r"this looks like the start of an? .* file: decode it"):
            check.check(message)


@pytest.mark.parametrize("name", ["speech.mp3", "speech.aac"])
def test_refuses_a_compressed_stream(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    write_media(path, name.rpartition(".")[2], speech().astype(np.float32), RATE_HZ)
    with pytest.raises(UserError, match="perhaps compressed data: decode it"):
        send(path.read_bytes()[500:])


def test_refuses_packets_of_a_codec() -> None:
    encoder = av.CodecContext.create("libopus", "w")
    assert isinstance(encoder, av.AudioCodecContext)
    encoder.sample_rate, encoder.layout, encoder.format = 48000, "mono", "flt"
    samples = np.repeat(speech(), 3).astype(np.float32)[None, :]
    check = EncodingCheck(1)

    def stream() -> None:
        for begin in range(0, samples.shape[1] - 960, 960):
            frame = av.AudioFrame.from_ndarray(samples[:, begin : begin + 960], "flt", "mono")
            frame.sample_rate = 48000
            for packet in encoder.encode(frame):
                check.check(bytes(packet))

    with pytest.raises(UserError, match="perhaps compressed data"):
        stream()


@pytest.mark.parametrize(
    "samples",
    [
        *(RANDOM.normal(0, rms, len(TIME_S)).clip(-1, 1) for rms in (0.25, 0.36, 0.6, 1.0)),
        *(RANDOM.uniform(-peak, peak, len(TIME_S)) for peak in (0.62, 0.9, 1.0)),
        np.sign(RANDOM.normal(0, 1, len(TIME_S))),
        *(np.sign(tone(frequency_hz)) for frequency_hz in (50, 440, 3000, 7999)),
        *(0.9 * tone(frequency_hz) for frequency_hz in (440, 4000, 7990)),
        *(np.where(np.arange(len(TIME_S)) % period, 0.0, 0.9) for period in (3, 50, 800)),
        np.floor(RANDOM.uniform(-128, 128, len(TIME_S))) / 128,  # 8-bit noise
        # clipped noise whose messages of 640 bytes all start alike
        np.where(np.arange(len(TIME_S)) % 320, RANDOM.normal(0, 100, len(TIME_S)).clip(-1, 1), 1),
        (3 * (tone(220) + tone(277) + tone(330))).clip(-1, 1),  # clipped music
        *(speech(gain) for gain in (0.89, 5.0, 100.0)),
        np.concatenate([RANDOM.uniform(-1, 1, RATE_HZ), speech()]),
    ],
)
def test_accepts_loud_sound(samples: Samples) -> None:
    send(raw(samples))
    send(raw(stereo(samples, 0.0)), 2)


def test_the_check_ends_with_the_first_speech() -> None:
    check = send(4 * raw(speech(0.89)))
    check.check(raw(speech(), "ULAW"))
