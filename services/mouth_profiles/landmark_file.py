"""Parses landmark files: tracked points of a speaking face and the audio, without images.

    4 bytes   length of the header, little endian
    header    JSON: {"times": n, "points": 43, "sample_rate_hz": 48000}
    n * 8     ascending times of the frames in the audio, seconds: float64, little endian
    n * 516   ``LANDMARKS`` of each frame, x y z in pixels, z away from the camera: float32, little
              endian
    rest      the audio: mono, signed 16 bits, little endian

A file contains only frames with a face. It may come from an untrusted source, so the parser checks
every size.
"""

import numpy as np

from kouxing.services.mouth_profiles.face_landmarks import LANDMARKS, compute_mouth_faps
from kouxing.services.mouth_profiles.learning import FilmedSpeech
from kouxing.services.mouth_profiles.lip_tracks import measure_levels, select_lip_faps
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.audio.audio_file import MAX_RATE_HZ, MIN_RATE_HZ
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import parse_json

SUFFIX = ".landmarks"
MAX_BYTES = 64 * 1024 * 1024
MIN_FRAMES = 50

_MAX_HEADER_BYTES = 1000
_MAX_PIXEL = 1e5


def parse_landmark_file(content: bytes) -> FilmedSpeech:
    """Parse a landmark file; raises ``UserError`` if it is invalid or does not show a face."""
    try:
        time_s, landmarks, samples = _parse(content)
    except ValueError as error:
        raise UserError(str(error)) from error
    levels = np.array(measure_levels(samples))
    faps = compute_mouth_faps(landmarks, np.interp(time_s, levels[:, 0], levels[:, 1]))
    return FilmedSpeech(samples=samples, frame_s=time_s, lip_track=select_lip_faps(faps))


def _parse(content: bytes) -> tuple[Doubles, Floats, Floats]:
    """Return times, landmarks and the audio at 16 kHz; ValueError if the content is invalid."""
    if len(content) > MAX_BYTES:
        raise ValueError(f"it is larger than {MAX_BYTES >> 20} MiB")
    body = 4 + int.from_bytes(content[:4], "little")
    if not 4 < body <= min(4 + _MAX_HEADER_BYTES, len(content)):
        raise ValueError("it is not a landmark file")
    header = parse_json(content[4:body])
    keys = ("times", "points", "sample_rate_hz")
    if not isinstance(header, dict) or any(type(header.get(key)) is not int for key in keys):
        raise ValueError(f"its header needs integers for {', '.join(keys)}")
    num_frames, num_points, rate_hz = (header[key] for key in keys)
    if num_points != len(LANDMARKS):
        raise ValueError(f"it has {num_points} landmarks a frame instead of {len(LANDMARKS)}")
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise ValueError(
            f"its sample rate is {rate_hz} Hz; record {MIN_RATE_HZ} to {MAX_RATE_HZ} Hz"
        )
    if num_frames < MIN_FRAMES:
        raise ValueError(f"a face is visible in only {num_frames} frames; film it for 20 s or more")
    landmarks_at = body + 8 * num_frames
    audio_at = landmarks_at + 12 * num_frames * num_points
    if audio_at >= len(content) or (len(content) - audio_at) % 2:
        raise ValueError("it is truncated, or its header is wrong")
    time_s = np.frombuffer(content[body:landmarks_at], "<f8").astype(np.float64)
    landmarks = np.frombuffer(content[landmarks_at:audio_at], "<f4").astype(np.float32)
    pcm = np.frombuffer(content[audio_at:], "<i2")
    if not np.isfinite(time_s).all() or time_s[0] < 0 or (np.diff(time_s) <= 0).any():
        raise ValueError("its times do not increase from 0")
    if not (np.abs(landmarks) <= _MAX_PIXEL).all():  # false for NaN
        raise ValueError("its landmarks are not pixels")
    samples = to_16_khz(as_floats(pcm), rate_hz)
    if len(samples) < MEDIA_RATE_HZ:
        raise ValueError("it has less than a second of audio")
    return time_s, landmarks.reshape(num_frames, num_points, 3), samples
