"""Decodes the audio of files and pipes with FFmpeg, at the timestamps of the container."""

import io
import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, BinaryIO, cast

import av
import numpy as np

from kouxing.shared.audio.audio_formats import (
    MAX_OGG_PAGE_BYTES,
    codec_of_padded_wav,
    is_cut_ogg,
    is_media_format,
    is_transport_stream,
    misread_wav_codec,
    read_stated_size,
    unprobed_format,
    why_unreadable,
)
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.audio.phase_cancellation import PhaseCancellationGuard, Samples
from kouxing.shared.errors import UserError
from kouxing.shared.interrupt import is_interrupted

_MAX_STREAMS = 64
_MAX_RATE_HZ = 1_000_000
OPTIONS = {"protocol_whitelist": "none"}  # no network access, and no files from playlists
# A pipe's first frame is decoded as soon as its bytes arrive.
_PIPE_OPTIONS = OPTIONS | {"probesize": "512", "formatprobesize": "8192"}
_PACKET_OPTIONS = _PIPE_OPTIONS | {"probesize": "4096"}  # with the list of tracks
_JITTER_S = 0.05  # timestamps that differ less from the number of samples are inexact
_MAX_OVERLAP_S = 1.0  # timestamps that go back further are a restart
_MAX_GAP_S = 3600.0  # a larger gap is an error in the timestamps
_MAX_GAP_OF_BROADCAST_S = 10.0  # timestamps of broadcasts may restart at any value
_PADDING_S = 1.0  # an encoder adds less silence at both ends, which a decoder may remove
_MIN_MISSING_S = 0.1  # a track that lacks more is reported as cut off
_MIN_MISSING_OF_FILE_S = 0.5  # the last image of a video may last this long
# FFmpeg guesses these from the file's name, and also guesses their rate.
_RAW_FORMATS = {"alaw", "mulaw", "s8", "u8", "s16le", "s16be", "u16le", "u16be"}
_TIMES_COUNT_FROM_ZERO = re.compile("mov|matroska")
# AVI is not in this list, because its duration includes gaps without packets.
_HEADERS_STATE_LENGTH = re.compile("mov|matroska|flac|mp3|asf|flv|caf|ape|tta|wv|au|w64")


