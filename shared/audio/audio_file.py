"""Reads the audio of files and pipes as blocks of samples."""

import contextlib
import io
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import soxr

from kouxing.shared.audio.audio_formats import (
    NUM_BEGIN_BYTES,
    NUM_MARK_BYTES,
    audio_file_kind,
    find_media_start,
    needs_more,
    needs_whole_file,
    non_audio_kind,
    read_stated_size,
)
from kouxing.shared.audio.media_file import MediaAudio, has_video
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.audio.phase_cancellation import PhaseCancellationGuard, Samples
from kouxing.shared.audio.raw_format import RawFormat, WavPcm, pcm_of_wav
from kouxing.shared.audio.wav_parts import Readable, WavParts, count_parts
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, open_file

MIN_RATE_HZ = 8_000
MAX_RATE_HZ = 48_000  # limit for a session; files above are resampled to it
BLOCK_S = 0.02
_MAX_PLAUSIBLE_SAMPLE = 100.0  # larger samples are integers that were written as floats
_MIN_MISSING_S = 0.05  # a file that lacks more than this is reported as cut off
_MAX_SPOOLED_BYTES = 64 << 20  # in memory, for a pipe that must be read completely
MAX_FILE_BYTES = 8 << 30
MAX_DURATION_S = 3 * 3600.0  # limit for a recording that is held in memory
_PIPE = Path("-")


@dataclass(frozen=True, slots=True)
class AudioSource:
    """Audio as an iterator of blocks, with one or two channels."""

    name: str
    sample_rate_hz: int
    num_channels: int
    duration_s: float | None  # None: not known
    blocks: Iterator[Samples]
    warnings: list[str] = field(default_factory=list)  # problems; complete after the last block
    is_live: bool = False  # whether the audio arrives in real time
    notices: list[str] = field(default_factory=list)  # messages to print before reading
    # Whether the audio is longer than this many seconds; False if unknown before decoding.
    is_longer_than: Callable[[float], bool] = lambda limit_s: False


def open_audio(
    path: Path, block_s: float = BLOCK_S, *, track: int | None = None, raw: RawFormat | None = None
) -> AudioSource:
    """Open an audio file, the audio of a video, or a pipe, for reading block by block.

    FFmpeg decodes it. Silence fills gaps between the file's timestamps. Rates above 48 kHz
    are resampled to 48 kHz, and more than two channels are mixed to two. ``track`` counts from 1.
    The path ``-`` is standard input. Pipes are decoded while they arrive. If no format fits, a pipe
    is read as raw samples. ``raw``: the content is raw samples of this format.

    Raises ``UserError`` if the file is missing, empty, too large, not audio, not raw samples as
    stated, or below 8 kHz. While reading, raises it if samples are not finite.
    """
    file = sys.stdin.buffer if path == _PIPE else open_file(path, MAX_FILE_BYTES, pipe=True)
    is_pipe = path == _PIPE or path.is_fifo()
    name = "standard input" if path == _PIPE else path.name
    with check_content(path, "audio"), contextlib.ExitStack() as files:
        files.enter_context(file)
        if raw is not None:
            source = _open_raw(file, raw, name)
        elif is_pipe:
            source = _open_pipe(file, name, block_s, track, files)
        else:
            source = _open_file(file, str(path), name, block_s, track)
        return replace(source, blocks=_close_after(source.blocks, files.pop_all()))


def _close_after(
    blocks: Iterator[Samples], files: contextlib.AbstractContextManager[object]
) -> Iterator[Samples]:
    with files:
        yield from blocks


def _open_file(
    file: BinaryIO, path: str, name: str, block_s: float, track: int | None
) -> AudioSource:
    num_bytes = file.seek(0, io.SEEK_END)
    file.seek(0)
    if num_bytes == 0:
        raise UserError(f"{path}: the file is empty; copy or record it again")
    begin = file.read(NUM_BEGIN_BYTES)
    if count_parts(file) > 1:  # FFmpeg reads one of them
        if wav := pcm_of_wav(begin):
            return _wav_audio(file, begin, wav, path)
        raise UserError(f"{path}: the file has several audio parts; convert them separately")
    media = MediaAudio(file, path, begin, track, is_pipe=False)
    return _make_source(media, path, name, block_s, begin, lambda: num_bytes)


