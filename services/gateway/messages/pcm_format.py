"""The PCM format that a client announces, with checks of its data."""

import base64

import numpy as np
from kouxing_client.audio import MAX_FLOAT, SAMPLE_BYTES
from msgspec import Struct

from kouxing.shared.audio.audio_formats import audio_file_kind
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import parse_json
from kouxing.shared.wire.session import Encoding, NumChannels, SampleRate

MAX_OBJECT_BYTES = 128 * 1024  # limit for a JSON message
HEADER_BYTES = 12  # enough to recognize a file


class WrongFormat(UserError):
    """A client's text shows that its audio has another format than the announced one."""


class PcmFormat(Struct, frozen=True, kw_only=True):
    """Sample rate, number of channels and encoding of raw PCM."""

    sample_rate_hz: SampleRate
    num_channels: NumChannels = 1
    encoding: Encoding = "s16le"

    @property
    def frame_bytes(self) -> int:
        """Size of one sample of all channels."""
        return SAMPLE_BYTES[self.encoding] * self.num_channels

    def __str__(self) -> str:
        channels = "mono" if self.num_channels == 1 else "stereo"
        return f"{self.encoding} samples, {self.sample_rate_hz} Hz {channels}, without a header"

    def check_message(self, message: bytes) -> None:
        """Check a binary message. Raises ``UserError`` if it is JSON."""
        is_short = len(message) <= MAX_OBJECT_BYTES
        if is_short and message[:1] == b"{" and _is_json(message):
            raise UserError(f"expected {self}; this is JSON: send it as a text message")

    def check_samples(self, pcm: bytes, *, is_first: bool) -> None:
        """Check whole samples. The first data must not be the header of a file.

        Raises ``UserError`` if they do not have this format; the text says what was expected.
        """
        if is_first and (kind := audio_file_kind(pcm)):
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


def check_text(text: str) -> None:
    """Raise ``WrongFormat`` if a text message looks like base64."""
    if len(text) >= 16 and not text.lstrip().startswith("{") and _is_base64(text):
        raise WrongFormat(
            "expected binary messages of samples, or a JSON object; this text looks like base64:"
            " send the bytes as a binary message"
        )


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
