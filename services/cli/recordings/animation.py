"""Computes the motion of a face from audio, or reads it from a ``.fap`` file or a table."""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from rich.progress import Progress

from kouxing.services.cli.options import CaptionKind
from kouxing.services.cli.recordings.captions import check_characters, spell_syllables
from kouxing.services.cli.recordings.curve_reader import TABLE_SUFFIXES, read_table
from kouxing.services.cli.texts.spoken_text import read_transcript, report_mismatch
from kouxing.services.driver.video import film
from kouxing.services.driver.video.time_stretch import stretch_time
from kouxing.services.live_pipeline import LivePipeline
from kouxing.services.mono_audio import read_mono_16k
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.languages import load_model_for_language
from kouxing.services.recognizer.lips.lip_predictor import GruLipPredictor, load_lip_predictor
from kouxing.services.recognizer.lips.mouth_profile import read_mouth_profile
from kouxing.services.recognizer.offline.alignment import Alignment, align_syllables
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.recording_pipeline import analyze_recording, animate_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import Frame
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import read_fap
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone, SoundEvent
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory
from kouxing.shared.phones.transcript import TimedSyllable, Transcript

T = TypeVar("T", Phone, TimedSyllable)
_Lips: TypeAlias = tuple[LipModel, SynthesizerConfig]  # of one face
_IMAGE_RATE_HZ = 25.0  # rate of a video that is made from audio
_MAX_IMAGE_RATE_HZ = 240.0


@dataclass(frozen=True, slots=True)
class FaceMotion:
    """The motion of a face, or of several faces side by side."""

    frames: list[film.TimedFaps]
    frame_rate_hz: float
    image_rate_hz: float  # default for a video
    samples: Floats | None  # 16 kHz mono, shape (n,)
    phones: list[Phone] | None = None  # spoken phones in order; None if the source has no sound
    syllables: Sequence[TimedSyllable] = ()  # as written, in order
    source: Path | None = None
    language: str = DEFAULT_LANGUAGE  # language of the phones
    is_text_mismatched: bool = False  # the mouth follows a text that does not fit the audio


def slow_down(motion: FaceMotion, speed: float) -> FaceMotion:
    """Return a motion at a speed of 0.25 to 1, with its sound at the same pitch."""
    if speed == 1.0:
        return motion
    return dataclasses.replace(
        motion,
        frames=[(time_s / speed, faps) for time_s, faps in motion.frames],
        samples=None if motion.samples is None else stretch_time(motion.samples, speed),
        phones=None
        if motion.phones is None
        else [_slow_down_item(item, speed) for item in motion.phones],
        syllables=[_slow_down_item(item, speed) for item in motion.syllables],
    )


def _slow_down_item(item: T, speed: float) -> T:
    return replace(item, onset_s=item.onset_s / speed, duration_s=item.duration_s / speed)


def has_motion(source: Path) -> bool:
    """Return whether a source already contains the motion of a face."""
    return source.suffix.lower() in (".fap", *TABLE_SUFFIXES)


def read_motion(source: Path, sound: Path | None) -> FaceMotion:
    """Read a ``.fap`` file or a table, with its sound, if any.

    The times of a table are those of its sound. Without sound, or if the first time is not within
    the sound, the motion starts at 0.
    """
    animation = read_fap(source) if source.suffix.lower() == ".fap" else read_table(source)
    samples = None if sound is None else read_mono_16k(sound)
    sound_s = 0.0 if samples is None else len(samples) / MEDIA_RATE_HZ
    start_s = animation.start_s if 0.0 <= animation.start_s < sound_s else 0.0
    return FaceMotion(
        [(start_s + time_s, faps) for time_s, faps in film.expand_frames(animation)],
        animation.frame_rate_hz,
        min(animation.frame_rate_hz, _MAX_IMAGE_RATE_HZ),
        samples,
        source=sound or source,
    )


