"""Videos and pictures of a sound or FAP file, without running services."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from services.cli.sound_file import read_mono_16k
from services.cli.terminal import CONSOLE, print_message
from services.driver.config import Framing
from services.driver.render import scene
from services.driver.render.renderer import Renderer
from services.driver.render.side_by_side import SideBySide
from services.driver.video import film
from services.driver.video.writer import VIDEO_SUFFIXES, check_name, is_sequence
from services.live_chain import LiveChain
from services.recognizer.acoustic.acoustic_model import AcousticModel
from services.recognizer.acoustic.load import load_model
from services.recognizer.lips import LipPredictor, lips_for
from services.recognizer.voice import read_profile
from services.synthesizer.config import SynthesizerConfig
from services.synthesizer.lips.load import load_lip_model
from shared.clock import MEDIA_RATE_HZ
from shared.errors import UserError
from shared.face.fap_file import read_fap
from shared.face.lip_models import DEFAULT_LIP_MODEL, LipModelName
from shared.phones.events import Phone

FRAME_RATE_HZ = 25.0  # of the video of a sound
MAX_FRAME_RATE_HZ = 240.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Shot:
    """How the head is shown; the fields are the options of ``kouxing render``."""

    head: str
    size: str
    background: str
    camera: Framing
    yaw_deg: float
    pitch_deg: float


@dataclass(frozen=True, slots=True)
class _Animation:
    """What is rendered."""

    frames: list[film.Frame]
    frame_rate_hz: float
    samples: NDArray[np.float32] | None  # 16 kHz mono, shape (n,)
    num_phones: int | None = None  # None: the source is no sound


def render_file(
    source: Path,
    output: Path,
    shot: Shot,
    *,
    lips: Sequence[LipModelName] | None = None,
    rate_hz: float | None = None,
    sound: Path | None = None,
    at_s: float | None = None,
    voice: Path | None = None,
    expressiveness: float | None = None,
) -> None:
    """Make a video, one picture or a picture for every image.

    Parameters
    ----------
    source
        A sound, or a ``.fap`` file.
    output
        Its name tells what is made.
    lips
        Lip models for a sound, each with a face of its own beside the others; None: the default.
    rate_hz
        Images per second; None: as the source has.
    sound
        Sound for a ``.fap`` file.
    at_s
        Time of the one picture.
    voice
        The voice of who speaks in a sound, for learnt lips.
    expressiveness
        How large the mouth's movements are for a sound, 0.5 to 2; None: the default.

    Raises
    ------
    UserError
        If a file cannot be read or written, or options do not fit each other.
    """
    is_picture = output.suffix == ".png" and not is_sequence(output)
    if at_s is not None and not is_picture:
        raise UserError("--at says when one picture is taken; give the name of one (.png)")
    if sound is not None and not _is_fap(source):
        raise UserError(f"--sound is for a .fap file; {source} brings its own")
    if lips and _is_fap(source):
        raise UserError(f"--lips is for a sound; {source} holds the motion of its lips")
    if voice is not None and _is_fap(source):
        raise UserError(f"--voice is for a sound; {source} holds the motion of its lips")
    if expressiveness is not None and _is_fap(source):
        raise UserError(f"--expressiveness is for a sound; {source} holds the motion of its lips")
    if not is_picture:
        check_name(output)
    lips = lips or [DEFAULT_LIP_MODEL]
    renderer = _make_renderer(shot, output, lips)
    with Progress(console=CONSOLE, transient=True) as progress:
        if _is_fap(source):
            animation = _read_animation(source, sound)
        else:
            animation = _animate(source, lips, voice, expressiveness, progress)
        if not animation.frames:
            raise UserError(f"{source}: it has no frames")
        if is_picture:
            film.render_picture(animation.frames, output, renderer, at_s or 0.0)
            num_images = 1
        else:
            drawing = progress.add_task("drawing", total=1.0)
            num_images = film.render_video(
                animation.frames,
                output,
                renderer,
                frame_rate_hz=rate_hz or animation.frame_rate_hz,
                samples=animation.samples,
                on_progress=lambda share: progress.update(drawing, completed=share),
            )
    renderer.close()
    if animation.num_phones == 0:
        print_message(f"{source}: no speech was found; the mouth stays closed")
    images = "1 image" if num_images == 1 else f"{num_images} images"
    phones = "" if animation.num_phones is None else f", {animation.num_phones} phones"
    print_message(f"wrote {output}: {images}{phones}")


def _is_fap(source: Path) -> bool:
    return source.suffix.lower() == ".fap"


def _make_renderer(shot: Shot, output: Path, lips: Sequence[str]) -> Renderer | SideBySide:
    width_px, height_px = _parse_size(shot.size, even=output.suffix in VIDEO_SUFFIXES)
    if width_px % len(lips):
        raise UserError(f"--size {shot.size}: {len(lips)} faces need a width that they can share")
    background = scene.background(shot.background)
    if background is None and output.suffix == ".mp4":
        raise UserError("MP4 has no transparency; write .mov, .webm, or pictures (.png)")
    head = scene.load_head(shot.head)
    camera = scene.camera(head, shot.camera, shot.yaw_deg, shot.pitch_deg)
    renderer = Renderer(
        head, width_px // len(lips), height_px, background=background, camera=camera
    )
    return renderer if len(lips) == 1 else SideBySide(renderer, [f"lips: {name}" for name in lips])


def _read_animation(source: Path, sound: Path | None) -> _Animation:
    animation = read_fap(source)
    return _Animation(
        film.frames_of(animation),
        min(animation.frame_rate_hz, MAX_FRAME_RATE_HZ),
        None if sound is None else read_mono_16k(sound),
    )


def _animate(
    source: Path,
    lips: Sequence[LipModelName],
    voice: Path | None,
    expressiveness: float | None,
    progress: Progress,
) -> _Animation:
    """Make the frames that the services, by their defaults, would make of a sound."""
    samples = read_mono_16k(source)
    task = progress.add_task("recognising", total=len(lips) * len(samples))
    model = load_model()
    lips_from_sound = _lips_of(model, voice)
    faces: list[list[film.Frame]] = []
    for name in lips:
        settings = SynthesizerConfig(lips=name)
        if expressiveness is not None:
            settings = settings.model_copy(update={"expressiveness": expressiveness})
        chain = LiveChain(
            model,
            load_lip_model(name=name),
            synthesizer=settings,
            lips_from_sound=lips_from_sound,
        )
        frames: list[film.Frame] = []
        for begin in range(0, len(samples), MEDIA_RATE_HZ):
            frames += chain.accept_waveform(samples[begin : begin + MEDIA_RATE_HZ])
            progress.advance(task, MEDIA_RATE_HZ)
        faces.append(frames + chain.input_finished())
    num_phones = len({event.index for event in chain.events if isinstance(event, Phone)})
    frames = faces[0] if len(faces) == 1 else film.beside(faces)
    return _Animation(frames, FRAME_RATE_HZ, samples, num_phones)


def _lips_of(model: AcousticModel, voice: Path | None) -> LipPredictor | None:
    """Return the recognizer's model of lips with a speaker's voice."""
    lips = lips_for(model)
    if voice is None or lips is None:
        return lips
    profile = read_profile(voice)
    try:
        return lips.for_voice(profile)
    except UserError as error:
        raise UserError(f"--voice {voice}: {error}") from None


def _parse_size(text: str, *, even: bool) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise UserError(f"--size {text}: write WIDTHxHEIGHT, for example 1280x720")
    width_px, height_px = int(width), int(height)
    if not (16 <= width_px <= 7680 and 16 <= height_px <= 4320):
        raise UserError(f"--size {text}: 16x16 to 7680x4320")
    if even and (width_px % 2 or height_px % 2):
        raise UserError(f"--size {text}: both must be even for a video")
    return width_px, height_px
