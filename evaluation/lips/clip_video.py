"""A video of a tracked clip: the face of each lip model, next to a face with the tracked lips."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.evaluation.lips.schemes import FRAME_RATE_HZ, live_frames
from kouxing.services.driver.config import Framing
from kouxing.services.driver.render import scene
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.side_by_side import SideBySide
from kouxing.services.driver.video import film
from kouxing.services.driver.video.writer import check_name
from kouxing.services.lip_models import lip_models
from kouxing.services.live_chain import sound_events
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

_FACE_PX = (480, 360)
_IMAGES_PER_S = 25.0
_INNER_FAPS = dict(zip(range(51, 61), range(4, 14), strict=True))  # by the FAP of the outer contour


def film_clip(folder: Path, name: str, output: Path) -> None:
    """Write a video with sound of every lip model and of the tracked lips.

    Raises
    ------
    UserError
        If the clip does not exist, or the video cannot be written.
    """
    check_name(output)
    clip = next((clip for clip in read_clips(folder, language=None) if clip.name == name), None)
    if clip is None:
        raise UserError(f"no clip is named {name} in {folder}")
    model = load_live_model()
    faces = []
    for lips in lip_models():
        delay_s = SynthesizerConfig(lips=lips).delay_ms / 1e3
        events = sound_events(model, clip.samples, lip_predictor_for(model), delay_s)
        faces.append(live_frames(load_lip_model(name=lips), events, delay_s, FRAME_RATE_HZ))
    times_s = np.arange(len(faces[0])) / FRAME_RATE_HZ
    faces.append(tracked_frames(clip, times_s))
    frames = list(zip(times_s, np.stack(faces, axis=1).astype(np.float32), strict=True))
    captions = [*(f"lips: {lips}" for lips in lip_models()), "tracked lips"]
    head = scene.load_head()
    camera = scene.camera(head, Framing.MOUTH)
    renderer = SideBySide(Renderer(head, *_FACE_PX, camera=camera), captions)
    film.render_video(frames, output, renderer, frame_rate_hz=_IMAGES_PER_S, samples=clip.samples)
    renderer.close()


def tracked_frames(clip: LipClip, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the tracked mouth at the given times, FAPs (n, 68).

    If the outer contour was not measured, it follows the inner one.
    """
    faps = np.zeros((len(times_s), NUM_FAPS))
    for fap, curve in zip(MOUTH_FAPS, clip.faps.T, strict=True):
        is_known = np.isfinite(curve)
        if is_known.any():
            faps[:, fap - 1] = np.interp(times_s, clip.time_s[is_known], curve[is_known])
        elif fap in _INNER_FAPS:
            faps[:, fap - 1] = faps[:, _INNER_FAPS[fap] - 1]
    return faps
