"""Writes media files for tests."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import soundfile
from numpy.typing import NDArray

from kouxing.shared.audio.audio_file import AudioSource

SUFFIXES = {  # of each codec, for formats that soundfile cannot write
    "aac": "aac m4a mp4 flv ts latm", "libopus": "webm opus", "pcm_s16le": "avi mkv voc sf",
    "mp2": "nut mp2 wtv", "pcm_bluray": "m2ts", "ac3": "rm", "wavpack": "wv", "sbc": "sbc",
    "pcm_s32le": "sox", "adpcm_yamaha": "mmf", "pcm_s16be_planar": "ast", "adpcm_adx": "adx",
    "libopencore_amrnb": "amr", "wmav2": "wma",
}  # fmt: skip
CODECS = {suffix: codec for codec, suffixes in SUFFIXES.items() for suffix in suffixes.split()}
Part = tuple[float, NDArray[np.float32]]  # start in seconds, and samples


def write_media(
    path: Path,
    codec: str,
    samples: NDArray[np.float32],
    rate_hz: int,
    *,
    start_s: float = 0.0,
    video_s: float = 0.0,
    options: dict[str, str] | None = None,
) -> None:
    """Write mono samples, with a black video of ``video_s`` from 0 s if it is not 0."""
    write_tracks(path, codec, [[(start_s, samples)]], rate_hz, video_s=video_s, options=options)


def write_audio(path: Path, samples: NDArray[np.float32], rate_hz: int, **options: str) -> bytes:
    """Write mono samples in the format of the name's suffix; return the bytes of the file."""
    if codec := CODECS.get(path.suffix[1:]):
        write_media(path, codec, samples, rate_hz, options=options)
    else:
        soundfile.write(path, samples, rate_hz)
    return path.read_bytes()


def samples_of(source: AudioSource) -> NDArray[np.float32]:
    """Return all samples (N, channels) of a source."""
    return np.concatenate([*source.blocks])


def write_tracks(
    path: Path,
    codec: str,
    tracks: Sequence[Sequence[Part]],
    rate_hz: int,
    *,
    titles: Sequence[str] = (),
    default_track: int = 1,
    video_s: float = 0.0,
    options: dict[str, str] | None = None,
) -> None:
    """Write tracks of parts, each at its start."""
    with av.open(path, "w", options=options or {}) as container:
        if video_s:
            video = container.add_stream("mpeg4", rate=25)
            assert isinstance(video, av.VideoStream)
            video.width = video.height = 32
            video.pix_fmt = "yuv420p"
        # These encoders of FFmpeg have no default bit rate.
        encoding = {"b": "160k"} if codec in ("sbc", "wmav2", "mp2") else {}
        streams = [
            container.add_stream(codec, rate=rate_hz, layout="mono", options=encoding)
            for _ in tracks
        ]
        streams[default_track - 1].disposition = av.stream.Disposition.default
        for stream, title in zip(streams, titles, strict=False):
            stream.metadata["title"] = title
        if video_s:
            for number in range(round(video_s * 25)):
                picture = av.VideoFrame.from_ndarray(
                    np.zeros((32, 32, 3), np.uint8), format="rgb24"
                )
                picture.pts, picture.time_base = number, Fraction(1, 25)
                container.mux(video.encode(picture))
            container.mux(video.encode(None))
        for stream, parts in zip(streams, tracks, strict=True):
            assert isinstance(stream, av.AudioStream)
            for start_s, samples in parts:
                resampler = av.AudioResampler(stream.format.name, "mono", rate_hz, frame_size=960)
                frame = av.AudioFrame.from_ndarray(samples[None], format="fltp", layout="mono")
                frame.sample_rate = rate_hz
                position = round(start_s * rate_hz)
                for piece in [*resampler.resample(frame), *resampler.resample(None)]:
                    piece.pts, piece.time_base = position, Fraction(1, rate_hz)
                    position += piece.samples
                    container.mux(stream.encode(piece))
            container.mux(stream.encode(None))