class MediaAudio:
    """One audio track of a media file, with one or two channels.

    ``track`` counts from 1. Without a number, the default track is read, or the first track if no
    track is the default; tracks that cannot be decoded are ignored. ``name`` is the file's name
    for messages. ``blocks`` yields the sample rate and samples, (n, channels); the rate may
    change. ``warnings`` is complete after the last block.

    Raises ``UserError`` if FFmpeg cannot read the file, or it has no such track; while reading, if
    nothing can be decoded.
    """

    def __init__(
        self, file: BinaryIO, name: str, begin: bytes, track: int | None, *, is_pipe: bool
    ) -> None:
        self.warnings: list[str] = []
        self.notices: list[str] = []
        self._name = name
        self._mixers: dict[tuple[str, str, int], list[Any]] = {}
        if begin.startswith(b"RIFX"):  # FFmpeg reads its samples in the wrong byte order
            raise UserError(f"{name}: this is a big-endian WAV file; export it as wav or flac")
        if codec := misread_wav_codec(begin):
            raise UserError(f"{name}: {codec} is not supported; export the audio as 16-bit PCM")
        options = OPTIONS
        if is_pipe:
            options = _PACKET_OPTIONS if is_transport_stream(begin) else _PIPE_OPTIONS
        self._file = _GuardedFile(file, can_seek=not is_pipe)
        self._open = partial(
            av.open,
            self._file,
            mode="r",
            format=unprobed_format(begin),
            options=options,
            buffer_size=4096 if is_pipe else 65536,
            metadata_errors="replace",
        )
        try:
            self._container: Any = self._open()
        except (av.error.FFmpegError, ValueError) as error:
            self._file.check()
            raise UserError(f"{name}: {why_unreadable(begin, _reason(error))}") from None
        try:
            if self._container.format.name in _RAW_FORMATS:
                raise UserError(
                    f"{name}: the file contains samples without a header; convert it to wav with"
                    " FFmpeg, and specify their format and rate"
                )
            self._stream = self._choose(track, begin)
            self._decoder = self._stream.codec_context
            if codec := codec_of_padded_wav(begin):
                self._decoder = av.CodecContext.create(codec, "r")
                self._decoder.sample_rate = self._stream.codec_context.sample_rate
                self._decoder.layout = self._stream.codec_context.layout
            self._frames = self._decode()
            first = next(self._frames, None)
            if first is None:
                raise UserError(f"{name}: {self._why_silent()}")
        except BaseException:
            self._container.close()
            raise
        self.sample_rate_hz: int = first.sample_rate
        self.num_channels = min(2, first.layout.nb_channels)
        kind, flags = self._container.format, cast(Any, av.format.Flags)
        self._restarts = bool(kind.flags & flags.ts_discont.value)
        has_index = not kind.flags & flags.generic_index.value
        self._has_times = self._restarts or has_index or kind.name == "flac"
        self.duration_s = None if is_pipe else self._stated_s()
        self._stated_by_pipe_s = self._duration_of_pipe_s(begin) if is_pipe else None
        self.blocks = self._blocks(first)

    def is_longer_than(self, limit_s: float) -> bool:
        """Return whether the audio is longer; False if that is not known before decoding.

        If the file states a longer duration, this counts its packets, because the file may be cut
        off, and FFmpeg estimates some durations. For a pipe, the header decides.
        """
        if self._stated_by_pipe_s is not None:
            return self._stated_by_pipe_s > limit_s + _PADDING_S
        if (self.duration_s or 0.0) <= limit_s:
            return False
        place, read_s = self._file.seek(0, io.SEEK_CUR), 0.0
        self._file.seek(0)
        try:
            with self._open() as container:
                for packet in container.demux(container.streams[self._stream.index]):
                    read_s += float((packet.duration or 0) * (packet.time_base or 0))
                    if read_s > limit_s + _PADDING_S:
                        break
        except (av.error.FFmpegError, ValueError, IndexError):
            pass  # `_decode` reports the damage
        self._file.check()
        self._file.seek(place)
        return read_s > limit_s + _PADDING_S

    def _choose(self, track: int | None, begin: bytes) -> Any:
        tracks = self._container.streams.audio
        if not self._container.streams or not (tracks or is_media_format(begin)):
            raise UserError(f"{self._name}: {why_unreadable(begin, 'no audio')}")
        if not tracks or len(self._container.streams) > _MAX_STREAMS:
            kinds = {stream.type for stream in self._container.streams}
            kind = "video" if "video" in kinds else min(kinds)
            raise UserError(f"{self._name}: the file has {kind} but no audio track")
        listing = "; ".join(
            f"{number} {_describe(stream)}" for number, stream in enumerate(tracks, 1)
        )
        if track is not None and not 1 <= track <= len(tracks):
            raise UserError(f"{self._name}: there is no track {track}; the tracks are: {listing}")
        decodable = [
            number for number, stream in enumerate(tracks, 1) if stream.codec_context is not None
        ]
        default = av.stream.Disposition.default
        decodable.sort(key=lambda number: not tracks[number - 1].disposition & default)
        chosen = track or next(iter(decodable), 1)
        stream = tracks[chosen - 1]
        if stream.codec_context is None:
            raise UserError(
                f"{self._name}: the codec of audio track {chosen} is unknown; export the audio as"
                " wav, flac, mp3 or m4a"
            )
        if len(tracks) > 1 and track is None:
            self.notices.append(
                f"{self._name}: {len(tracks)} audio tracks: {listing}. This reads track {chosen};"
                " choose another with --track"
            )
        return stream

    def _decode(self) -> Iterator[Any]:
        """Yield the frames of the track. Like FFmpeg, skip damaged packets."""
        self._read_end_s = self._track_end_s = 0.0  # end of all tracks, and of this one
        self._first_place: int | None = None  # position of the first packet in the file, bytes
        self._num_damaged = 0
        self._is_stopped = False  # the rest cannot be read
        self._damaged_s = 0.0  # time of the first damaged packet
        self._is_encrypted = _tag(self._stream) == "drms"
        packets = self._container.demux()
        while True:
            try:
                packet = next(packets, None)
            except (av.error.FFmpegError, ValueError, IndexError):  # index of a new stream
                self._file.check()
                self._on_damage(self._read_end_s)
                self._is_stopped = True
                return
            self._file.check()
            if packet is None:
                return
            end_s = _end_s(packet)
            self._read_end_s = max(self._read_end_s, end_s)
            if packet.stream is not self._stream:
                continue
            if self._first_place is None:
                self._first_place = packet.pos
            self._is_encrypted |= packet.has_sidedata("encryption_info")
            if self._is_encrypted:
                return
            try:
                frames = self._decoder.decode(packet)
            except (av.error.FFmpegError, ValueError):
                self._on_damage(end_s)
                continue
            self._track_end_s = max(self._track_end_s, end_s)
            yield from frames

    def _on_damage(self, place_s: float) -> None:
        if self._num_damaged == 0:
            self._damaged_s = place_s
        self._num_damaged += 1

    def _why_silent(self) -> str:
        if self._is_encrypted:
            return "the audio is encrypted (DRM); use a copy without protection"
        if self._num_damaged:
            return "the audio is damaged or encrypted; nothing can be decoded; export it again"
        return "the file contains no samples; record it again"

    def _blocks(self, first: Any) -> Iterator[tuple[int, Samples]]:
        """Yield the samples, with silence in gaps."""
        start_s = start_of(self._container)
        origin_s = (first.time or 0.0) if start_s is None else start_s
        position_s = 0.0
        guard = PhaseCancellationGuard(self._name, self.num_channels, self.warnings)
        frame: Any = first
        with self._container:
            while frame is not None:
                rate_hz = frame.sample_rate
                if not 0 < rate_hz <= _MAX_RATE_HZ:
                    raise UserError(
                        f"{self._name}: the sample rate is {rate_hz} Hz; export the audio again"
                    )
                samples = guard.mix(*self._mix(frame))
                ahead_s = 0.0
                if self._has_times and frame.time is not None:
                    ahead_s = frame.time - origin_s - position_s
                if not self._is_continuous(ahead_s):
                    origin_s += ahead_s
                elif ahead_s > _JITTER_S:
                    if self._container.format.name == "flac":  # its frames have no gaps
                        self._on_damage(position_s)
                    num_missing = round(ahead_s * rate_hz)
                    position_s += num_missing / rate_hz
                    for begin in range(0, num_missing, rate_hz):
                        size = min(rate_hz, num_missing - begin)
                        yield rate_hz, np.zeros((size, self.num_channels), np.float32)
                elif ahead_s < -_JITTER_S:
                    samples = samples[round(-ahead_s * rate_hz) :]
                position_s += len(samples) / rate_hz
                yield rate_hz, samples
                frame = next(self._frames, None)
            self._check_end(position_s)

    def _mix(self, frame: Any) -> tuple[Samples, Samples]:
        """Return all channels of a frame, and FFmpeg's mix of them if there are more than two."""
        if frame.layout.nb_channels <= 2:
            channels = _samples_of(frame)
            return channels, channels
        kind = (frame.layout.name, frame.format.name, frame.sample_rate)
        if kind not in self._mixers:  # PyAV cannot convert planes of eight channels
            layouts = (frame.layout.name, "stereo")
            self._mixers[kind] = [av.AudioResampler("flt", layout) for layout in layouts]
        mixers = self._mixers[kind]
        channels = _samples_of(mixers[0].resample(frame)[0])
        try:
            return channels, _samples_of(mixers[-1].resample(frame)[0])
        except av.error.ArgumentError:  # FFmpeg cannot mix 9 channels; the guard averages them
            del mixers[1:]
            return channels, channels

    def _is_continuous(self, ahead_s: float) -> bool:
        """Return whether a difference between timestamps and samples is a gap or an overlap."""
        if self._restarts:
            return -_JITTER_S < ahead_s < _MAX_GAP_OF_BROADCAST_S
        return -_MAX_OVERLAP_S < ahead_s < _MAX_GAP_S

    def _stated_s(self) -> float | None:
        """Return the duration from the file's header, or FFmpeg's estimate."""
        if self._container.duration is None:
            return None
        return float(self._container.duration / av.time_base)

    def _duration_of_pipe_s(self, begin: bytes) -> float:
        """Return the duration from a pipe's header; 0 if unknown."""
        if self._container.format.name not in ("wav", "w64", "aiff"):
            return self._stated_s() or 0.0
        # FFmpeg needs the size of the file, or uses a placeholder in the header.
        bytes_per_s = (self._decoder.bit_rate or 0) / 8
        return (read_stated_size(begin) or 0) / bytes_per_s if bytes_per_s else 0.0

    def _check_end(self, read_s: float) -> None:
        """Warn about damage, and about a file that ends before its header states."""
        stream, stated_s, end_s = self._stream, self._stated_s(), self._read_end_s
        min_missing_s = _MIN_MISSING_OF_FILE_S
        if stream.duration is not None and stream.time_base is not None:
            stated_s = float(((stream.start_time or 0) + stream.duration) * stream.time_base)
            end_s, min_missing_s = self._track_end_s, _MIN_MISSING_S
        missing_s = 0.0 if stated_s is None else stated_s - end_s
        if missing_s > min_missing_s and self._states_length():
            self.warnings.append(
                f"{self._name}: the file is cut off after {read_s:.1f} s of"
                f" {read_s + missing_s:.1f} s"
            )
        elif self._container.format.name == "ogg" and is_cut_ogg(self._file.end):
            self.warnings.append(f"{self._name}: the file is cut off after {read_s:.1f} s")
        elif self._is_stopped:
            self.warnings.append(
                f"{self._name}: the file cannot be read after {read_s:.1f} s; export it again"
            )
        elif self._num_damaged and self._damaged_s < end_s:
            self.warnings.append(
                f"{self._name}: damaged near {self._damaged_s:.1f} s; the damaged part is silent"
            )

    def _states_length(self) -> bool:
        """Return whether the duration is stated in a header, not estimated from the file's size."""
        container = self._container
        if not _HEADERS_STATE_LENGTH.match(container.format.name):
            return False
        bit_rate = sum(
            stream.bit_rate or 0
            for stream in container.streams
            if stream.type in ("audio", "video")
        )
        estimated_bytes = bit_rate * (self._stated_s() or 0) / 8
        sizes = (container.size, container.size - (self._first_place or 0))
        return all(abs(estimated_bytes - size) > 0.002 * size for size in sizes)


