"""Built-in lip models, faces and artificial speech for tests."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.services.lip_models import lip_model_info
from kouxing.services.synthesizer.face_animator import FaceAnimator, Frame
from kouxing.services.synthesizer.lips.dynamic_visemes.model import (
    DynamicVisemes,
    VisemeArticulation,
)
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.timeline import build_timeline
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.services.synthesizer.lips.lip_model import Articulation
from kouxing.services.synthesizer.modifiers.modifier import FrameContext
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.phones.events import Phone, Progress
from kouxing.shared.phones.inventory import load_inventory

INVENTORY = load_inventory()
LIPS = DynamicVisemes(load_parameters(), INVENTORY)
DELAY_S = lip_model_info("dynamic-visemes").delay_ms / 1e3
SILENT_DB = -120.0
JAW, LOWER_LIP, WIDTH = (MOUTH_FAPS.index(fap) for fap in (3, 5, 6))


UPPER, LOWER = np.array([[4, 8, 9, 51, 55, 56], [5, 10, 11, 52, 57, 58]]) - 1  # FAPs of each lip


def viseme_faps(viseme: str) -> NDArray[np.float32]:
    """Return the FAPs (68,) of a viseme's target."""
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = LIPS.parameters.target[VISEME_INDEX[viseme]]
    return faps


def lip_gaps(faps: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return how far the upper lip (..., 6) is from the lower lip, FAP units."""
    gaps: NDArray[np.float32] = -(faps[..., UPPER] + faps[..., LOWER])
    return gaps


def make_face(
    *, delay_s: float = DELAY_S, frame_rate_hz: float = 50.0, idle_motion_seed: int = 0
) -> FaceAnimator:
    return FaceAnimator(
        LIPS,
        frame_rate_hz=frame_rate_hz,
        delay_s=delay_s,
        idle_motion=idle_motion_seed > 0,
        idle_motion_seed=idle_motion_seed,
    )


def phone(
    index: int, symbol: str, onset_s: float, duration_s: float = 0.15, *, final: bool = True
) -> Phone:
    return Phone(
        index=index,
        symbol=symbol,
        onset_s=onset_s,
        duration_s=duration_s,
        confidence=1.0,
        final=final,
    )


def advance(face: FaceAnimator, time_s: float) -> list[Frame]:
    """Advance silent sound to a time; return the due frames."""
    return face.process(Progress(time_s=time_s, level_db=SILENT_DB))


def frame_context(
    time_s: float,
    articulation: Articulation | None = None,
    levels: Sequence[tuple[float, float]] = (),
    step_s: float = 0.02,
) -> FrameContext:
    """Return a context during speech, by default without levels and phones."""
    return FrameContext(
        time_s=time_s,
        known_s=time_s,
        elapsed_s=time_s,
        step_s=step_s,
        is_speaking=True,
        levels=levels,
        articulation=articulation or articulation_of(()),
    )


def articulation_of(phones: Sequence[Phone]) -> VisemeArticulation:
    return VisemeArticulation(build_timeline(phones, INVENTORY), LIPS.parameters.level_db)


def utterance(seed: int, num_phones: int) -> list[Phone]:
    rng = np.random.default_rng(seed)
    onset_s, phones = 0.3, []
    for index in range(num_phones):
        symbol = str(rng.choice(["d", "g", "sh", "b"] if index % 2 == 0 else ["a", "i", "u"]))
        duration_s = float(rng.uniform(0.06, 0.25))
        phones.append(phone(index, symbol, onset_s, duration_s))
        onset_s += duration_s + (0.5 if rng.random() < 0.15 and index % 2 else 0.0)
    return phones


def clip_of(time_s: NDArray[np.float64], faps: NDArray[np.float64]) -> LipClip:
    return LipClip(
        name="made_up",
        speaker="nobody",
        license="CC0",
        language="zh",
        split="held",
        time_s=time_s,
        faps=faps,
        samples=np.zeros(0, dtype=np.float32),
    )
