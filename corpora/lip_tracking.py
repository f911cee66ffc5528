"""Track the lips in a video: a clip with audio and lip motion, but without images."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from kouxing.corpora.face_mesh import FaceMesh
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ
from kouxing.corpora.video_file import read_video
from kouxing.services.mouth_profiles.face_landmarks import LANDMARKS, mouth_faps
from kouxing.services.mouth_profiles.landmark_file import MIN_FRAMES
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS


def track_video(video: Path, clip: Path) -> tuple[int, int]:
    """Write the clip of a video as ``.flac``, ``.csv`` and ``.json``.

    Returns the number of images with a face, and of all images. Raises UserError if the video
    cannot be read, or a face is rarely visible.
    """
    mesh = FaceMesh()
    times: list[float] = []
    tracked: list[NDArray[np.float32] | None] = []

    def track_image(time_s: float, image: NDArray[np.uint8]) -> None:
        landmarks = mesh.track(image)
        times.append(time_s)
        tracked.append(None if landmarks is None else landmarks[list(LANDMARKS)])

    samples = read_video(video, track_image)
    seen = np.array([landmarks is not None for landmarks in tracked])
    if seen.sum() < MIN_FRAMES:
        raise UserError(
            f"{video}: a face was found in only {seen.sum()} images; film it from the front in "
            "good light, for 20 s or more"
        )
    time_s = np.array(times)
    faps = np.full((len(seen), len(MOUTH_FAPS)), np.nan)
    levels = np.array(level_track(samples))
    landmarks = np.stack([one for one in tracked if one is not None])
    faps[seen] = mouth_faps(landmarks, np.interp(time_s[seen], levels[:, 0], levels[:, 1]))
    soundfile.write(clip.with_suffix(".flac"), samples, SAMPLE_RATE_HZ)
    _write_tracks(clip.with_suffix(".csv"), time_s, faps)
    about = {
        "clip": clip.stem,
        "kind": "tracked video (MediaPipe face mesh)",
        "licence": "",
        "speaker": clip.stem,
        "language": "",
        "transcript": "",
        "frames": len(seen),
        "frames_ok": int(seen.sum()),
    }
    clip.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return int(seen.sum()), len(seen)


def _write_tracks(path: Path, time_s: NDArray[np.float64], faps: NDArray[np.float64]) -> None:
    columns = [index for index in range(faps.shape[1]) if not np.isnan(faps[:, index]).all()]
    names = [f"F{MOUTH_FAPS[index]}_{FAPS[MOUTH_FAPS[index] - 1].name}" for index in columns]
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["t", "ok", *names])
        for time, row in zip(time_s, faps[:, columns], strict=True):
            is_seen = not np.isnan(row).any()
            values = [f"{value:.1f}" if is_seen else "" for value in row]
            writer.writerow([f"{time:.4f}", int(is_seen), *values])