def animate(
    source: Path,
    lip_models: Sequence[str],
    progress: Progress,
    *,
    language: str,
    live: bool = False,
    text: str | None = None,
    text_may_differ: bool = False,
    mouth: Path | None = None,
    expressiveness: float | None = None,
    track: int | None = None,
    captions: CaptionKind | None = None,
) -> FaceMotion:
    """Animate a face from an audio file.

    Each lip model moves a face; the frames hold all faces side by side. With ``live``, the frames
    equal the live services' frames with default settings. Otherwise, the whole recording is known,
    and its phones are aligned with ``text`` (a text, or the name of a text file), if given.
    ``language`` is the language of the speech. With ``text_may_differ``, a text that cannot be read
    or does not fit the audio is reported and ignored. ``captions`` is what the captions will show.

    Raises ``UserError`` if a file cannot be read, the text has nothing to say, or the captions
    cannot show its characters.
    """
    loading = progress.add_task("loading", total=None)
    model, predictor = _load_models(mouth, language)
    changes: dict[str, Any] = {} if expressiveness is None else {"expressiveness": expressiveness}
    lips = [
        (load_lip_model(model.inventory.language, name), SynthesizerConfig(lips=name, **changes))
        for name in lip_models
    ]
    transcript = _read_transcript(text, language, may_differ=text_may_differ)
    if transcript is not None and captions is CaptionKind.CHARACTERS:
        check_characters(transcript, model.inventory)
    progress.remove_task(loading)
    samples = read_mono_16k(source, track, progress)
    alignment = None
    if live:
        faces, events = _animate_live(samples, model, predictor, lips, progress)
    else:
        if transcript is not None:
            alignment = _align(source, samples, model, transcript, progress)
            if text_may_differ and not alignment.fits:
                transcript = alignment = None
        faces, events = _animate_recording(samples, alignment, model, predictor, lips, progress)
    spoken = [event for event in events if isinstance(event, Phone) and event.is_spoken]
    return FaceMotion(
        frames=faces[0] if len(faces) == 1 else film.stack_faces(faces),
        frame_rate_hz=lips[0][1].frame_rate_hz,
        image_rate_hz=_IMAGE_RATE_HZ,
        samples=samples,
        phones=spoken,
        syllables=spell_syllables(spoken, transcript, model.inventory),
        source=source,
        language=language,
        is_text_mismatched=alignment is not None and not alignment.fits,
    )


def _read_transcript(text: str | None, language: str, *, may_differ: bool) -> Transcript | None:
    """Read a text. If it ``may_differ`` from the audio and cannot be read, report and ignore it."""
    try:
        return None if text is None else read_transcript(text, load_inventory(language))
    except UserError as error:
        if not may_differ:
            raise
        print_message(f"the text is ignored: {error}")
        return None


def _align(
    source: Path, samples: Floats, model: AcousticModel, transcript: Transcript, progress: Progress
) -> Alignment:
    """Align a text with a recording; report a text that does not fit."""
    with_progress = partial(progress.track, description="aligning")
    alignment = align_syllables(model, samples, transcript.phones, with_progress)
    report_mismatch(source, alignment)
    return alignment


def _animate_live(
    samples: Floats,
    model: AcousticModel,
    predictor: GruLipPredictor,
    lips: Sequence[_Lips],
    progress: Progress,
) -> tuple[list[list[Frame]], Sequence[SoundEvent]]:
    """Return the frames of each face and the events, as the live services make them."""
    pipelines = [
        LivePipeline(model, lip_model, synthesizer=config, lip_predictor=predictor)
        for lip_model, config in lips
    ]
    with_progress = partial(progress.track, description="recognizing")
    faces = [pipeline.animate(samples, with_progress) for pipeline in pipelines]
    return faces, pipelines[-1].events


def _animate_recording(
    samples: Floats,
    alignment: Alignment | None,
    model: AcousticModel,
    predictor: GruLipPredictor,
    lips: Sequence[_Lips],
    progress: Progress,
) -> tuple[list[list[Frame]], Sequence[SoundEvent]]:
    """Return the frames of each face and the events. Without a text, recognize the phones."""
    if alignment is None:
        with_progress = partial(progress.track, description="recognizing")
        phones = recognize_recording(model, samples, with_progress)
    else:
        phones = alignment.phones
    with_progress = partial(progress.track, description="finding the lips")
    recording = analyze_recording(
        samples,
        phones,
        predictor,
        is_text_known=alignment is not None,
        with_progress=with_progress,
    )
    with_progress = partial(progress.track, description="animating")
    faces = [
        animate_recording(recording, lip_model, config, with_progress) for lip_model, config in lips
    ]
    return faces, recording.events


@lru_cache(maxsize=1)
def _load_models(mouth: Path | None, language: str) -> tuple[AcousticModel, GruLipPredictor]:
    """Load the models once for all files of a command."""
    model, predictor = load_model_for_language(language), load_lip_predictor()
    if mouth is None:
        return model, predictor
    profile = read_mouth_profile(mouth)
    try:
        return model, predictor.with_mouth_profile(profile)
    except UserError as error:
        raise UserError(f"--mouth {mouth}: {error}") from None
