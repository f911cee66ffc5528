"""Detects data that is not 16-bit PCM although a client announced 16-bit PCM.

Such data sounds like loud noise. Real noise may be equally loud. Data is therefore rejected only
if the same bytes are plausible sound in another encoding, or contain the frames of a codec.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from kouxing.shared.arrays import Doubles, Floats, UInt8
from kouxing.shared.audio.audio_formats import NUM_BEGIN_BYTES, audio_file_kind, find_media_start
from kouxing.shared.audio.pcm import FULL_SCALE, as_floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError

BLOCK_SAMPLES = 2400  # per channel, checked together; a multiple of all sample sizes
_MAX_BLOCKS = 60  # non-silent blocks after which the check ends
_MAX_REJECTED_BLOCKS = 2  # blocks that are not PCM after which the data is rejected
_MIN_SOUND_BLOCKS = 3  # blocks of sound after which the check ends
_SEGMENT_SAMPLES = 200  # in a spectrum
_MAX_SAMPLE = 1.5  # largest plausible sample in another encoding
_SILENCE, _QUIET, _AUDIBLE = 0.01, 0.003, 0.05  # root mean square, of full scale
# Ranges of misread data, and of the reading with the right encoding.
_MIN_WIDE_RMS, _MIN_WIDE_FLATNESS, _MAX_SOUND_FLATNESS = 0.3, 0.45, 0.3
_MIN_NARROW_RMS, _MIN_NARROW_FLATNESS, _MAX_NARROW_CORRELATION = 0.4, 0.2, 0.9
_MIN_DISTINCT = 60  # values of a block; clipped sound and square waves have fewer
_MIN_GAIN = 4.0  # ratio of the two flatnesses
_MIN_SOUND_CORRELATION, _MIN_READ_CORRELATION = 0.3, 0.4  # between neighbors in sound
_NUM_PACKETS = 10  # messages that start with the same 4 bits: packets of a codec
_MAX_LOW_BYTE_SHARE = 0.3  # share of the most frequent low byte; larger in clipped and 8-bit sound


class Measure(NamedTuple):
    """How samples sound."""

    flatness: float  # of the spectrum
    correlation: float  # between neighbors
    rms: float  # of full scale


_WIDE = {  # FFmpeg's codec of each encoding
    "16-bit big-endian samples": "pcm_s16be",
    "24-bit samples": "pcm_s24le",
    "32-bit samples": "pcm_s32le",
    "32-bit float samples": "pcm_f32le",
    "64-bit float samples": "pcm_f64le",
}
_NARROW = {"mu-law": "pcm_mulaw", "A-law": "pcm_alaw", "unsigned 8-bit samples": "pcm_u8"}
_CODECS = _WIDE | _NARROW


class EncodingCheck:
    """Checks a client's messages of ``s16le`` samples up to the first sound."""

    def __init__(self, num_channels: int) -> None:
        self._num_channels = num_channels
        self._is_done = False
        self._error = ""
        self._begin = b""
        self._waiting = b""
        self._num_blocks = 0  # number of non-silent blocks
        self._num_sound = 0
        self._rejected_encodings: list[str] = []  # likely encodings of the rejected blocks
        self._packet_starts: list[int] = []

    def check(self, message: bytes) -> None:
        """Check a message of any length.

        Raises ``UserError`` if the data has another encoding; the text names the likely encoding.
        All later messages are then also rejected.
        """
        if self._is_done or not message:
            return
        if not self._begin and (kind := audio_file_kind(message)):
            self._error = (
                f"expected s16le samples; this looks like the start of {kind}: decode it, or send"
                " only its samples"
            )
        if self._error:
            raise UserError(self._error)
        self._packet_starts.append(message[0] >> 4)
        self._begin += message[: NUM_BEGIN_BYTES - len(self._begin)]
        self._waiting += message
        num_bytes = 2 * BLOCK_SAMPLES * self._num_channels
        while len(self._waiting) >= num_bytes and not self._is_done:
            block, self._waiting = self._waiting[:num_bytes], self._waiting[num_bytes:]
            self._judge(np.frombuffer(block, np.uint8))

    def _judge(self, data: UInt8) -> None:
        """Count a block as sound, or as another encoding; a silent block does not count."""
        samples = data.view("<i2")
        channels = (samples / FULL_SCALE).reshape(-1, self._num_channels).T
        if channels.std(axis=1).max() < _SILENCE:
            self._packet_starts.clear()
            return
        self._num_blocks += 1
        self._is_done = self._num_blocks >= _MAX_BLOCKS
        measures = [_measure(channel) for channel in channels]
        flatness, correlation, rms = max(measures, key=lambda measure: measure.rms)
        white = [
            measure.flatness
            for measure in measures
            if measure.rms > _MIN_WIDE_RMS and measure.flatness > _MIN_WIDE_FLATNESS
        ]
        is_white = bool(white)
        if is_white:
            flatness = max(white)
        else:
            self._packet_starts.clear()
        is_narrow = (
            rms > _MIN_NARROW_RMS
            and flatness > _MIN_NARROW_FLATNESS
            and correlation < _MAX_NARROW_CORRELATION
            and len(np.unique(samples)) > _MIN_DISTINCT
        )
        readings = {
            name: self._measure_loudest(_decode(data, codec)) for name, codec in _CODECS.items()
        }
        likely = _likely_encoding(readings, flatness, is_white=is_white, is_narrow=is_narrow)
        if likely:
            self._reject(likely)
        elif is_white:
            if self._is_compressed(data[::2]):
                self._reject("compressed data")
        elif (
            correlation > _MIN_SOUND_CORRELATION
            and rms > _AUDIBLE
            and flatness < min(reading.flatness for reading in readings.values())
        ):
            self._num_sound += 1
            self._is_done = self._num_sound == _MIN_SOUND_BLOCKS

    def _reject(self, kind: str) -> None:
        self._rejected_encodings.append(kind)
        if len(self._rejected_encodings) == _MAX_REJECTED_BLOCKS:
            kinds = " or ".join(sorted(set(self._rejected_encodings)))
            self._error = (
                f"expected s16le samples; this looks like noise, perhaps {kinds}: decode it if it"
                " is compressed, or convert it if it has another encoding"
            )
            raise UserError(self._error)

    def _is_compressed(self, low_bytes: UInt8) -> bool:
        starts = self._packet_starts[:_NUM_PACKETS]
        has_packets = (
            len(starts) == _NUM_PACKETS
            and len(set(starts)) == 1
            and np.bincount(low_bytes).max() < _MAX_LOW_BYTE_SHARE * len(low_bytes)
        )
        return has_packets or find_media_start(self._begin) is not None

    def _measure_loudest(self, samples: NDArray[np.floating]) -> Measure:
        """Measure the loudest channel. Far beyond full scale, the flatness is infinite."""
        if not (np.abs(samples) < _MAX_SAMPLE).all():  # also for NaN
            return Measure(np.inf, 0.0, 0.0)
        channels = samples.astype(np.float64).reshape(-1, self._num_channels)
        return _measure(channels[:, channels.std(axis=0).argmax()])


