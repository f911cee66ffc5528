"""What a face does: made of a sound, or read from a ``.fap`` file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import Progress

from kouxing.services.cli.sound_file import read_mono_16k
from kouxing.services.cli.spoken_text import does_not_fit, read_text
from kouxing.services.driver.video import film
from kouxing.services.live_chain import LiveChain
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.alignment import align_syllables
from kouxing.services.recognizer.lips import LipPredictor, lips_for
from kouxing.services.recognizer.mouth_profile import read_mouth_profile
from kouxing.services.recording_chain import animate, hear_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import read_fap
from kouxing.shared.face.lip_models import LipModelName
from kouxing.shared.phones.events import Phone, SoundEvent
from kouxing.shared.terminal import print_message

_IMAGE_RATE_HZ = 25.0  # of a video of a sound
MAX_IMAGE_RATE_HZ = 240.0


@dataclass(frozen=True, slots=True)
class Motion:
    """A face over time."""

    frames: list[film.Frame]
    frame_rate_hz: float
    image_rate_hz: float  # of a video of it
    samples: NDArray[np.float32] | None  # 16 kHz mono, shape (n,)
    num_phones: int | None = None  # None: the source is no sound


def is_fap(source: Path) -> bool:
    """Whether a source holds a face's motion already."""
    return source.suffix.lower() == ".fap"


def read_motion(source: Path, sound: Path | None) -> Motion:
    """Read a ``.fap`` file; a sound may go with it."""
    animation = read_fap(source)
    return Motion(
        film.frames_of(animation),
        animation.frame_rate_hz,
        min(animation.frame_rate_hz, MAX_IMAGE_RATE_HZ),
        None if sound is None else read_mono_16k(sound),
    )


def motion_of_sound(
    source: Path,
    lips: Sequence[LipModelName],
    progress: Progress,
    *,
    live: bool,
    text: str | None,
    mouth: Path | None,
    expressiveness: float | None,
) -> Motion:
    """Make a face for each lip model, all of the same sound.

    Parameters
    ----------
    source
        The sound.
    lips
        Lip models; several are side by side in the frames.
    progress
        Shows how far it is.
    live
        As the services, by their defaults, would make it; else with everything known.
    text
        What is said, or the name of a file that holds it; None: it is recognised.
    mouth
        The speaker's mouth profile, for the learnt lip model.
    expressiveness
        How large the mouth's movements are, 0.5 to 2; None: the default.

    Raises
    ------
    UserError
        If a file cannot be read, or the text does not fit the sound.
    """
    samples = read_mono_16k(source)
    settings = {name: SynthesizerConfig(lips=name) for name in lips}
    if expressiveness is not None:
        settings = {
            name: config.model_copy(update={"expressiveness": expressiveness})
            for name, config in settings.items()
        }
    model = load_live_model()
    lips_from_sound = _lips_of(model, mouth)
    events: Sequence[SoundEvent]
    if live:
        task = progress.add_task("recognising", total=len(lips) * len(samples))
        faces = []
        for name in lips:
            chain = LiveChain(
                model,
                load_lip_model(name=name),
                synthesizer=settings[name],
                lips_from_sound=lips_from_sound,
            )
            frames: list[film.Frame] = []
            for begin in range(0, len(samples), MEDIA_RATE_HZ):
                frames += chain.accept_waveform(samples[begin : begin + MEDIA_RATE_HZ])
                progress.advance(task, MEDIA_RATE_HZ)
            faces.append(frames + chain.input_finished())
            events = chain.events
    else:
        progress.add_task("recognising", total=None)
        aligned = None if text is None else _aligned(model, samples, source, text)
        heard = hear_recording(model, samples, lips_from_sound, aligned)
        faces = [animate(heard, load_lip_model(name=name), settings[name]) for name in lips]
        events = heard.events
    silence = model.inventory.silence
    phones = (each for each in events if isinstance(each, Phone) and each.symbol != silence)
    return Motion(
        faces[0] if len(faces) == 1 else film.beside(faces),
        SynthesizerConfig().frame_rate_hz,
        _IMAGE_RATE_HZ,
        samples,
        len({phone.index for phone in phones}),
    )


def _aligned(
    model: AcousticModel, samples: NDArray[np.float32], source: Path, text: str
) -> list[Phone]:
    transcript = read_text(text, model.inventory)
    alignment = align_syllables(model, samples, MEDIA_RATE_HZ, transcript.phones)
    if not alignment.fits:
        print_message(does_not_fit(source, alignment))
    return alignment.phones


def _lips_of(model: AcousticModel, mouth: Path | None) -> LipPredictor | None:
    """Return the lip model, adapted to a speaker if there is a mouth profile."""
    lips = lips_for(model)
    if mouth is None or lips is None:
        return lips
    profile = read_mouth_profile(mouth)
    try:
        return lips.with_mouth_profile(profile)
    except UserError as error:
        raise UserError(f"--mouth {mouth}: {error}") from None
