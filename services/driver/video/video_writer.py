"""Writes images with audio in sync (MP4, MOV, WebM) or only images (WebP, PNG files).

Picture ``n`` is shown at ``n / frame_rate_hz`` and audio sample ``n`` is played at
``n / sample_rate_hz``, both from the start of the file.

======================  ====================================  ==============================
file                    opaque                                with a transparent background
======================  ====================================  ==============================
``.mp4``                H.264 and AAC                         not possible
``.mov``                H.264 and AAC                         ProRes 4444 and AAC
``.webm``               VP9 and Opus                          VP9 with alpha and Opus
``.webp``               WebP, loops forever, no audio         WebP with alpha, no audio
folder, ``name%05d``    PNG, no audio                         PNG with alpha, no audio
======================  ====================================  ==============================
"""

from __future__ import annotations

import contextlib
import errno
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace

from kouxing.services.driver import picture
from kouxing.shared.arrays import Floats, UInt8
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import (
    UnfinishedFile,
    open_output,
    remove_unfinished,
    write_error,
)

VIDEO_SUFFIXES = (".mp4", ".mov", ".webm", ".webp")
_NUMBER_FIELD = re.compile(r"%0?\d?d")  # in the file name of a picture sequence


@dataclass(frozen=True, slots=True)
class _Codec:
    """Encoder settings of pictures."""

    name: str
    pixel_format: str
    options: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class _Format:
    """Container and codecs of a file suffix."""

    opaque: _Codec
    transparent: _Codec | None
    audio_codec: str | None
    options: dict[str, str] = field(default_factory=dict)  # options of the container


# visually lossless
_H264 = _Codec("libx264", "yuv420p", {"crf": "18", "preset": "veryfast"})
_PRORES = _Codec("prores_ks", "yuva444p10le", {"profile": "4444"})
_VP9_OPTIONS = {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "6"}
_VP9 = _Codec("libvpx-vp9", "yuv420p", _VP9_OPTIONS)
_VP9_ALPHA = _Codec("libvpx-vp9", "yuva420p", _VP9_OPTIONS)
# lower quality leaves traces of motion
_WEBP = _Codec("libwebp_anim", "bgra", {"quality": "80"})
_INDEX_FIRST = {"movflags": "faststart"}
_LOOP_FOREVER = {"loop": "0"}
_FORMATS = {
    ".mp4": _Format(_H264, None, "aac", _INDEX_FIRST),
    ".mov": _Format(_H264, _PRORES, "aac", _INDEX_FIRST),
    ".webm": _Format(_VP9, _VP9_ALPHA, "libopus"),
    ".webp": _Format(_WEBP, _WEBP, None, _LOOP_FOREVER),
}


def open_writer(
    path: Path,
    size: tuple[int, int],
    frame_rate_hz: float,
    sample_rate_hz: int | None,
    *,
    transparent: bool = False,
    overwrite: bool = True,
) -> VideoWriter | PictureSequence:
    """Open a writer for a path: a video, or pictures in a folder or named like ``name%05d.png``.

    For the parameters, see ``VideoWriter``. Pictures are always overwritten.

    Raises ``UserError`` if the path is not a valid output, or cannot be written.
    """
    check_name(path)
    if path.suffix.lower() in _FORMATS:
        return VideoWriter(
            path, *size, frame_rate_hz, sample_rate_hz,
            transparent=transparent, overwrite=overwrite,
        )  # fmt: skip
    return PictureSequence(path)


def check_name(path: Path) -> None:
    """Raise ``UserError`` if a path is not a valid output in an existing folder."""
    if path.suffix.lower() not in _FORMATS and (
        not is_sequence(path) or len(_NUMBER_FIELD.findall(path.name)) > 1
    ):
        raise UserError(
            f"{path}: use a name that ends in {', '.join(VIDEO_SUFFIXES)}, a folder,"
            " or a name with one number such as face%05d.png"
        )
    if not path.parent.is_dir():
        raise write_error(path, FileNotFoundError())


