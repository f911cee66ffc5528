"""Track the lips in a video: a clip with audio and lip motion, but without images."""

import csv
import io
import json
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import soundfile

from kouxing.corpora.face_mesh import FaceMesh
from kouxing.services.driver import picture
from kouxing.services.mono_audio import read_mono_16k
from kouxing.services.mouth_profiles.face_landmarks import LANDMARKS, compute_mouth_faps
from kouxing.services.mouth_profiles.landmark_file import MIN_FRAMES
from kouxing.services.mouth_profiles.lip_tracks import measure_levels
from kouxing.shared.arrays import Doubles, Floats, UInt8
from kouxing.shared.audio.audio_file import MAX_FILE_BYTES, check_video
from kouxing.shared.audio.media_file import OPTIONS, start_of
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import plural
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS
from kouxing.shared.files.output_file import open_output
from kouxing.shared.files.user_file import check_content, open_file

MAX_DURATION_S = 1200.0
MAX_SIDE_PX = 960  # larger images are reduced


def read_video(
    path: Path, on_image: Callable[[float, UInt8], None], track: int | None = None
) -> Floats:
    """Read a video of any format that FFmpeg supports; return the audio, 16 kHz mono, (n,).

    ``on_image`` is called with each image: its time in the audio, seconds, and upright RGB,
    (height, width, 3). ``track`` is the audio track, from 1. Raises ``UserError`` if the video
    cannot be read, has no images or no audio, or is too long.
    """
    check_video(path)
    with (
        open_file(path, MAX_FILE_BYTES) as file,
        check_content(path, "a video"),
        av.open(file, mode="r", options=OPTIONS, metadata_errors="replace") as video,
    ):
        video.streams.video[0].codec_context.options = {"max_pixels": str(picture.MAX_PIXELS)}
        _decode(path, video, on_image)
    return read_mono_16k(path, track)


def _decode(
    path: Path,
    container: av.container.InputContainer,
    on_image: Callable[[float, UInt8], None],
) -> None:
    start_s = start_of(container) or 0.0
    for frame in container.decode(video=0):
        if frame.time is None or frame.time < start_s:
            continue
        time_s = frame.time - start_s
        if time_s > MAX_DURATION_S:
            raise UserError(
                f"{path}: the video is longer than {MAX_DURATION_S / 60:g} minutes; shorten it"
            )
        on_image(time_s, _image_of(frame))


def _image_of(frame: av.VideoFrame) -> UInt8:
    scale = min(1.0, MAX_SIDE_PX / max(frame.width, frame.height))
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (frame.width, frame.height))
    pixels = frame.to_ndarray(format="rgb24", width=width, height=height)
    return np.rot90(pixels, round(frame.rotation / 90))  # phones store rotated images


def track_video(video: Path, clip: Path, audio_track: int | None) -> tuple[int, int]:
    """Write the clip of a video as ``.flac``, ``.csv`` and ``.json``.

    Returns the number of images with a face, and of all images. Raises ``UserError`` if the video
    cannot be read, or a face is rarely visible.
    """
    mesh = FaceMesh()
    times: list[float] = []
    landmarks_by_image: list[Floats | None] = []

    def track_image(time_s: float, image: UInt8) -> None:
        landmarks = mesh.track(image)
        times.append(time_s)
        landmarks_by_image.append(None if landmarks is None else landmarks[list(LANDMARKS)])

    samples = read_video(video, track_image, audio_track)
    has_face = np.array([landmarks is not None for landmarks in landmarks_by_image])
    if has_face.sum() < MIN_FRAMES:
        raise UserError(
            f"{video}: a face was found in only {plural(has_face.sum(), 'image')}; film the face "
            "from the front in good light, for 20 s or more"
        )
    time_s = np.array(times)
    faps = np.full((len(has_face), len(MOUTH_FAPS)), np.nan)
    levels = np.array(measure_levels(samples))
    landmarks = np.stack([points for points in landmarks_by_image if points is not None])
    faps[has_face] = compute_mouth_faps(
        landmarks, np.interp(time_s[has_face], levels[:, 0], levels[:, 1])
    )
    metadata = {
        "clip": clip.stem,
        "kind": "tracked video (MediaPipe face mesh)",
        "license": "",
        "speaker": clip.stem,
        "language": "",
        "transcript": "",
        "frames": len(has_face),
        "frames_ok": int(has_face.sum()),
    }
    with (  # older files are replaced together, so all belong to one recording
        open_output(clip.with_suffix(".json")) as json_file,
        open_output(clip.with_suffix(".csv")) as csv_file,
        open_output(clip.with_suffix(".flac")) as audio_file,
    ):
        soundfile.write(audio_file, samples, MEDIA_RATE_HZ, format="FLAC")
        csv_file.write(_format_tracks(time_s, faps).encode())
        json_file.write(f"{json.dumps(metadata, indent=1)}\n".encode())
    return int(has_face.sum()), len(has_face)


def _format_tracks(time_s: Doubles, faps: Doubles) -> str:
    columns = [index for index in range(faps.shape[1]) if not np.isnan(faps[:, index]).all()]
    names = [f"F{MOUTH_FAPS[index]}_{FAPS[MOUTH_FAPS[index] - 1].name}" for index in columns]
    table = io.StringIO()
    writer = csv.writer(table)
    writer.writerow(["t", "ok", *names])
    for time, row in zip(time_s, faps[:, columns], strict=True):
        is_seen = not np.isnan(row).any()
        values = [f"{value:.1f}" if is_seen else "" for value in row]
        writer.writerow([f"{time:.4f}", int(is_seen), *values])
    return table.getvalue()
