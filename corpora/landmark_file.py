"""Landmark files: what a camera saw of a face while it spoke, with the sound and without pictures.

    4 bytes   length of the header, little endian
    header    JSON: {"times": n, "points": 43, "sample_rate_hz": 48000}
    n * 8     times of the frames in the sound, seconds, rising: float64, little endian
    n * 516   landmarks ``corpora.face_landmarks.LANDMARKS`` of each frame, x y z in pixels, z away
              from the camera: float32, little endian
    rest      the sound: mono, signed 16 bits, little endian

Frames without a face are left out. A file may come from anybody: every size is checked.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.face_landmarks import LANDMARKS, mouth_faps
from kouxing.corpora.lip_clips import SAMPLE_RATE_HZ, LipClip, level_track
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.errors import UserError

SUFFIX = ".landmarks"
MAX_BYTES = 64 * 1024 * 1024
MIN_FRAMES = 50

_MAX_HEADER_BYTES = 1000
_SAMPLE_RATES_HZ = (8000, 48000)
_MAX_PIXEL = 1e5


def read_landmark_file(path: Path) -> LipClip:
    """Read a file as a clip of its speaker's lips.

    Raises
    ------
    UserError
        If it cannot be read, is no landmark file or shows no face.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}") from None
    try:
        time_s, landmarks, samples = _parse(content)
        levels = np.array(level_track(samples))
        faps = mouth_faps(landmarks, np.interp(time_s, levels[:, 0], levels[:, 1]))
    except (ValueError, UserError) as error:
        raise UserError(f"{path}: {error}") from error
    return LipClip(
        name=path.stem,
        speaker=path.stem,
        licence="",
        language="",
        part="train",
        is_in_sync=True,
        transcript="",
        time_s=time_s,
        faps=faps,
        samples=samples,
    )


def landmark_file(
    time_s: NDArray[np.float64],
    landmarks: NDArray[np.float32],
    pcm: NDArray[np.int16],
    sample_rate_hz: int,
) -> bytes:
    """Return the content of a file.

    Parameters
    ----------
    time_s
        Times of the frames, shape (n,).
    landmarks
        Shape (n, 43, 3).
    pcm
        Mono, shape (num_samples,).
    sample_rate_hz
        Rate of the sound.
    """
    header = json.dumps(
        {"times": len(time_s), "points": len(LANDMARKS), "sample_rate_hz": sample_rate_hz}
    ).encode()
    parts = (time_s.astype("<f8"), landmarks.astype("<f4"), pcm.astype("<i2"))
    return b"".join(
        (len(header).to_bytes(4, "little"), header, *(part.tobytes() for part in parts))
    )


def _parse(
    content: bytes,
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Return times, landmarks and the sound at 16 kHz; ValueError says what does not fit."""
    if len(content) > MAX_BYTES:
        raise ValueError(f"it is larger than {MAX_BYTES >> 20} MiB")
    body = 4 + int.from_bytes(content[:4], "little")
    if not 4 < body <= min(4 + _MAX_HEADER_BYTES, len(content)):
        raise ValueError("it is no landmark file")
    header = json.loads(content[4:body])
    keys = ("times", "points", "sample_rate_hz")
    if not isinstance(header, dict) or any(type(header.get(key)) is not int for key in keys):
        raise ValueError(f"its header must give whole numbers for {', '.join(keys)}")
    num_frames, num_points, rate_hz = (header[key] for key in keys)
    if num_points != len(LANDMARKS):
        raise ValueError(f"it has {num_points} landmarks a frame, expected {len(LANDMARKS)}")
    if not _SAMPLE_RATES_HZ[0] <= rate_hz <= _SAMPLE_RATES_HZ[1]:
        raise ValueError(f"its sound has {rate_hz} samples a second; give 8000 to 48000")
    if num_frames < MIN_FRAMES:
        raise ValueError(f"a face is seen in {num_frames} frames only; film it for 20 s or more")
    landmarks_at = body + 8 * num_frames
    sound_at = landmarks_at + 12 * num_frames * num_points
    if sound_at >= len(content) or (len(content) - sound_at) % 2:
        raise ValueError("it is cut off, or its header is wrong")
    time_s = np.frombuffer(content[body:landmarks_at], "<f8").astype(np.float64)
    landmarks = np.frombuffer(content[landmarks_at:sound_at], "<f4").astype(np.float32)
    pcm = np.frombuffer(content[sound_at:], "<i2")
    if not np.isfinite(time_s).all() or time_s[0] < 0 or (np.diff(time_s) <= 0).any():
        raise ValueError("its times do not rise from 0")
    if not (np.abs(landmarks) <= _MAX_PIXEL).all():  # NaN is not, either
        raise ValueError("its landmarks are no pixels")
    samples = to_16_khz(pcm.astype(np.float32) / np.float32(32768), rate_hz)
    if len(samples) < SAMPLE_RATE_HZ:
        raise ValueError("it has less than a second of sound")
    return time_s, landmarks.reshape(num_frames, num_points, 3), samples
