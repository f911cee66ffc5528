"""The experiment of Li et al. 2011, section 3.2: four ways to drive a face with the same sentences.

1. Phones from forced alignment of the text. All phones are known.
2. Recognized phones. All phones are known.
3. Live: what the services send.
4. Live, but a phone counts only once the next one starts.

Schemes 1 and 2 use the product's offline chain (``services.recording_chain``). Schemes 3 and 4 use
its live chain with the default delay of each lip model. Scheme 1 always uses the default acoustic
model. In the paper, too, the alignment does not depend on the recognizer.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import track

from kouxing.evaluation.lips.paper_rule import (
    delay_by_one_phone,
    paper_config,
    without_corrections,
)
from kouxing.evaluation.lips.schemes import animate_live, drop_first_hypotheses, live_events
from kouxing.evaluation.lips.sentences import Sentence
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
from kouxing.shared.phones.events import SoundEvent

SCHEMES = (1, 2, 3, 4)
ALIGNED, RECOGNIZED, LIVE, NEXT_PHONE = SCHEMES
_DELAYS_S = sorted({info.delay_ms / 1e3 for info in lip_models().values()})


@dataclass(frozen=True, slots=True)
class Condition:
    """One way to drive a face."""

    scheme: int
    lips: str
    recognizer: str  # empty for scheme 1

    @property
    def name(self) -> str:
        """Name of its folder of videos, such as ``scheme3-learnt-blocks``."""
        return "-".join(filter(None, (f"scheme{self.scheme}", self.lips, self.recognizer)))


@dataclass(frozen=True, slots=True)
class TestedRecognizer:
    """A recognizer with the settings that suit its acoustic model."""

    name: str
    model: AcousticModel
    lips: LipFrameModel | None
    config: RecognizerConfig
    has_paper_rule: bool  # phones are emitted as in the paper and never corrected

    def can_drive(self, lips: str) -> bool:
        """Whether the recognizer has the input of a lip model; learnt lips need lip frames."""
        return lips != "learnt" or self.lips is not None


@dataclass(frozen=True, slots=True)
class RecognizerOutput:
    """Output of one recognizer for a sentence."""

    offline: AnalyzedRecording
    live: Mapping[float, Sequence[SoundEvent]]  # by the face's delay in seconds
    has_paper_rule: bool


@dataclass(frozen=True, slots=True)
class RecognizedSentence:
    """A sentence with the output of every recognizer."""

    sentence: Sentence
    aligned: AnalyzedRecording | None
    outputs: Mapping[str, RecognizerOutput]  # by the recognizer's name


def load_recognizers(
    names: Sequence[str], *, has_paper_rule: bool = False
) -> list[TestedRecognizer]:
    """Load recognizers by the names or paths of their acoustic models.

    With the paper's output rule, their names end in ``-paper``.
    """
    recognizers = []
    for name in names:
        model = load_live_model(name)
        config = paper_config(name) if has_paper_rule else RecognizerConfig(acoustic=name)
        title = Path(name).stem + ("-paper" if has_paper_rule else "")
        recognizers.append(
            TestedRecognizer(title, model, lip_predictor_for(model), config, has_paper_rule)
        )
    return recognizers


def all_conditions(recognizers: Sequence[TestedRecognizer], lips: Sequence[str]) -> list[Condition]:
    """Return all conditions, grouped by lip model."""
    conditions = []
    for name in lips:
        conditions.append(Condition(ALIGNED, name, ""))
        for recognizer in recognizers:
            if recognizer.can_drive(name):
                conditions += [Condition(n, name, recognizer.name) for n in SCHEMES[1:]]
    return conditions


def recognize_all(
    model: AcousticModel, recognizers: Sequence[TestedRecognizer], sentences: Sequence[Sentence]
) -> list[RecognizedSentence]:
    """Run all recognizers on all sentences. ``model`` is the one of the aligned phones."""
    return [
        _recognize(model, recognizers, sentence)
        for sentence in track(sentences, description="recognizing", transient=True)
    ]


def _recognize(
    model: AcousticModel, recognizers: Sequence[TestedRecognizer], sentence: Sentence
) -> RecognizedSentence:
    samples, aligned = sentence.clip.samples, sentence.aligned
    return RecognizedSentence(
        sentence,
        None
        if aligned is None
        else analyze_recording(model, samples, lip_predictor_for(model), aligned),
        {
            tested.name: RecognizerOutput(
                analyze_recording(tested.model, samples, tested.lips),
                live_events(tested.model, samples, tested.lips, _DELAYS_S, tested.config),
                tested.has_paper_rule,
            )
            for tested in recognizers
        },
    )


def make_frames(
    condition: Condition, recognized: RecognizedSentence, config: SynthesizerConfig
) -> list[Frame] | None:
    """Return the frames of a condition; None in scheme 1 if the text is not known."""
    lips = load_lip_model(name=condition.lips)
    if condition.scheme == ALIGNED:
        return (
            None
            if recognized.aligned is None
            else animate_recording(recognized.aligned, lips, config)
        )
    output = recognized.outputs[condition.recognizer]
    if condition.scheme == RECOGNIZED:
        return animate_recording(output.offline, lips, config)
    face = FaceAnimator(
        lips,
        frame_rate_hz=config.frame_rate_hz,
        delay_s=config.delay_ms / 1e3,
        idle_motion_seed=config.idle_motion_seed,
        expressiveness=config.expressiveness,
    )
    return animate_live(face, face_input(condition, output))


def face_input(condition: Condition, output: RecognizerOutput) -> Sequence[SoundEvent]:
    """Return the events that the face of a live condition receives."""
    events = output.live[lip_model_info(condition.lips).delay_ms / 1e3]
    is_delayed = condition.scheme == NEXT_PHONE
    if output.has_paper_rule:
        return delay_by_one_phone(events) if is_delayed else without_corrections(events)
    return drop_first_hypotheses(events) if is_delayed else events
