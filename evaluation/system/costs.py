"""CPU cost of a recognizer with several sessions, and of an image.

The recognizer runs without its messages. An image needs the stages of the renderer, the encoder,
and the file of the head.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kouxing.evaluation.system.live import CHUNK
from kouxing.services.driver.head.head import ASSETS, Detail, Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video.video_writer import VideoWriter
from kouxing.services.heads import DEFAULT_HEAD
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.services.recognizer.lips.lip_predictor import GruLipPredictor, load_lip_predictor
from kouxing.services.recognizer.live.recognizer import Recognizer
from kouxing.shared.arrays import Floats, UInt8
from kouxing.shared.audio.audio_file import read_audio
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.face.high_level_faps import VISEMES

MODELS = ("blocks", "light")
NUM_SESSIONS = (1, 16)
NUM_IMAGES = 60
# name, detail, size, anti-aliasing samples per pixel, whether the images are encoded (H.264)
CASES: tuple[tuple[str, Detail, tuple[int, int], int, bool], ...] = (
    ("live, coarse head, 640x480", "coarse", (640, 480), 0, False),
    ("video, fine head, 1280x720, 4x anti-aliased", "fine", (1280, 720), 4, True),
)


def measure_sessions(path: Path) -> dict[str, float]:
    """Return CPU seconds per second of sound and session, by model and sessions."""
    samples = to_16_khz(*read_audio(path))
    costs = {}
    for name in MODELS:
        model = load_model(name)
        recognizer = Recognizer(model, RecognizerConfig(acoustic=name).output_rule)
        recognizer.warm_up()
        for num in NUM_SESSIONS:
            for lips, note in ((None, ""), (load_lip_predictor(), " with lips")):
                costs[f"{name}, {num}{note}"] = _cpu_s(recognizer, lips, samples, num)
    return costs


def _cpu_s(
    recognizer: Recognizer, lips: GruLipPredictor | None, samples: Floats, num_sessions: int
) -> float:
    """Run every session once through the recording, each from another starting point."""
    streams = [recognizer.create_stream(lip_predictor=lips) for _ in range(num_sessions)]
    starts = np.arange(num_sessions) * len(samples) // num_sessions
    sounds = [np.roll(samples, -start) for start in starts]
    start_s = time.process_time()
    for start in range(0, len(samples), CHUNK):
        for stream, sound in zip(streams, sounds, strict=True):
            stream.accept_waveform(sound[start : start + CHUNK])
        recognizer.decode_streams(streams)
        for stream in streams:
            stream.take_results()
    cpu_s = time.process_time() - start_s
    return cpu_s * MEDIA_RATE_HZ / len(samples) / num_sessions


@dataclass(frozen=True, slots=True)
class RenderingCosts:
    """Figures of one run."""

    opengl: str  # renderer and version
    images_per_s: dict[str, float]  # by case, without encoding
    stages_ms: dict[str, dict[str, float]]  # median, by case and stage
    asset_bytes: int
    load_s: dict[str, float]  # by detail


def measure_images() -> RenderingCosts:
    """Render the default head with visemes, blinks and nods.

    Raises ``UserError`` if OpenGL is missing.
    """
    rates, stages = {}, {}
    load_s: dict[str, float] = {}
    opengl = ""
    for name, detail, size, samples, encoded in CASES:
        start_s = time.perf_counter()
        head = Head.load(detail=detail)
        load_s[detail] = time.perf_counter() - start_s
        renderer = Renderer(head, *size, samples=samples)
        opengl = renderer.description
        frames = [_moving_face(number) for number in range(NUM_IMAGES)]
        images = [renderer.draw(faps) for faps in frames[:10]]  # warm up
        start_s = time.perf_counter()
        for faps in frames:
            renderer.draw(faps)
        rates[name] = NUM_IMAGES / (time.perf_counter() - start_s)
        times_s = [renderer.measure_stages_s(faps) for faps in frames]
        stages[name] = {
            stage: 1e3 * float(np.median([stages_s[stage] for stages_s in times_s]))
            for stage in times_s[0]
        }
        if encoded:
            stages[name]["encode"] = _encode_ms(images)
        renderer.close()
    size_bytes = (ASSETS / f"{DEFAULT_HEAD}.npz").stat().st_size
    return RenderingCosts(opengl, rates, stages, size_bytes, load_s)


def _moving_face(number: int) -> Floats:
    """Return the FAPs (68,) of an image: one viseme after another, blinks and nods."""
    amount = np.float32(0.5 - 0.5 * np.cos(number * 0.7))
    faps: Floats = VISEMES[1 + number // 5 % 14] * amount
    faps[18:20] = 500 * amount
    faps[47] = 3000 * np.sin(number * 0.3)
    return faps


def _encode_ms(images: list[UInt8]) -> float:
    height_px, width_px = images[0].shape[:2]
    with tempfile.TemporaryDirectory() as folder:
        with VideoWriter(Path(folder) / "bench.mp4", width_px, height_px, 25.0, None) as writer:
            start_s = time.perf_counter()
            for number in range(NUM_IMAGES):
                writer.write_image(images[number % len(images)])
        return 1e3 * (time.perf_counter() - start_s) / NUM_IMAGES
