"""A speaker's voice learnt from clips and landmark files, and what it is worth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.landmark_file import SUFFIX, read_landmark_file
from kouxing.corpora.lip_clips import LipClip, read_clip
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.lip_positions import POSITION_S
from kouxing.services.recognizer.lip_tracks import MEASURES, lip_tracks
from kouxing.services.recognizer.lips import LIPS_PATH, LipPredictor, lips_for
from kouxing.services.recognizer.voice_learning import (
    FilmedSpeech,
    Material,
    VoiceGain,
    learn_voice,
    material_of,
    measure_gain,
)
from kouxing.shared.errors import UserError


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptedVoice:
    """A voice and what it is worth."""

    profile: bytes
    speech_s: float  # that it has learnt from
    gain: VoiceGain  # of a voice learnt from the first three quarters

    def figures(self) -> dict[str, object]:
        """Return the figures as ``kouxing adapt`` writes them; ``docs/my_mouth.md`` has them."""
        gain = self.gain
        curves = {
            measure: dict(zip(("tracked", "before", "after"), map(_plain, each), strict=True))
            for measure, each in zip(MEASURES, gain.curves, strict=True)
        }
        return {
            "speech_s": self.speech_s,
            "held_back_s": gain.speech_s,
            "delay_ms": 1e3 * gain.delay_s,
            "before": dict(zip(MEASURES, _plain(gain.before), strict=True)),
            "after": dict(zip(MEASURES, _plain(gain.after), strict=True)),
            "curves": {"time_s": _plain(gain.time_s), **curves},
        }


def adapt(sources: Sequence[Path]) -> AdaptedVoice:
    """Learn a voice from one speaker's clips and landmark files.

    Raises
    ------
    UserError
        If a source cannot be read, or there is too little speech with lips in view.
    """
    clips = [
        read_landmark_file(source) if source.suffix == SUFFIX else read_clip(source)
        for source in sources
    ]
    model, lips = load_models()
    material = Material.join([clip_material(model, lips, clip) for clip in clips])
    return AdaptedVoice(
        profile=learn_voice(material).to_profile(lips.digest),
        speech_s=len(material) * POSITION_S,
        gain=measure_gain(lips, material),
    )


def load_models(path: Path = LIPS_PATH) -> tuple[NeuralModel, LipPredictor]:
    """Load the acoustic model that ships and a model of lips.

    Raises
    ------
    UserError
        If they do not fit each other.
    """
    model = load_model()
    lips = lips_for(model, path)
    if lips is None or not isinstance(model, NeuralModel):
        raise UserError(f"{path} does not fit the neural acoustic model; train it again")
    return model, lips


def clip_material(model: NeuralModel, lips: LipPredictor, clip: LipClip) -> Material:
    """Return what can be learnt from a clip."""
    filmed = FilmedSpeech(samples=clip.samples, frame_s=clip.time_s, lips=lip_tracks(clip.faps))
    return material_of(model, lips, filmed)


def _plain(values: NDArray[np.float64]) -> list[float | None]:
    """Return numbers as JSON has them."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in values]
