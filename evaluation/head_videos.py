"""Videos of every built-in head for a listening test: the same minute of listening and speech."""

import contextlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.evaluation.lips.scheme_videos import VIDEO_PX, write_video
from kouxing.services.driver.render import scene
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.heads import HEAD_NAMES
from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.mono_audio import read_mono_16k
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import CONSOLE
from kouxing.shared.errors import UserError

_LENGTH_S = 60.0
_MIN_PAUSE_S = 0.6  # long enough for the face to finish a phrase


def write_head_videos(folder: Path, model: AcousticModel, recordings: Sequence[Path]) -> None:
    """Write ``HEAD/minute.mp4`` for each built-in head, with the frames of the live services.

    Raises ``UserError`` if a file cannot be read or written, or the recordings are too long.
    """
    loaded = {name: scene.load_head(name) for name in HEAD_NAMES}
    samples = join_recordings([read_mono_16k(path) for path in recordings])
    pipeline = LivePipeline(model, load_lip_model(model.inventory.language))
    show = partial(track, description="recognizing", console=CONSOLE, transient=True)
    frames = pipeline.animate(samples, show)
    for name, head in track(loaded.items(), "drawing", console=CONSOLE, transient=True):
        renderer = Renderer(head, *VIDEO_PX, camera=scene.place_camera(head))
        with contextlib.closing(renderer):
            write_video(folder / name / "minute.mp4", frames, samples, renderer)


def join_recordings(recordings: Sequence[Floats]) -> Floats:
    """Join recordings (n,), 16 kHz mono, to a minute with equal pauses around them.

    Raises ``UserError`` if the recordings leave no time for pauses.
    """
    length = round(_LENGTH_S * MEDIA_RATE_HZ)
    spoken = sum(map(len, recordings))
    pause = (length - spoken) // (len(recordings) + 1)
    if pause < _MIN_PAUSE_S * MEDIA_RATE_HZ:
        max_s = _LENGTH_S - _MIN_PAUSE_S * (len(recordings) + 1)
        raise UserError(
            f"the recordings last {spoken / MEDIA_RATE_HZ:.1f} s; use at most {max_s:.1f} s"
        )
    joined = np.zeros(length, np.float32)
    start = pause
    for recording in recordings:
        joined[start : start + len(recording)] = recording
        start += len(recording) + pause
    return joined