def _likely_encoding(
    readings: Mapping[str, Measure], flatness: float, *, is_white: bool, is_narrow: bool
) -> str:
    """Return the encoding in which a block is the most plausible sound; empty if in none.

    ``readings`` are the measures of the block in each encoding, and ``flatness`` is that of its
    16-bit samples. These are ``is_white`` if they may be misread wide samples, and ``is_narrow`` if
    they may be misread 8-bit samples.
    """
    plausible = []
    for name, reading in readings.items():
        may_be_wide = is_white and reading.flatness < _MAX_SOUND_FLATNESS
        may_be = is_narrow if name in _NARROW else may_be_wide
        is_sound = reading.correlation > _MIN_READ_CORRELATION and reading.rms > _QUIET
        if may_be and is_sound and flatness > _MIN_GAIN * reading.flatness:
            plausible.append((reading.flatness, name))
    return min(plausible, default=(0.0, ""))[1]


def _decode(data: UInt8, codec: str) -> Floats:
    """Decode bytes as samples of one channel."""
    decoder: Any = av.CodecContext.create(codec, "r")
    decoder.sample_rate, decoder.layout = MEDIA_RATE_HZ, "mono"  # any rate
    (frame,) = decoder.decode(av.Packet(data.tobytes()))
    with np.errstate(over="ignore", invalid="ignore"):  # of 64-bit floats
        return as_floats(frame.to_ndarray().ravel())


def _measure(samples: Doubles) -> Measure:
    samples = samples - samples.mean()
    segments = np.lib.stride_tricks.sliding_window_view(samples, _SEGMENT_SAMPLES)[
        :: _SEGMENT_SAMPLES // 2
    ]
    power = (np.abs(np.fft.rfft(segments * np.hanning(_SEGMENT_SAMPLES))) ** 2).mean(axis=0)[1:]
    power += 1e-9 * power.mean() + 1e-12
    flatness = np.exp(np.log(power).mean()) / power.mean()
    variance = (samples**2).mean() + 1e-12
    correlation = (samples[1:] * samples[:-1]).mean() / variance
    return Measure(flatness, correlation, float(samples.std()))
