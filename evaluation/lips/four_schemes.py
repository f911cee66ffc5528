"""The experiment of Li et al. 2011, section 3.2: four ways to drive a face with the same sentences.

1. forced alignment of the text, with everything known;
2. recognised phones with their times, with everything known;
3. live: what the services send;
4. live, but a phone counts only once the next one begins.

Schemes 1 and 2 are the product's offline chain (``services.recording_chain``), 3 and 4 its live one
with the default delay of each lip model. Scheme 1 takes its phones from the default acoustic model,
since the paper aligns apart from the recognizer, too; the others are made with each recognizer.
``paper_rule`` has what 3 and 4 are told if phones are never corrected, as in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.clip_video import tracked_frames
from kouxing.evaluation.lips.paper_rule import as_emitted, once_the_next_is_emitted, paper_config
from kouxing.evaluation.lips.schemes import animate_live, live_events, once_the_next_begins
from kouxing.evaluation.lips.sentences import Sentence
from kouxing.services.driver.config import Framing
from kouxing.services.driver.render import scene
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.video import film
from kouxing.services.lip_models import lip_model_info, lip_models
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lip_frames import LipFrameModel
from kouxing.services.recognizer.lip_predictor import lip_predictor_for
from kouxing.services.recording_chain import AnalyzedRecording, analyze_recording, animate_recording
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import SoundEvent

SCHEMES = (1, 2, 3, 4)
BOUND, RECOGNISED, NEXT_PHONE = 1, 2, 4
_DELAYS_S = sorted({info.delay_ms / 1e3 for info in lip_models().values()})
_VIDEO_PX = (640, 640)
_IMAGES_PER_S = 25.0


@dataclass(frozen=True, slots=True)
class Condition:
    """One way to drive a face."""

    scheme: int
    lips: str
    recognizer: str  # empty for scheme 1

    @property
    def name(self) -> str:
        """Its name as a folder's, such as ``scheme3-learnt-blocks``."""
        return "-".join(filter(None, (f"scheme{self.scheme}", self.lips, self.recognizer)))


@dataclass(frozen=True, slots=True)
class Listener:
    """A recognizer."""

    name: str
    model: AcousticModel
    lips: LipFrameModel | None
    config: RecognizerConfig
    has_paper_rule: bool  # it emits phones as in the paper, and they are never corrected

    def can_drive(self, lips: str) -> bool:
        """Whether a lip model gets what it needs; learnt lips need the network's lip frames."""
        return lips != "learnt" or self.lips is not None


@dataclass(frozen=True, slots=True)
class Hearing:
    """What one recognizer makes of a sentence."""

    recognised: AnalyzedRecording
    live: Mapping[float, Sequence[SoundEvent]]  # by the face's delay in s
    has_paper_rule: bool


@dataclass(frozen=True, slots=True)
class HeardSentence:
    """A sentence with what the recognizers make of it."""

    sentence: Sentence
    aligned: AnalyzedRecording | None
    hearings: Mapping[str, Hearing]  # by the recognizer's name


def listeners_of(names: Sequence[str], *, has_paper_rule: bool = False) -> list[Listener]:
    """Load recognizers by the names or paths of their acoustic models, with what suits them.

    With the paper's rule their names end in ``-paper``.
    """
    suffix = "-paper" if has_paper_rule else ""
    found = []
    for name in names:
        model = load_live_model(name)
        config = paper_config(name) if has_paper_rule else RecognizerConfig(acoustic=name)
        found.append(
            Listener(
                Path(name).stem + suffix, model, lip_predictor_for(model), config, has_paper_rule
            )
        )
    return found


def conditions_of(listeners: Sequence[Listener], lips: Sequence[str]) -> list[Condition]:
    """All conditions, those of a lip model together."""
    return [
        condition
        for name in lips
        for condition in (
            Condition(BOUND, name, ""),
            *(
                Condition(scheme, name, listener.name)
                for listener in listeners
                if listener.can_drive(name)
                for scheme in SCHEMES[1:]
            ),
        )
    ]


def hear_all(
    model: AcousticModel, listeners: Sequence[Listener], sentences: Sequence[Sentence]
) -> list[HeardSentence]:
    """Let all recognizers hear all sentences; ``model`` is that of the aligned phones."""
    return [
        _hear(model, listeners, sentence)
        for sentence in track(sentences, description="recognising", transient=True)
    ]


def _hear(model: AcousticModel, listeners: Sequence[Listener], sentence: Sentence) -> HeardSentence:
    samples, aligned = sentence.clip.samples, sentence.aligned
    return HeardSentence(
        sentence,
        None
        if aligned is None
        else analyze_recording(model, samples, lip_predictor_for(model), aligned),
        {
            each.name: Hearing(
                analyze_recording(each.model, samples, each.lips),
                live_events(each.model, samples, each.lips, _DELAYS_S, each.config),
                each.has_paper_rule,
            )
            for each in listeners
        },
    )


