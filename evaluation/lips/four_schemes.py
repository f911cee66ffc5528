"""The experiment of Li et al. 2011, section 3.2: four ways to drive a face with the same sentences.

1. Phones from forced alignment of the text. All phones are known.
2. Recognized phones. All phones are known.
3. Live: what the services send.
4. Live, but a phone counts only once the next one starts.

Schemes 1 and 2 use the offline pipeline (``services.recording_pipeline``). Schemes 3 and 4 use the
live pipeline (``services.live_pipeline``) with the default delay of each lip model. Scheme 1 always
uses the default acoustic model. In the paper, too, the alignment does not depend on the recognizer.

The paper's output rule (section 2.2) emits a phone once N = 3 frames agree on it, and never
corrects it (eq. 4, figure 3). A wrong phone stays, and its duration stays the mean. In scheme 4 a
phone counts when the rule emits the next one; by then the search has measured its duration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from rich.progress import track

from kouxing.corpora.scoring import is_emitted
from kouxing.evaluation.lips.live_faces import animate_live, drop_first_hypotheses, live_events
from kouxing.evaluation.lips.sentences import Sentence
from kouxing.services.lip_models import lip_model_info, lip_models
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.recognizer.offline.offline_recognition import recognize_recording
from kouxing.services.recording_pipeline import (
    AnalyzedRecording,
    analyze_recording,
    animate_recording,
)
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.services.synthesizer.face_animator import Frame, configured_face
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone, SoundEvent, SpeechChange

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
        """Name of its folder of videos, such as ``scheme3-learned-blocks``."""
        return "-".join(filter(None, (f"scheme{self.scheme}", self.lips, self.recognizer)))


@dataclass(frozen=True, slots=True)
class RecognizerSetup:
    """A recognizer with the settings that suit its acoustic model."""

    name: str
    model: AcousticModel
    config: RecognizerConfig
    uses_paper_rule: bool  # phones are emitted as in the paper and never corrected


@dataclass(frozen=True, slots=True)
class RecognizerOutput:
    """Output of one recognizer for a sentence."""

    offline: AnalyzedRecording
    live: Mapping[float, Sequence[SoundEvent]]  # by the face's delay in seconds
    uses_paper_rule: bool


@dataclass(frozen=True, slots=True)
class RecognizedSentence:
    """A sentence with the output of every recognizer."""

    sentence: Sentence
    aligned: AnalyzedRecording | None
    outputs: Mapping[str, RecognizerOutput]  # by the recognizer's name


def load_recognizers(names: Sequence[str], *, uses_paper_rule: bool) -> list[RecognizerSetup]:
    """Load recognizers by the names or paths of their acoustic models.

    With the paper's output rule, their names end in ``-paper``.
    """
    recognizers = []
    for name in names:
        model = load_model(name)
        config = RecognizerConfig(acoustic=name)
        if uses_paper_rule:
            config = RecognizerConfig(acoustic=name, num_stable_frames=3, min_confidence=0.0)
        title = Path(name).stem + ("-paper" if uses_paper_rule else "")
        recognizers.append(RecognizerSetup(title, model, config, uses_paper_rule))
    return recognizers


def all_conditions(recognizers: Sequence[RecognizerSetup], lips: Sequence[str]) -> list[Condition]:
    """Return all conditions, grouped by lip model."""
    conditions = []
    for name in lips:
        conditions.append(Condition(ALIGNED, name, ""))
        for recognizer in recognizers:
            conditions += [Condition(n, name, recognizer.name) for n in SCHEMES[1:]]
    return conditions


def recognize_all(
    recognizers: Sequence[RecognizerSetup], sentences: Sequence[Sentence]
) -> list[RecognizedSentence]:
    """Run all recognizers on all sentences."""
    lips = load_lip_predictor()
    recognized = []
    for sentence in track(sentences, description="recognizing", transient=True):
        samples, phones = sentence.clip.samples, sentence.aligned
        aligned = None if phones is None else analyze_recording(samples, phones, lips)
        outputs = {
            tested.name: RecognizerOutput(
                analyze_recording(
                    samples, recognize_recording(tested.model, samples), lips, is_text_known=False
                ),
                live_events(tested.model, samples, lips, _DELAYS_S, tested.config),
                tested.uses_paper_rule,
            )
            for tested in recognizers
        }
        recognized.append(RecognizedSentence(sentence, aligned, outputs))
    return recognized


def make_frames(
    condition: Condition, recognized: RecognizedSentence, config: SynthesizerConfig
) -> list[Frame] | None:
    """Return the frames of a condition; None in scheme 1 if the text is not known."""
    lips = load_lip_model(name=condition.lips)
    if condition.scheme == ALIGNED:
        aligned = recognized.aligned
        return None if aligned is None else animate_recording(aligned, lips, config)
    output = recognized.outputs[condition.recognizer]
    if condition.scheme == RECOGNIZED:
        return animate_recording(output.offline, lips, config)
    return animate_live(configured_face(lips, config), face_input(condition, output))


def face_input(condition: Condition, output: RecognizerOutput) -> Sequence[SoundEvent]:
    """Return the events that the face of a live condition receives."""
    events = output.live[lip_model_info(condition.lips).delay_ms / 1e3]
    is_delayed = condition.scheme == NEXT_PHONE
    if output.uses_paper_rule:
        return delay_by_one_phone(events) if is_delayed else without_corrections(events)
    return drop_first_hypotheses(events) if is_delayed else events


def without_corrections(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Keep only the phones that the rule emits, renumbered, and all other events: scheme 3."""
    remaining: list[SoundEvent] = []
    num_phones = 0
    for event, after in zip_longest(events, events[1:]):
        if not isinstance(event, Phone):
            remaining.append(event)
        elif is_emitted(event, after):
            remaining.append(replace(event, index=num_phones))
            num_phones += 1
    return remaining


def delay_by_one_phone(events: Sequence[SoundEvent]) -> list[SoundEvent]:
    """Keep each phone once, when the next is emitted or speech ends: scheme 4."""
    remaining: list[SoundEvent] = []
    latest: dict[int, Phone] = {}  # revision of each phone, by index
    middle_s = 0.0  # middle of the last phone kept; a phone that starts earlier is not new
    for event, after in zip_longest(events, events[1:]):
        delayed = None
        if isinstance(event, Phone):
            latest[event.index] = event
            if is_emitted(event, after):
                delayed = latest.get(event.index - 1)
        elif isinstance(event, SpeechChange) and not event.active and latest:
            delayed = latest[max(latest)]
        if delayed is not None and delayed.onset_s >= middle_s and not delayed.is_withdrawn:
            remaining.append(delayed)
            middle_s = delayed.onset_s + 0.5 * delayed.duration_s
        if not isinstance(event, Phone):
            remaining.append(event)
    return remaining