def start_of(container: Any) -> float | None:
    """Return the timestamp at the start of a file, seconds; None if unknown."""
    start_s = None if container.start_time is None else container.start_time / av.time_base
    if _TIMES_COUNT_FROM_ZERO.match(container.format.name):
        return min(0.0, start_s or 0.0)
    return start_s


def has_video(file: BinaryIO, name: str, begin: bytes) -> bool:
    """Return whether a media file has moving images and audio.

    Raises ``UserError`` if FFmpeg cannot read it.
    """
    try:
        with av.open(file, mode="r", options=OPTIONS, metadata_errors="replace") as container:
            cover = av.stream.Disposition.attached_pic
            videos = container.streams.video
            has_images = any(not stream.disposition & cover for stream in videos)
            return bool(has_images and container.streams.audio)
    except (av.error.FFmpegError, ValueError) as error:
        raise UserError(f"{name}: {why_unreadable(begin, _reason(error))}") from None


class _GuardedFile:
    """A file that keeps exceptions such as Ctrl-C for later.

    FFmpeg would treat them as the end of the file.
    """

    def __init__(self, file: BinaryIO, *, can_seek: bool) -> None:
        self.name = str(getattr(file, "name", ""))
        self.end = b""  # the bytes that were read last
        self._failure: BaseException | None = None
        self._read = file.read
        self.read = partial(self._call, self._read)
        if can_seek:
            self.seek, self.tell = partial(self._call, file.seek), partial(self._call, file.tell)

    def check(self) -> None:
        """Raise the exception, if any; raises ``UserError`` if the system cannot read the file."""
        if is_interrupted():
            raise KeyboardInterrupt
        if isinstance(self._failure, OSError):
            raise UserError(f"{self.name}: cannot be read to the end: {self._failure.strerror}")
        if self._failure is not None:
            raise self._failure

    def _call(self, function: Callable[..., Any], *arguments: int) -> Any:
        if self._failure is None:
            try:
                result = function(*arguments)
                if function is self._read:
                    self.end = (self.end + result)[-MAX_OGG_PAGE_BYTES:]
                return result
            except BaseException as failure:
                self._failure = failure
        return b"" if function is self._read else -1


def _describe(stream: Any) -> str:
    """Describe a track, so that a user recognizes it."""
    title = stream.metadata.get("title") or stream.metadata.get("handler_name") or ""
    parts = [f"'{title}'" if title not in ("", "SoundHandler", "Core Media Audio") else ""]
    parts.append(language if (language := stream.metadata.get("language")) != "und" else "")
    if (codec := stream.codec_context) is not None:
        parts += [f"({codec.name}, {codec.sample_rate} Hz, {codec.channels} ch)"]
    return " ".join(filter(None, parts))


def _tag(stream: Any) -> str:
    try:
        return str(stream.codec_context.codec_tag)
    except UnicodeDecodeError:  # it is a number
        return ""


def _end_s(packet: Any) -> float:
    if packet.pts is None or packet.time_base is None:
        return 0.0
    return float((packet.pts + (packet.duration or 0)) * packet.time_base)


def _samples_of(frame: Any) -> Samples:
    """Return a frame's samples as (n, channels), with full scale at 1."""
    samples = as_floats(frame.to_ndarray())
    return samples.T if frame.format.is_planar else samples.reshape(-1, frame.layout.nb_channels)


def _reason(error: Exception) -> str:
    return getattr(error, "strerror", None) or str(error)
