"""What a speaker's own lips bring: correlation before and after learning from some seconds of them.

A speaker's clips that are held out are scored; where there are fewer than three of them, the last
40 % of each clip. The voice learns from pieces of 5 s of the rest, drawn at random a few times.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table

from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.corpora.speech_corpus import may_ship
from kouxing.services.mouth_profiles.adapt import load_models
from kouxing.services.mouth_profiles.learning import (
    FACE_DELAY_S,
    Observations,
    apply_profile,
    correlations,
    fit_profile,
    observe,
)
from kouxing.services.mouth_profiles.lip_tracks import MEASURES
from kouxing.services.mouth_profiles.positions import POSITION_S
from kouxing.services.recognizer.lip_source import delay_for
from kouxing.shared.errors import UserError

Array = NDArray[np.float64]

AMOUNTS_S = (20, 40, 80)
NUM_DRAWS = 5
_PIECE = 250  # positions
_MIN_HELD_CLIPS = 3
_LEARNT_SHARE = 0.6  # of a clip of a speaker with fewer
_MIN_HELD_S = 8.0


@dataclass(frozen=True, slots=True, kw_only=True)
class VoiceScore:
    """What some seconds of one speaker's lips bring."""

    speaker: str
    learnt_s: float
    held_s: float
    before: dict[str, float]  # correlations of ``MEASURES``
    after: dict[str, float]  # mean over the draws


def score_voices(folder: Path, lips: Path, speakers: Sequence[str] = ()) -> list[VoiceScore]:
    """Score what adaptation brings for some speakers.

    Parameters
    ----------
    folder
        Clips, in any language and of any licence.
    lips
        The model of lips to begin with.
    speakers
        None of them may have been trained on. Empty: all whose licence, or whose part as held out,
        forbids it, who have enough speech.

    Raises
    ------
    UserError
        If there are no such clips, or a speaker has too little speech.
    """
    by_speaker: dict[str, list[LipClip]] = {}
    for clip in read_clips(folder, any_licence=True, language=None):
        if clip.is_in_sync:
            by_speaker.setdefault(clip.speaker, []).append(clip)
    unknown = {*speakers} - {*by_speaker}
    if unknown:
        raise UserError(f"{folder} has no clips in sync of {', '.join(sorted(unknown))}")
    chosen = speakers or [name for name, clips in by_speaker.items() if _is_stranger(clips)]
    model, predictor = load_models(lips)
    delay = predictor.delays_s.index(delay_for(predictor.delays_s, FACE_DELAY_S))
    scores = []
    for speaker in track(chosen, description="speakers"):
        clips = by_speaker[speaker]
        materials = [observe(model, predictor, clip.filmed_speech()) for clip in clips]
        learnt, held = _split(clips, materials)
        if len(learnt) >= _positions(AMOUNTS_S[0]) and _seconds(held) >= _MIN_HELD_S:
            scores += _scores(speaker, learnt, held, delay)
        elif speakers:
            raise UserError(f"{speaker} has too little speech in {folder}")
    return scores


def _is_stranger(clips: Sequence[LipClip]) -> bool:
    return all(clip.part == "held" or not may_ship(clip.licence) for clip in clips)


def _split(
    clips: Sequence[LipClip], materials: Sequence[Observations]
) -> tuple[Observations, list[Observations]]:
    """Return what may be learnt from, and what is scored."""
    held = [
        material for clip, material in zip(clips, materials, strict=True) if clip.part == "held"
    ]
    rest = [
        material for clip, material in zip(clips, materials, strict=True) if clip.part != "held"
    ]
    if len(held) < _MIN_HELD_CLIPS:
        ends = [round(_LEARNT_SHARE * len(material)) for material in materials]
        held = [material[end:] for material, end in zip(materials, ends, strict=True)]
        rest = [material[:end] for material, end in zip(materials, ends, strict=True)]
    return Observations.join(rest), [material for material in held if len(material)]


def _scores(
    speaker: str, learnt: Observations, held: Sequence[Observations], delay: int
) -> list[VoiceScore]:
    before = correlations(held, [material.predicted for material in held], delay)
    pieces = [learnt[start : start + _PIECE] for start in range(0, len(learnt), _PIECE)]
    amounts = [_positions(amount_s) for amount_s in AMOUNTS_S]
    scores = []
    for amount in sorted({min(amount, len(learnt)) for amount in amounts}):
        rng = np.random.default_rng(0)
        after = []
        for _ in range(NUM_DRAWS):
            drawn = Observations.join([pieces[index] for index in rng.permutation(len(pieces))])
            voice = fit_profile(drawn[:amount])
            made = [apply_profile(voice, material) for material in held]
            after.append(correlations(held, made, delay))
        scores.append(
            VoiceScore(
                speaker=speaker,
                learnt_s=amount * POSITION_S,
                held_s=_seconds(held),
                before=_by_measure(before),
                after=_by_measure(np.mean(after, axis=0)),
            )
        )
    return scores


def _by_measure(figures: Array) -> dict[str, float]:
    return dict(zip(MEASURES, figures.tolist(), strict=True))


def _positions(duration_s: float) -> int:
    return round(duration_s / POSITION_S)


def _seconds(materials: Sequence[Observations]) -> float:
    return sum(map(len, materials)) * POSITION_S


def print_scores(scores: Sequence[VoiceScore], console: Console) -> None:
    """Print the scores, a row for each speaker and amount."""
    table = Table("speaker", "learnt from", "scored on", *MEASURES)
    for score in scores:
        gains = [f"{score.before[name]:.2f} -> {score.after[name]:.2f}" for name in MEASURES]
        table.add_row(score.speaker, f"{score.learnt_s:.0f} s", f"{score.held_s:.0f} s", *gains)
    console.print(table)