def is_sequence(path: Path) -> bool:
    """Return whether a path names a sequence of pictures, one per frame."""
    if path.suffix.lower() == ".png":
        return _NUMBER_FIELD.search(path.name) is not None
    return path.is_dir() or not path.suffix


def picture_name(path: Path, number: int) -> Path:
    """Return the file of a picture in a sequence: a folder, or a name such as ``face%05d.png``."""
    numbered = _numbered(path)
    name = _NUMBER_FIELD.sub(lambda match: match[0] % number, numbered.name, count=1)
    return numbered.with_name(name)


def existing_pictures(path: Path) -> list[Path]:
    """Return the existing files of a sequence, in the order of their names."""
    numbered = _numbered(path)
    before, after = _NUMBER_FIELD.split(numbered.name, maxsplit=1)
    name = re.compile(f"{re.escape(before)} *([0-9]+){re.escape(after)}")
    files = sorted(numbered.parent.iterdir()) if numbered.parent.is_dir() else []
    matches = [(file, match) for file in files if (match := name.fullmatch(file.name))]
    return [file for file, match in matches if picture_name(path, int(match[1])) == file]


def _numbered(path: Path) -> Path:
    """Return the path of a sequence's pictures, with a field for the number."""
    return path if path.suffix.lower() == ".png" else path / "%05d.png"


class VideoWriter:
    """A video that appears under its name when it is complete.

    Width and height are even, the frame rate is 1 to 1000 Hz. ``sample_rate_hz`` is the rate of the
    audio, or None for no audio; ``.webp`` never has audio. Pictures are ``transparent`` if they
    have an alpha channel. Unless ``overwrite`` is set, ``close`` adds a number to the name of an
    existing file.

    Raises ``UserError`` if the file cannot be written, or cannot be transparent.
    """

    def __init__(
        self,
        path: str | Path,
        width_px: int,
        height_px: int,
        frame_rate_hz: float,
        sample_rate_hz: int | None,
        *,
        transparent: bool = False,
        overwrite: bool = True,
    ) -> None:
        self._path = Path(path)
        self._overwrite = overwrite
        suffix = self._path.suffix.lower()
        file_format = _FORMATS.get(suffix, _FORMATS[".mp4"])
        codec = file_format.transparent if transparent else file_format.opaque
        if codec is None:
            raise UserError(
                f"{self._path}: MP4 cannot be transparent; write .mov, .webm or pictures (a folder)"
            )
        audio_codec = None if sample_rate_hz is None else file_format.audio_codec
        self._shape = (height_px, width_px, 4 if transparent else 3)
        self._sample_rate_hz = sample_rate_hz
        self._num_images = self._num_samples = 0
        try:
            if self._path.exists() and not self._path.is_file():
                kind = "folder" if self._path.is_dir() else "pipe or device"
                raise OSError(errno.EINVAL, f"it is a {kind}; use another name")
            remove_unfinished(self._path.parent)
            self._unfinished = UnfinishedFile(self._path)
            container = suffix.removeprefix(".") or "mp4"
            self._container = av.open(
                str(self._unfinished.path), "w", format=container, options=file_format.options
            )
        except OSError as error:
            raise write_error(self._path, error) from error
        rate = Fraction(frame_rate_hz).limit_denominator(1001)
        video: Any = self._container.add_stream(codec.name, rate=rate, options=codec.options)
        self._video = video
        self._video.width, self._video.height = width_px, height_px
        self._video.pix_fmt = codec.pixel_format
        context: Any = self._video.codec_context
        context.time_base = 1 / rate
        context.thread_count = 1
        # players guess the color space of a file from its size unless the file states it
        context.color_primaries = context.color_trc = context.colorspace = Colorspace.ITU709
        context.color_range = ColorRange.MPEG
        self._audio: Any = None
        if audio_codec is not None:
            self._audio = self._container.add_stream(
                audio_codec, rate=sample_rate_hz, layout="mono"
            )
            self._sample_format = "fltp" if audio_codec == "aac" else "flt"

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def write_image(self, image: UInt8) -> None:
        """Append a picture (H, W, 3), or (H, W, 4) if the video is transparent; sRGB."""
        if image.shape != self._shape:
            raise ValueError(f"expected a picture of shape {self._shape}, got {image.shape}")
        kind = "rgba" if image.shape[2] == 4 else "rgb24"
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format=kind)
        frame = frame.reformat(
            format=self._video.pix_fmt,
            dst_colorspace=Colorspace.ITU709,
            dst_color_range=ColorRange.MPEG,
        )
        frame.pts = self._num_images
        frame.time_base = self._video.codec_context.time_base
        self._num_images += 1
        self._encode(self._video, frame)

    def write_audio(self, samples: Floats) -> None:
        """Append mono audio (N,), -1 to 1."""
        if not len(samples) or self._audio is None:
            return
        block = np.ascontiguousarray(samples, dtype=np.float32)[None, :]
        frame = av.AudioFrame.from_ndarray(block, format=self._sample_format, layout="mono")
        frame.sample_rate = self._sample_rate_hz or 0
        frame.pts = self._num_samples
        frame.time_base = Fraction(1, self._sample_rate_hz or 1)
        self._num_samples += len(samples)
        self._encode(self._audio, frame)

    def _encode(self, stream: Any, frame: Any) -> None:
        with self._discards_on_error():
            self._container.mux(stream.encode(frame))

    @contextlib.contextmanager
    def _discards_on_error(self) -> Iterator[None]:
        try:
            yield
        except (OSError, av.FFmpegError) as error:
            self.discard()
            raise write_error(self._path, error) from error

    def close(self) -> Path:
        """Finish the file under its final name; return its path."""
        self._encode(self._video, None)
        if self._num_samples:
            self._encode(self._audio, None)
        with self._discards_on_error():
            self._container.close()
            path = self._path if self._overwrite else _create_unique(self._path)
            self._unfinished.path.replace(path)
        self._unfinished.delete()
        return path

    def discard(self) -> None:
        """Delete the unfinished file."""
        with contextlib.suppress(OSError, av.FFmpegError):
            self._container.close()
        self._unfinished.delete()


