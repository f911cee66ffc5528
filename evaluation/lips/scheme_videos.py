"""Videos of the four schemes, for a listening test."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.four_schemes import (
    ALIGNED,
    Condition,
    RecognizedSentence,
    RecognizerSetup,
    all_conditions,
    make_frames,
)
from kouxing.evaluation.lips.other_programs import FapsFunction, load_program_faps
from kouxing.services.driver.config import Framing
from kouxing.services.driver.render import scene
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video import film
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import Frame
from kouxing.shared.arrays import Doubles, Floats
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.files.output_file import create_folder

VIDEO_PX = (640, 640)
_IMAGES_PER_S = 25.0
_INNER_FAPS = dict(zip(range(51, 61), range(4, 14), strict=True))  # by the FAP of the outer contour
MakeFrames = Callable[[RecognizedSentence], list[Frame]]


def write_videos(
    recognized: Sequence[RecognizedSentence],
    recognizers: Sequence[RecognizerSetup],
    lips: Sequence[str],
    folder: Path,
    programs: Sequence[Path],
) -> list[Path]:
    """Write ``CONDITION/SENTENCE.mp4`` for all conditions and sentences; keep existing videos.

    A condition that is not possible for every sentence is left out, because a listening test needs
    all sentences in all conditions. ``programs`` are folders with curves of other programs, and
    each is a condition, at its best delay for these sentences. Clips with tracked lips add the
    conditions ``reference`` and ``anchor``, a mouth at rest. All mouths have an expressiveness of
    1, like the tracked one. Raises ``UserError`` if a file cannot be written, or a program's table
    cannot be used.
    """
    missing = [
        (make, sentence, path)
        for name, make in _conditions(recognized, recognizers, lips, programs)
        for sentence in recognized
        if not (path := folder / name / f"{sentence.sentence.clip.name}.mp4").exists()
    ]
    if not missing:
        return []
    head = scene.load_head()
    renderer = Renderer(head, *VIDEO_PX, camera=scene.place_camera(head, Framing.FACE))
    for make, sentence, path in track(missing, description="rendering", transient=True):
        write_video(path, make(sentence), sentence.sentence.clip.samples, renderer)
    renderer.close()
    return [path for _, _, path in missing]


def write_video(path: Path, frames: list[Frame], samples: Floats, renderer: Renderer) -> None:
    """Write a video for a listening test, with its folder; UserError if that fails."""
    create_folder(path.parent)
    film.render_video(frames, path, renderer, frame_rate_hz=_IMAGES_PER_S, samples=samples)


def _conditions(
    recognized: Sequence[RecognizedSentence],
    recognizers: Sequence[RecognizerSetup],
    lips: Sequence[str],
    programs: Sequence[Path],
) -> Iterator[tuple[str, MakeFrames]]:
    """Yield each condition's name, and the function that makes its frames."""
    is_aligned = all(sentence.aligned is not None for sentence in recognized)
    conditions = [
        condition
        for condition in all_conditions(recognizers, lips)
        if condition.scheme != ALIGNED or is_aligned
    ]
    for condition in conditions:
        yield condition.name, partial(_frames, condition)
    if not conditions:
        return
    clips = [sentence.sentence.clip for sentence in recognized]
    for program in programs:
        yield (
            program.name,
            partial(_frames_with_mouth, conditions[0], load_program_faps(program, clips)),
        )
    if all(len(clip.time_s) and clip.is_in_sync for clip in clips):
        yield "reference", partial(_frames_with_mouth, conditions[0], tracked_frames)
        yield "anchor", partial(_frames_with_mouth, conditions[0], _mouth_at_rest)


def _frames(condition: Condition, sentence: RecognizedSentence) -> list[Frame]:
    frames = make_frames(
        condition, sentence, SynthesizerConfig(lips=condition.lips, expressiveness=1.0)
    )
    assert frames is not None  # noqa: S101 - impossible conditions are left out
    return frames


def _frames_with_mouth(
    condition: Condition, mouth_of: FapsFunction, sentence: RecognizedSentence
) -> list[Frame]:
    """Replace the mouth of a condition's face; keep its blinks and head motion."""
    times_s, faps = zip(*_frames(condition, sentence), strict=True)
    frames, mouth = np.array(faps), np.array(MOUTH_FAPS) - 1
    frames[:, mouth] = mouth_of(sentence.sentence.clip, np.array(times_s))[:, mouth]
    return list(zip(times_s, frames, strict=True))


def tracked_frames(clip: LipClip, times_s: Doubles) -> Doubles:
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


def _mouth_at_rest(_clip: LipClip, times_s: Doubles) -> Doubles:
    return np.zeros((len(times_s), NUM_FAPS))