def _open_pipe(
    stream: BinaryIO, name: str, block_s: float, track: int | None, files: contextlib.ExitStack
) -> AudioSource:
    """Open a pipe. A temporary file with its content is added to ``files``."""
    if stream.isatty():
        raise UserError(f"{name}: this is a terminal; pipe audio into the command")
    pipe = _PeekablePipe(stream)
    begin = pipe.peek(needs_more)
    if not begin:
        raise UserError(f"{name}: no audio arrived; check the command that writes it")
    start = find_media_start(begin)
    if start is None:
        if kind := non_audio_kind(begin):
            raise UserError(f"{name}: this is {kind}")
        source = raw_audio(pipe, raw := RawFormat(), name)
        source.notices.append(
            f"{name}: the audio format is unknown; reading raw samples: 16-bit, mono,"
            f" {raw.sample_rate_hz} Hz; for other samples use kouxing speak with --raw, --rate and"
            " --channels"
        )
        return source
    begin = pipe.skip(start)
    if stream.seekable() or needs_whole_file(begin):
        file = stream if stream.seekable() else files.enter_context(pipe.read_all())
        file.seek(0)
        return _open_file(file, name, name, block_s, track)
    if wav := pcm_of_wav(begin):  # without FFmpeg's delay of 64 KiB
        return _wav_audio(pipe, begin, wav, name)
    media = MediaAudio(pipe, name, begin, track, is_pipe=True)  # type: ignore[arg-type]
    return _make_source(media, name, name, block_s, begin, lambda: pipe.num_bytes)


def _open_raw(stream: BinaryIO, raw: RawFormat, name: str) -> AudioSource:
    pipe = _PeekablePipe(stream)
    if kind := audio_file_kind(pipe.peek(lambda begin: len(begin) < NUM_MARK_BYTES)):
        raise UserError(f"{name}: this is {kind}, not raw samples; leave out --raw")
    return raw_audio(pipe, raw, name)


def _wav_audio(stream: Readable, begin: bytes, wav: WavPcm, name: str) -> AudioSource:
    stream.read(wav.offset)
    parts = WavParts(stream, begin, wav.num_bytes, name)
    source = raw_audio(parts, wav.format, name, lambda: parts.num_missing)
    stated_s = (wav.num_bytes or 0) / wav.format.bytes_per_s
    return replace(source, is_longer_than=lambda limit_s: stated_s > limit_s)