def face_of(
    condition: Condition, heard: HeardSentence, config: SynthesizerConfig
) -> list[Frame] | None:
    """Return the frames of a condition; None where the sentence's text is not known."""
    lips = load_lip_model(name=condition.lips)
    if condition.scheme == BOUND:
        return None if heard.aligned is None else animate_recording(heard.aligned, lips, config)
    hearing = heard.hearings[condition.recognizer]
    if condition.scheme == RECOGNISED:
        return animate_recording(hearing.recognised, lips, config)
    face = FaceAnimator(
        lips,
        frame_rate_hz=config.frame_rate_hz,
        delay_s=config.delay_ms / 1e3,
        idle_motion_seed=config.idle_motion_seed,
        expressiveness=config.expressiveness,
    )
    return animate_live(face, events_told(condition, hearing))


def events_told(condition: Condition, hearing: Hearing) -> Sequence[SoundEvent]:
    """Return what the face of a live condition is told, in order."""
    events = hearing.live[lip_model_info(condition.lips).delay_ms / 1e3]
    if hearing.has_paper_rule:
        rule = once_the_next_is_emitted if condition.scheme == NEXT_PHONE else as_emitted
        return rule(events)
    return once_the_next_begins(events) if condition.scheme == NEXT_PHONE else events


def film_all(
    heard: Sequence[HeardSentence],
    listeners: Sequence[Listener],
    lips: Sequence[str],
    folder: Path,
    *,
    has_anchor: bool = False,
    sound_at_once: bool = False,
) -> list[Path]:
    """Write ``CONDITION/SENTENCE.mp4`` for everything; videos that exist are kept.

    Every condition has every sentence, as a listening test needs it: one that cannot be made of all
    of them is left out.

    Parameters
    ----------
    heard, listeners, lips
        What is filmed: sentences, recognizers and lip models.
    folder
        Where.
    has_anchor
        Film a mouth at rest, too, as the condition ``anchor``.
    sound_at_once
        Show live frames when they are made, later than their sound; the conditions' names tell it.

    Raises
    ------
    UserError
        If a file or folder cannot be written.
    """
    missing = [
        (make, each, path)
        for name, make in _films(
            heard, listeners, lips, has_anchor=has_anchor, sound_at_once=sound_at_once
        )
        for each in heard
        if not (path := folder / name / f"{each.sentence.clip.name}.mp4").exists()
    ]
    if not missing:
        return []
    head = scene.load_head()
    renderer = Renderer(head, *_VIDEO_PX, camera=scene.camera(head, Framing.FACE))
    for make, each, path in track(missing, description="drawing", transient=True):
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be made: {error.strerror}") from error
        film.render_video(
            make(each),
            path,
            renderer,
            frame_rate_hz=_IMAGES_PER_S,
            samples=each.sentence.clip.samples,
        )
    renderer.close()
    return [path for _, _, path in missing]


def _films(
    heard: Sequence[HeardSentence],
    listeners: Sequence[Listener],
    lips: Sequence[str],
    *,
    has_anchor: bool,
    sound_at_once: bool,
) -> Iterator[tuple[str, Callable[[HeardSentence], list[Frame]]]]:
    """Yield each condition's name, and what makes its frames of a sentence."""
    conditions = [
        condition
        for condition in conditions_of(listeners, lips)
        if condition.scheme != BOUND or all(each.aligned is not None for each in heard)
    ]
    for condition in conditions:
        if sound_at_once and condition.scheme > RECOGNISED:
            yield f"{condition.name}-sound-at-once", partial(_frames_as_made, condition)
        else:
            yield condition.name, partial(_frames, condition)
    if not conditions:
        return
    if has_anchor:
        yield "anchor", partial(_frames_of_mouth, conditions[0], _mouth_at_rest)
    clips = [each.sentence.clip for each in heard]
    if all(len(clip.time_s) and clip.is_in_sync for clip in clips):
        yield "tracked", partial(_frames_of_mouth, conditions[0], tracked_frames)


def _frames(condition: Condition, heard: HeardSentence) -> list[Frame]:
    frames = face_of(condition, heard, SynthesizerConfig(lips=condition.lips))
    assert frames is not None  # noqa: S101 - conditions without a face are not among them
    return frames


def _frames_as_made(condition: Condition, heard: HeardSentence) -> list[Frame]:
    delay_s = lip_model_info(condition.lips).delay_ms / 1e3
    return [(time_s + delay_s, faps) for time_s, faps in _frames(condition, heard)]


def _frames_of_mouth(
    condition: Condition,
    mouth_of: Callable[[LipClip, NDArray[np.float64]], NDArray[np.float64]],
    heard: HeardSentence,
) -> list[Frame]:
    """Give a condition's face, with its blinks and head motion, another mouth."""
    frames = _frames(condition, heard)
    faps = np.array([faps for _, faps in frames])
    times_s = np.array([time_s for time_s, _ in frames])
    mouth = np.array(MOUTH_FAPS) - 1
    faps[:, mouth] = mouth_of(heard.sentence.clip, times_s)[:, mouth]
    return [(time_s, row) for (time_s, _), row in zip(frames, faps, strict=True)]


def _mouth_at_rest(_clip: LipClip, times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.zeros((len(times_s), NUM_FAPS))
