"""The PCM format that a client announces, and checks that its data has this format."""

import base64
from dataclasses import dataclass

import numpy as np

from kouxing.shared.errors import UserError
from kouxing.shared.user_file import parse_json

SAMPLE_BYTES = {"s16le": 2, "f32le": 4}
MAX_OBJECT_BYTES = 128 * 1024  # limit for a JSON message
RATES_HZ = (8000, 48000)
NOISE_BLOCK = 2000  # samples of each channel that are judged together
_MIN_LOUD_FRACTION = 0.15  # of samples beyond half of full scale; more than in natural noise
_MAX_NOISE_CORRELATION, _MIN_SOUND_CORRELATION = 0.15, 0.3  # of neighboring samples
_SILENT_POWER, _SOUND_POWER = 1e-4, 1e-3  # of full scale
MAX_FLOAT = 8.0  # sample value; smaller values above 1 are clipped
HEADER_BYTES = 12  # enough to recognize a file
_FILES = {  # by their first bytes
    b"RIFF": "a WAV file",
    b"RF64": "a WAV file",
    b"OggS": "an Ogg file",
    b"fLaC": "a FLAC file",
    b"ID3": "an MP3 file",
    b"FORM": "an AIFF file",
    b".snd": "an AU file",
    b"caff": "a CAF file",
    b"\x1aE\xdf\xa3": "WebM, the format of MediaRecorder",
}


@dataclass(frozen=True, slots=True, kw_only=True)
class PcmFormat:
    """Sample rate, number of channels and encoding of raw PCM.

    Raises ``UserError`` if a field is out of range; the text names the field.
    """

    sample_rate_hz: int
    num_channels: int = 1
    encoding: str = "s16le"  # or f32le

    def __post_init__(self) -> None:
        rate_hz = self.sample_rate_hz
        if type(rate_hz) is not int or not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
            raise UserError(
                f"sample_rate_hz must be an integer from {RATES_HZ[0]} to {RATES_HZ[1]}, "
                f"not {rate_hz!r}"
            )
        if type(self.num_channels) is not int or self.num_channels not in (1, 2):
            raise UserError("num_channels must be 1 or 2")
        if not isinstance(self.encoding, str) or self.encoding not in SAMPLE_BYTES:
            raise UserError(f"encoding must be one of {', '.join(SAMPLE_BYTES)}")

    @property
    def frame_bytes(self) -> int:
        """Size of one sample of all channels."""
        return SAMPLE_BYTES[self.encoding] * self.num_channels

    def __str__(self) -> str:
        channels = "mono" if self.num_channels == 1 else "stereo"
        return f"{self.encoding} samples, {self.sample_rate_hz} Hz {channels}, without a header"

    def check_message(self, message: bytes) -> None:
        """Check a binary message.

        Raises ``UserError`` if it is JSON.
        """
        is_short = len(message) <= MAX_OBJECT_BYTES
        if is_short and message[:1] == b"{" and _is_json(message):
            raise UserError(f"expected {self}; this is JSON: send it as a text message")

    def check_samples(self, pcm: bytes, *, is_first: bool) -> None:
        """Check whole samples. The first ones may be the header of a file.

        Raises ``UserError`` if they do not have this format; the text says what was expected.
        """
        if is_first and (kind := _file_kind(pcm)):
            raise UserError(f"expected {self}; this looks like the start of {kind}")
        if self.encoding == "f32le":
            self._check_level(np.frombuffer(pcm, "<f4"))

    def _check_level(self, samples: np.ndarray) -> None:
        peak = float(np.abs(samples).max(initial=0.0))
        if not peak <= MAX_FLOAT:  # also true for NaN
            raise UserError(
                f"expected {self}, between -1 and 1, got {peak:g}: divide integers by 32768, "
                "or set encoding to s16le"
            )


class NoiseCheck:
    """Detects data that is not PCM of the announced format. Checks only up to the first sound.

    Compressed data, 24-bit, float or big-endian samples sound like loud white noise if they are
    read as 16-bit samples.
    """

    def __init__(self, pcm_format: PcmFormat) -> None:
        self._format = pcm_format
        self._is_sound = pcm_format.encoding != "s16le"
        self._waiting = np.zeros((0, pcm_format.num_channels), np.float32)
        self._num_noisy = 0

    def check(self, pcm: bytes) -> None:
        """Check complete samples.

        Raises ``UserError`` if they are noise.
        """
        if self._is_sound:
            return
        samples = np.frombuffer(pcm, "<i2").reshape(-1, self._format.num_channels)
        self._waiting = np.concatenate([self._waiting, samples / np.float32(32768)])
        while len(self._waiting) >= NOISE_BLOCK and not self._is_sound:
            block, self._waiting = self._waiting[:NOISE_BLOCK], self._waiting[NOISE_BLOCK:]
            self._judge(block)

    def _judge(self, block: np.ndarray) -> None:
        power = (block**2).mean(axis=0)
        heard = power > _SILENT_POWER
        correlation = (block[1:] * block[:-1]).mean(axis=0)[heard] / power[heard]
        is_loud = (np.abs(block) > 0.5).mean(axis=0)[heard] > _MIN_LOUD_FRACTION
        if (is_loud & (np.abs(correlation) < _MAX_NOISE_CORRELATION)).any():
            self._num_noisy += 1
        elif (correlation > _MIN_SOUND_CORRELATION).all() and power.max() > _SOUND_POWER:
            self._is_sound = True
        if self._num_noisy == 2:
            raise UserError(
                f"expected {self._format}; this looks like noise: decode it if it is compressed,"
                " or convert it if it has another encoding"
            )


def check_text(text: str) -> None:
    """Raise ``UserError`` if a text message looks like base64."""
    if len(text) >= 16 and not text.lstrip().startswith("{") and _is_base64(text):
        raise UserError(
            "expected binary messages of samples, or a JSON object; this text looks like base64:"
            " send the bytes as a binary message"
        )


def _file_kind(pcm: bytes) -> str:
    kinds = (kind for prefix, kind in _FILES.items() if pcm.startswith(prefix))
    return next(kinds, "an MP4 file" if pcm[4:8] == b"ftyp" else "")


def _is_json(pcm: bytes) -> bool:
    try:
        parse_json(pcm)
    except ValueError:
        return False
    return True


def _is_base64(text: str) -> bool:
    try:
        base64.b64decode(text.partition(",")[2] or text, validate=True)  # also of a data URL
    except ValueError:
        return False
    return True
