"""Audio files and pipes as blocks of samples."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np
import soundfile
import soxr
from numpy.typing import NDArray

from kouxing.shared.errors import UserError
from kouxing.shared.wav_header import read_wav_header

if TYPE_CHECKING:
    from kouxing.shared.media_file import MediaSound

MIN_RATE_HZ = 8_000
MAX_RATE_HZ = 48_000  # of a session; files above are resampled to it
CLIPPED_LEVEL = 0.999
CLIPPED_SHARE = 0.01  # of the samples; the user is warned about more
Samples = NDArray[np.float32]  # (n, channels), in [-1, 1]
MIN_MISSING_S = 0.05  # of a file that is reported as cut off
_MISSING = re.compile(r"^data : (\d+) \(should be (\d+)\)", re.MULTILINE)
_UNKNOWN_LENGTH = 2**31 - 2**16  # writers to pipes state this length or more


@dataclass(frozen=True, slots=True)
class AudioSource:
    """Audio as an iterator of blocks, with one or two channels."""

    name: str
    sample_rate_hz: int
    num_channels: int
    duration_s: float | None  # None: not known
    blocks: Iterator[Samples]
    remarks: list[str] = field(default_factory=list)  # problems; complete after the last block
    is_live: bool = False  # it arrives in real time


def open_audio(path: Path, block_s: float = 0.02) -> AudioSource:
    """Open an audio file, or the audio of a video, for reading block by block.

    libsndfile reads wav, flac and ogg. FFmpeg reads all others (mp3, m4a, mp4, webm, ...). Files
    above 48 kHz are resampled to 48 kHz. Channels after the second are dropped or mixed in.

    Raises
    ------
    UserError
        If the file is missing, empty, not audio, or below 8 kHz; while reading, if samples are not
        finite.
    """
    file = None
    try:
        if path.is_dir():
            raise UserError(f"{path}: this is a folder; give an audio file")
        if path.stat().st_size == 0:
            raise UserError(f"{path}: the file is empty")
        if path.suffix.lower() != ".mp3":  # libsndfile prints messages for it
            file = soundfile.SoundFile(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot read the file: {error.strerror}") from None
    except soundfile.LibsndfileError:
        pass
    if file is None:
        return _open_media(path, block_s)
    if file.frames == 0:
        raise UserError(f"{path}: the file contains no samples; record it again")
    _check_rate(path, file.samplerate)
    rate_hz = min(file.samplerate, MAX_RATE_HZ)
    remarks: list[str] = []
    return AudioSource(
        name=path.name,
        sample_rate_hz=rate_hz,
        num_channels=min(2, file.channels),
        duration_s=file.frames / file.samplerate,
        blocks=_file_blocks(file, path, rate_hz, block_s, remarks),
        remarks=remarks,
    )


def _check_rate(path: Path, rate_hz: int) -> None:
    if rate_hz < MIN_RATE_HZ:
        raise UserError(f"{path}: {rate_hz} Hz is too low for speech; use {MIN_RATE_HZ} Hz or more")


def _open_media(path: Path, block_s: float) -> AudioSource:
    """Open a file that libsndfile cannot read."""
    from kouxing.shared.media_file import open_media  # noqa: PLC0415 - takes 0.1 s, and few files need it

    sound = open_media(path, MAX_RATE_HZ, 2)
    remarks: list[str] = []
    _check_rate(path, sound.sample_rate_hz)
    return AudioSource(
        name=path.name,
        sample_rate_hz=sound.sample_rate_hz,
        num_channels=sound.num_channels,
        duration_s=sound.duration_s,
        blocks=_media_blocks(path, sound, round(block_s * sound.sample_rate_hz), remarks),
        remarks=remarks,
    )


def _media_blocks(
    path: Path, sound: MediaSound, size: int, remarks: list[str]
) -> Iterator[Samples]:
    """Cut the audio into blocks of one size; the last block may be shorter."""
    rest: list[Samples] = []
    num_rest = num_read = 0
    for piece in sound.blocks:
        if not np.isfinite(piece).all():
            raise UserError(f"{path}: NaN or infinite samples; export the file again")
        rest.append(np.clip(piece, -1.0, 1.0))
        num_rest += len(piece)
        num_read += len(piece)
        if num_rest >= size:
            samples = np.concatenate(rest)
            whole = num_rest - num_rest % size
            yield from np.split(samples[:whole], whole // size)
            rest, num_rest = [samples[whole:]], num_rest - whole
    if num_rest:
        yield np.concatenate(rest)
    if num_read == 0:
        raise UserError(f"{path}: the file contains no samples; record it again")
    if sound.duration_s is not None:
        remarks += _missing(path, num_read / sound.sample_rate_hz, sound.duration_s)


def read_audio(path: Path) -> tuple[Samples, int]:
    """Return all samples, (n, channels), and their rate in Hz; raises as ``open_audio``."""
    source = open_audio(path, block_s=1.0)
    return np.concatenate(list(source.blocks)), source.sample_rate_hz


def num_clipped(samples: Samples) -> int:
    """Return the number of samples at full scale."""
    return int(np.count_nonzero(np.abs(samples) >= CLIPPED_LEVEL))


def clipping_remarks(name: str, share: float) -> list[str]:
    """Return a remark for the user if too large a share of the samples is clipped."""
    if share <= CLIPPED_SHARE:
        return []
    return [f"{name}: {share:.0%} of the samples are clipped; record at a lower level"]


def raw_audio(stream: IO[bytes], sample_rate_hz: int, num_channels: int) -> AudioSource:
    """Read little-endian int16 samples from a pipe, or the format that a WAV header states.

    Raises
    ------
    UserError
        If the header states an encoding, a rate or a number of channels that is not supported.
    """
    rest = stream.read(2 * num_channels * sample_rate_hz // 50)
    header = read_wav_header(rest)
    kind, scale = "<i2", 1 / 32768
    if header is not None:
        sample_rate_hz, num_channels = header.sample_rate_hz, header.num_channels
        if not MIN_RATE_HZ <= sample_rate_hz <= MAX_RATE_HZ or num_channels not in (1, 2):
            raise UserError(
                f"the WAV header states {sample_rate_hz} Hz and {num_channels} channels; use "
                f"{MIN_RATE_HZ} to {MAX_RATE_HZ} Hz and 1 or 2 channels"
            )
        if header.encoding == "f32le":
            kind, scale = "<f4", 1.0
        rest = rest[header.num_bytes :]

    def blocks() -> Iterator[Samples]:
        frame_bytes = np.dtype(kind).itemsize * num_channels
        data = rest
        while data:
            whole = len(data) - len(data) % frame_bytes
            pcm = np.frombuffer(data[:whole], kind).reshape(-1, num_channels)
            if whole:
                yield np.clip(pcm * np.float32(scale), -1.0, 1.0)
            more = stream.read(frame_bytes * sample_rate_hz // 50)
            data = data[whole:] + more if more else b""

    return AudioSource("standard input", sample_rate_hz, num_channels, None, blocks())


def _file_blocks(
    file: soundfile.SoundFile, path: Path, rate_hz: int, block_s: float, remarks: list[str]
) -> Iterator[Samples]:
    num_channels = min(2, file.channels)
    resampler = (
        soxr.ResampleStream(file.samplerate, rate_hz, num_channels, dtype="float32")
        if rate_hz != file.samplerate
        else None
    )
    num_read = 0
    with file:
        while True:
            try:
                block = file.read(round(block_s * file.samplerate), "float32", always_2d=True)
            except soundfile.LibsndfileError as error:
                raise UserError(
                    f"{path}: damaged at {num_read / file.samplerate:.2f} s: {error}"
                ) from None
            is_number = np.isfinite(block).all(axis=1)
            if not is_number.all():
                place_s = (num_read + int(is_number.argmin())) / file.samplerate
                raise UserError(
                    f"{path}: NaN or infinite samples near {place_s:.2f} s; "
                    "export the file again, for example as 16-bit PCM"
                )
            num_read += len(block)
            samples = np.clip(block[:, :num_channels], -1.0, 1.0)
            if resampler is not None:
                samples = resampler.resample_chunk(samples, last=len(block) == 0)
            if len(samples):
                yield np.ascontiguousarray(samples, np.float32)
            if len(block) == 0:
                remarks += _cut_off(file, path, num_read)
                return


def _cut_off(file: soundfile.SoundFile, path: Path, num_read: int) -> list[str]:
    """Return a remark if the file is shorter than its header states."""
    num_stated = file.frames
    if (match := _MISSING.search(file.extra_info)) and int(match[1]) < _UNKNOWN_LENGTH:
        num_stated = int(match[1]) * num_read // int(match[2])
    return _missing(path, num_read / file.samplerate, num_stated / file.samplerate)


def _missing(path: Path, read_s: float, stated_s: float) -> list[str]:
    if stated_s < read_s + MIN_MISSING_S:
        return []
    return [f"{path}: the file is cut off after {read_s:.1f} s of {stated_s:.1f} s"]