class _PeekablePipe:
    """A pipe whose first bytes can be read twice."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream: Any = stream
        self._begin = b""
        self.num_bytes = 0  # read so far

    def peek(self, needs_more: Callable[[bytes], bool]) -> bytes:
        """Return the first bytes, as many as are needed."""
        while needs_more(self._begin) and (piece := self._stream.read1(NUM_BEGIN_BYTES)):
            self._begin += piece
        return self._begin

    def skip(self, num_bytes: int) -> bytes:
        """Drop the first bytes; return the other bytes that were read."""
        self._begin = self._begin[num_bytes:]
        return self._begin

    def read(self, size: int) -> bytes:
        """Return up to ``size`` bytes as soon as any have arrived; empty at the end."""
        if self._begin:
            piece, self._begin = self._begin[:size], self._begin[size:]
        else:
            piece = self._stream.read1(size)
        self.num_bytes += len(piece)
        return piece

    def read_all(self) -> BinaryIO:
        """Return everything as a file."""
        file = tempfile.SpooledTemporaryFile(_MAX_SPOOLED_BYTES)  # noqa: SIM115 - the reader closes it
        while piece := self.read(NUM_BEGIN_BYTES):
            file.write(piece)
        return file  # type: ignore[return-value]


def read_audio(path: Path) -> tuple[Samples, int]:
    """Return all samples, (n, channels), and their rate in Hz.

    Raises ``UserError`` like ``open_audio``, and if the audio is longer than ``MAX_DURATION_S``.
    """
    source = open_audio(path, block_s=1.0)
    return np.concatenate(list(limited_blocks(source))), source.sample_rate_hz


def limited_blocks(
    source: AudioSource, max_duration_s: float = MAX_DURATION_S
) -> Iterator[Samples]:
    """Yield the blocks of a recording; raises ``UserError`` if it is too long.

    If the file states its duration, the error comes before the first block.
    """
    num_samples = 0
    for block in source.blocks:
        states_too_much = num_samples == 0 and source.is_longer_than(max_duration_s)
        num_samples += len(block)
        if states_too_much or num_samples > max_duration_s * source.sample_rate_hz:
            raise UserError(
                f"{source.name}: the audio is longer than {max_duration_s / 3600:g} h; use a"
                " shorter file"
            )
        yield block


def read_duration_s(path: Path) -> float:
    """Return the duration from a file's header or, if missing, from its samples.

    Raises ``UserError`` as ``open_audio``.
    """
    with open_file(path, MAX_FILE_BYTES) as file, check_content(path, "audio"):
        source = _open_file(file, str(path), path.name, block_s=1.0, track=None)
        num_samples = 0
        if source.duration_s is None:
            num_samples = sum(len(block) for block in source.blocks)
    return source.duration_s or num_samples / source.sample_rate_hz


def check_video(path: Path) -> None:
    """Raise ``UserError`` if a file is not a video with audio."""
    with open_file(path, MAX_FILE_BYTES) as file, check_content(path, "audio"):
        begin = file.read(NUM_BEGIN_BYTES)
        file.seek(0)
        is_video = has_video(file, str(path), begin)
    if not is_video:
        raise UserError(f"{path}: the video must have images and audio; record it again with both")


def raw_audio(
    stream: Readable, raw: RawFormat, name: str, num_missing: Callable[[], int] = lambda: 0
) -> AudioSource:
    """Read raw samples until the end of a stream.

    ``num_missing`` returns the number of missing bytes at the end of the stream.
    """
    rate_hz, num_channels = min(raw.sample_rate_hz, MAX_RATE_HZ), raw.num_channels
    num_mixed = min(2, num_channels)
    _check_rate(name, raw.sample_rate_hz)
    warnings: list[str] = []
    frame_bytes = raw.dtype.itemsize * num_channels
    block_bytes = frame_bytes * raw.sample_rate_hz // 50

    def pieces() -> Iterator[tuple[int, Samples]]:
        guard = PhaseCancellationGuard(name, num_mixed, warnings)
        rest, num_read = b"", 0
        while block := stream.read(block_bytes):
            num_read += len(block)
            data = rest + block
            num_whole = len(data) - len(data) % frame_bytes
            rest = data[num_whole:]
            channels = as_floats(np.frombuffer(data[:num_whole], raw.dtype)).reshape(
                -1, num_channels
            )
            yield raw.sample_rate_hz, guard.mix(channels, channels)
        sizes = (num_read, num_read + num_missing())
        seconds = (size / frame_bytes / raw.sample_rate_hz for size in sizes)
        warnings.extend(_cut_off_warnings(name, *seconds))

    blocks = _blocks(pieces(), name, rate_hz, num_mixed, BLOCK_S)
    return AudioSource(name, rate_hz, num_mixed, None, blocks, warnings)


def _make_source(
    media: MediaAudio,
    path: str,
    name: str,
    block_s: float,
    begin: bytes,
    num_bytes: Callable[[], int],
) -> AudioSource:
    _check_rate(path, media.sample_rate_hz)
    rate_hz = min(media.sample_rate_hz, MAX_RATE_HZ)

    def blocks() -> Iterator[Samples]:
        num_read = 0
        for block in _blocks(media.blocks, path, rate_hz, media.num_channels, block_s):
            num_read += len(block)
            yield block
        if not media.warnings:  # the header may state more bytes than the file has
            read_s = num_read / rate_hz
            stated_s = read_s * (read_stated_size(begin) or 0) / num_bytes()
            media.warnings.extend(_cut_off_warnings(path, read_s, stated_s))

    return AudioSource(
        name=name,
        sample_rate_hz=rate_hz,
        num_channels=media.num_channels,
        duration_s=media.duration_s,
        blocks=blocks(),
        warnings=media.warnings,
        notices=media.notices,
        is_longer_than=media.is_longer_than,
    )


def _check_rate(path: str, rate_hz: int) -> None:
    if rate_hz < MIN_RATE_HZ:
        raise UserError(f"{path}: {rate_hz} Hz is too low for speech; use {MIN_RATE_HZ} Hz or more")


def _blocks(
    pieces: Iterator[tuple[int, Samples]],
    path: str,
    rate_hz: int,
    num_channels: int,
    block_s: float,
) -> Iterator[Samples]:
    """Cut the audio into blocks of one size; the last block may be shorter."""
    size = round(block_s * rate_hz)
    rest: list[Samples] = []
    num_rest = 0
    for piece in _resample(_check_samples(pieces, path), rate_hz, num_channels):
        rest.append(piece)
        num_rest += len(piece)
        if num_rest >= size:
            samples = np.concatenate(rest)
            num_whole = num_rest - num_rest % size
            yield from np.split(samples[:num_whole], num_whole // size)
            rest, num_rest = [samples[num_whole:]], num_rest - num_whole
    if num_rest:
        yield np.concatenate(rest)


def _check_samples(
    pieces: Iterator[tuple[int, Samples]], path: str
) -> Iterator[tuple[int, Samples]]:
    """Clip samples to [-1, 1]; raise ``UserError`` if some are not finite, or integers."""
    read_s = 0.0
    for rate_hz, samples in pieces:
        is_number = np.isfinite(samples).all(axis=1)
        if not is_number.all():
            place_s = read_s + int(is_number.argmin()) / rate_hz
            raise UserError(
                f"{path}: NaN or infinite samples near {place_s:.2f} s; "
                "export the file again, for example as 16-bit PCM"
            )
        peak = np.abs(samples).max(initial=0.0)
        if peak > _MAX_PLAUSIBLE_SAMPLE:
            raise UserError(
                f"{path}: a sample is {peak:.0f}, but full scale is 1; divide integers by 32768,"
                " and export the file again"
            )
        read_s += len(samples) / rate_hz
        yield rate_hz, np.clip(samples, -1.0, 1.0)


def _resample(
    pieces: Iterator[tuple[int, Samples]], rate_hz: int, num_channels: int
) -> Iterator[Samples]:
    """Resample chunks with another rate. The rate may change between chunks."""
    resampler: Any = None
    piece_rate_hz = rate_hz
    end = np.zeros((0, num_channels), np.float32)
    for new_rate_hz, samples in pieces:
        if new_rate_hz != piece_rate_hz:
            if resampler is not None:
                yield resampler.resample_chunk(end, last=True)
            piece_rate_hz, resampler = new_rate_hz, None
            if new_rate_hz != rate_hz:
                resampler = soxr.ResampleStream(new_rate_hz, rate_hz, num_channels, dtype="float32")
        yield samples if resampler is None else resampler.resample_chunk(samples)
    if resampler is not None:
        yield resampler.resample_chunk(end, last=True)


def _cut_off_warnings(path: str, read_s: float, stated_s: float) -> list[str]:
    """Return a warning if a file is shorter than its header states."""
    if stated_s - read_s < _MIN_MISSING_S:
        return []
    return [f"{path}: the file is cut off after {read_s:.1f} s of {stated_s:.1f} s"]
