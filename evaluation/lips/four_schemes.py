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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import track

from evaluation.lips.paper_rule import as_emitted, once_the_next_is_emitted, paper_config
from evaluation.lips.schemes import animate_live, live_events, once_the_next_begins
from evaluation.lips.sentences import Sentence
from services.driver.config import Framing
from services.driver.render import scene
from services.driver.render.renderer import Renderer
from services.driver.video import film
from services.recognizer.acoustic.acoustic_model import AcousticModel
from services.recognizer.acoustic.load import load_live_model
from services.recognizer.config import RecognizerConfig
from services.recognizer.lip_source import LipsFromSound
from services.recognizer.lips import lips_for
from services.recording_chain import HeardRecording, animate, hear_recording
from services.synthesizer.config import DELAYS_MS, SynthesizerConfig
from services.synthesizer.face import Face, Frame
from services.synthesizer.lips.load import load_lip_model
from shared.errors import UserError
from shared.face.lip_models import LipModelName
from shared.phones.events import SoundEvent

SCHEMES = (1, 2, 3, 4)
BOUND, RECOGNISED, NEXT_PHONE = 1, 2, 4
_DELAYS_S = sorted({delay_ms / 1e3 for delay_ms in DELAYS_MS.values()})
_VIDEO_PX = (640, 640)
_IMAGES_PER_S = 25.0


@dataclass(frozen=True, slots=True)
class Condition:
    """One way to drive a face."""

    scheme: int
    lips: LipModelName
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
    lips: LipsFromSound | None
    config: RecognizerConfig
    has_paper_rule: bool  # it emits phones as in the paper, and they are never corrected

    def can_drive(self, lips: LipModelName) -> bool:
        """Whether a lip model gets what it needs; learnt lips need the network's lip frames."""
        return lips != LipModelName.LEARNT or self.lips is not None


@dataclass(frozen=True, slots=True)
class Hearing:
    """What one recognizer makes of a sentence."""

    recognised: HeardRecording
    live: Mapping[float, Sequence[SoundEvent]]  # by the face's delay in s
    has_paper_rule: bool


@dataclass(frozen=True, slots=True)
class HeardSentence:
    """A sentence with what the recognizers make of it."""

    sentence: Sentence
    aligned: HeardRecording | None
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
            Listener(Path(name).stem + suffix, model, lips_for(model), config, has_paper_rule)
        )
    return found


def conditions_of(listeners: Sequence[Listener], lips: Sequence[LipModelName]) -> list[Condition]:
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
        None if aligned is None else hear_recording(model, samples, lips_for(model), aligned),
        {
            each.name: Hearing(
                hear_recording(each.model, samples, each.lips),
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
        return None if heard.aligned is None else animate(heard.aligned, lips, config)
    hearing = heard.hearings[condition.recognizer]
    if condition.scheme == RECOGNISED:
        return animate(hearing.recognised, lips, config)
    face = Face(
        lips,
        frame_rate_hz=config.frame_rate_hz,
        delay_s=config.delay_ms / 1e3,
        idle_motion_seed=config.idle_motion_seed,
        expressiveness=config.expressiveness,
    )
    return animate_live(face, events_told(condition, hearing))


def events_told(condition: Condition, hearing: Hearing) -> Sequence[SoundEvent]:
    """Return what the face of a live condition is told, in order."""
    events = hearing.live[DELAYS_MS[condition.lips] / 1e3]
    if hearing.has_paper_rule:
        rule = once_the_next_is_emitted if condition.scheme == NEXT_PHONE else as_emitted
        return rule(events)
    return once_the_next_begins(events) if condition.scheme == NEXT_PHONE else events


def film_all(
    heard: Sequence[HeardSentence],
    listeners: Sequence[Listener],
    lips: Sequence[LipModelName],
    folder: Path,
) -> list[Path]:
    """Write ``CONDITION/SENTENCE.mp4`` for everything; videos that exist are kept.

    Raises
    ------
    UserError
        If a file or folder cannot be written.
    """
    missing = [
        (condition, each, path)
        for condition in conditions_of(listeners, lips)
        for each in heard
        if not (path := folder / condition.name / f"{each.sentence.clip.name}.mp4").exists()
        if condition.scheme != BOUND or each.aligned is not None
    ]
    if not missing:
        return []
    head = scene.load_head()
    renderer = Renderer(head, *_VIDEO_PX, camera=scene.camera(head, Framing.FACE))
    for condition, each, path in track(missing, description="drawing", transient=True):
        frames = face_of(condition, each, SynthesizerConfig(lips=condition.lips))
        assert frames is not None  # noqa: S101 - conditions without a face are not among them
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be made: {error.strerror}") from error
        film.render_video(
            frames,
            path,
            renderer,
            frame_rate_hz=_IMAGES_PER_S,
            samples=each.sentence.clip.samples,
        )
    renderer.close()
    return [path for _, _, path in missing]