class PictureSequence:
    """One PNG file per picture; ``close`` deletes the later pictures of an older sequence.

    ``path`` is a folder for ``00000.png`` and so on, or a name such as ``face%05d.png``.

    Raises ``UserError`` if the folder cannot be created, or old pictures cannot be deleted.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._num_images = 0
        folder = _numbered(path).parent
        try:
            if folder == path:
                path.mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(path, error) from error
        remove_unfinished(folder)

    def write_image(self, image: UInt8) -> None:
        """Write a picture (H, W, 3) or (H, W, 4), sRGB."""
        path = picture_name(self._path, self._num_images)
        # a search of a folder with many pictures for every picture would be slow
        with open_output(path, removes_unfinished=False) as file:
            file.write(picture.encode(image))
        self._num_images += 1

    def write_audio(self, samples: Floats) -> None:
        """Ignore the audio."""

    def close(self) -> Path:
        """Delete older pictures beyond the last one; return the folder or the name pattern."""
        written = {picture_name(self._path, number) for number in range(self._num_images)}
        try:
            for file in existing_pictures(self._path):
                if file not in written:
                    file.unlink()
        except OSError as error:
            raise write_error(self._path, error) from error
        return self._path

    def discard(self) -> None:
        """Keep the pictures written so far, and older ones."""


def write_picture(path: Path, image: UInt8) -> None:
    """Write a picture (H, W, 3), or (H, W, 4) with alpha, as PNG.

    Raises ``UserError`` if the file cannot be written.
    """
    with open_output(path) as file:
        file.write(picture.encode(image))


def _create_unique(path: Path) -> Path:
    """Create an empty file with this name or, if it exists, with the next free one; return it."""
    free, number = path, 1
    while True:
        try:
            free.touch(exist_ok=False)
        except FileExistsError:
            number += 1
            free = path.with_stem(f"{path.stem}-{number}")
        else:
            return free
