"""Scores lip models live on held-out clips, next to the real lips.

The frames are those that the services would send, with clean sound, and with other voices or music
10 dB below the speech. Clips form groups by language, source and speaker. *New* speakers have no
clip that a shipped model may be trained on. *Mocap* clips are motion capture instead of video.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.progress import track

from kouxing.corpora.lip_clips import LipClip, aligned_phones
from kouxing.corpora.scoring import final_hypothesis
from kouxing.evaluation.lips.lip_measures import MEASURES, REAL_MEASURES, ScoredClip
from kouxing.evaluation.lips.live_faces import Samples, live_events, live_frames
from kouxing.evaluation.lips.mouths import Mouth, clip_mouth, predicted_mouth
from kouxing.evaluation.lips.other_programs import MouthFunction, load_programs
from kouxing.evaluation.lips.references import Reference, read_parts
from kouxing.evaluation.recognizer.disturbances import (
    BABBLE,
    CLEAN,
    MUSIC,
    Disturb,
    add_sound,
    babble,
)
from kouxing.services.lip_models import lip_model_info, lip_models
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.lips.lip_prediction import LipPredictor
from kouxing.services.recognizer.lips.lip_predictor import load_lip_predictor
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.services.synthesizer.lips.load import load_lip_model
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import SoundEvent, SpeechChange
from kouxing.shared.phones.inventory import PhoneInventory

REAL = "real"
CONDITIONS = CLEAN, BABBLE, MUSIC
ALL, MOCAP = "all", "mocap"
_SNR_DB = 10.0

Scores = dict[str, float | None]  # by measure
Results = dict[str, dict[str, dict[str, Scores]]]  # by face, condition and group of clips


@dataclass(frozen=True, slots=True)
class LiveFace:
    """A lip model with its lip predictor and its delay."""

    lips: LipModel
    predictor: LipPredictor
    delay_ms: float

    def mouth(self, events: Sequence[SoundEvent]) -> Mouth:
        """Return the mouth that the face shows for a recognizer's output."""
        return predicted_mouth(live_frames(self.lips, events, self.delay_ms / 1e3))


def load_faces(
    names: Sequence[str], delays_ms: Sequence[float], inventory: PhoneInventory
) -> dict[str, LiveFace]:
    """Load faces by title. A name is a lip model, a lip predictor (.npz) or visemes (.json).

    Without names, all lip models are loaded. Without delays, each has its default delay. Raises
    UserError if a lip model is not installed, or a file cannot be read.
    """
    faces = {}
    default_predictor = load_lip_predictor()
    for name in names or list(lip_models()):
        path = Path(name)
        if path.suffix == ".npz" and not path.is_file():
            raise UserError(f"{path}: no such file")
        kind = {".npz": "learned", ".json": "dynamic-visemes"}.get(path.suffix, name)
        lips: LipModel = load_lip_model(inventory.language, kind)
        if path.suffix == ".json":
            lips = DynamicVisemes(load_parameters(path), inventory)
        predictor = load_lip_predictor(path) if path.suffix == ".npz" else default_predictor
        for delay_ms in delays_ms or [lip_model_info(kind).delay_ms]:
            faces[f"{name}, {delay_ms:g} ms"] = LiveFace(lips, predictor, delay_ms)
    return faces


def score_lips(
    folder: Path,
    names: Sequence[str],
    delays_ms: Sequence[float],
    music: Samples,
    conditions: Sequence[str],
    tables: Sequence[Path],
) -> Results:
    """Score faces (see ``load_faces``) on the held-out clips of a folder.

    ``tables`` are folders with the curves of other programs, which are scored with clean sound.
    With them, only the faces that are named are scored.
    """
    model = load_model()
    faces = {} if tables and not names else load_faces(names, delays_ms, model.inventory)
    parameters = [Path(name) for name in names if name.endswith(".json")]
    clips, training = read_parts(folder, parameters)
    programs = load_programs(tables, clips, training)
    training_speakers = {clip.speaker for clip in training}
    disturbances: dict[str, Disturb] = {CLEAN: lambda samples: samples}
    if faces and BABBLE in conditions:
        voices = babble([clip.samples for clip in clips])
        disturbances[BABBLE] = lambda samples: add_sound(samples, voices, _SNR_DB)
    if faces and MUSIC in conditions:
        disturbances[MUSIC] = lambda samples: add_sound(samples, music, _SNR_DB)
    scored_clips: dict[tuple[str, str, str], list[ScoredClip]] = {}
    for clip in track(clips, description="clips", transient=True):
        for title, condition, scored in scored_clips_of(model, clip, faces, disturbances, programs):
            for group in groups_of(clip, training_speakers):
                scored_clips.setdefault((title, condition, group), []).append(scored)
    results: Results = {}
    for (title, condition, group), members in scored_clips.items():
        measures = REAL_MEASURES if title == REAL else MEASURES
        scores = {name: measure(members) for name, measure in measures.items()}
        by_group = results.setdefault(title, {}).setdefault(condition, {})
        by_group[group] = {"clips": len(members), **scores}
    return results


def scored_clips_of(
    model: AcousticModel,
    clip: LipClip,
    faces: Mapping[str, LiveFace],
    disturbances: Mapping[str, Disturb],
    programs: Mapping[str, MouthFunction],
) -> Iterator[tuple[str, str, ScoredClip]]:
    """Yield title, condition and scored clip of the real mouth and of each face.

    The first condition must be CLEAN. Other programs follow in this condition.
    """
    predictors: dict[int, LipPredictor | None] = {
        id(face.predictor): face.predictor for face in faces.values()
    }
    delays_s = sorted({face.delay_ms / 1e3 for face in faces.values()} or {0.0})
    reference = None
    for condition, disturb in disturbances.items():
        samples = disturb(clip.samples)
        events = {
            key: live_events(model, samples, lips, delays_s)
            for key, lips in (predictors or {0: None}).items()
        }
        if reference is None:
            first_events = next(iter(events.values()))[delays_s[0]]
            reference = Reference(
                clip=clip,
                mouth=clip_mouth(clip),
                phones=aligned_phones(model, clip) or final_hypothesis(first_events),
                voice=[event for event in first_events if isinstance(event, SpeechChange)],
                visemes=model.inventory.visemes,
            )
            yield REAL, condition, ScoredClip(reference, reference.mouth)
            for title, mouth_of in programs.items():
                yield title, condition, ScoredClip(reference, mouth_of(clip))
        for title, face in faces.items():
            received = events[id(face.predictor)][face.delay_ms / 1e3]
            yield title, condition, ScoredClip(reference, face.mouth(received))


def groups_of(clip: LipClip, training_speakers: set[str]) -> list[str]:
    """Return the groups that a clip belongs to."""
    is_new = clip.speaker not in training_speakers
    return [
        ALL,
        clip.language,
        f"{clip.language} {'new' if is_new else 'known'}",
        *([] if clip.is_filmed else [MOCAP]),
        f"source {clip.source}",
        f"speaker {clip.speaker}",
    ]
