"""Kouxing's lip models beside HeadAudio, wLipSync and loudness, at the same delays.

A frame for time t of a face with a delay d may use all sound up to t + d, whoever makes it. The
others count through the best linear map (``linear_map.py``), learnt from the same clips as the
learnt lips are; HeadAudio also as it comes: its visemes' weights times their FAPs, the time
at which they lag least compensated as far as the delay allows. wLipSync has no mouth of its own.
Scores are those of ``kouxing evaluate lips``, on the same held clips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.figures import new_figure
from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.corpora.speech_corpus import may_ship
from kouxing.evaluation.lips.clip_scores import MEASURES, score_clip
from kouxing.evaluation.lips.rivals.linear_map import fit
from kouxing.evaluation.lips.rivals.rows import (
    HEAD_AUDIO_VISEMES,
    ROW_S,
    Rows,
    head_audio_rows,
    loudness_rows,
    oculus_order,
    wlipsync_profile,
    wlipsync_rows,
)
from kouxing.evaluation.lips.schemes import FRAME_RATE_HZ, HeardClip, Scheme, hear, live_scheme
from kouxing.evaluation.lips.scores import LipScore, clips_to_score, pool
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lips import lips_for
from kouxing.services.synthesizer.lips.load import LIP_MODELS
from kouxing.shared.errors import UserError
from kouxing.shared.face.high_level import VISEMES

Array = NDArray[np.float64]

DELAYS_S = (0.0, 0.05, 0.1, 0.16)
# by which HeadAudio's own visemes lag behind lips, on clips that are not held
_HEAD_AUDIO_LAG_S = 0.14


def main(folder: Path) -> list[LipScore]:
    """Score all on the held clips of a folder.

    Raises
    ------
    UserError
        If there are no clips to learn from or to score, or a package is missing.
    """
    model = load_live_model()
    lips = lips_for(model)
    held = clips_to_score(folder, None)
    learnt_from = [
        clip
        for clip in read_clips(folder, language=None)
        if clip.part != "held" and may_ship(clip.licence)
    ]
    if not learnt_from:
        raise UserError(f"{folder}: no clip may be learnt from; give clips with a free licence")
    clips = [*learnt_from, *held]
    head_audio = _rows("HeadAudio", head_audio_rows, clips)
    found = {name: rows[:, len(HEAD_AUDIO_VISEMES) :] for name, rows in head_audio.items()}
    wlipsync = wlipsync_rows(wlipsync_profile(model, learnt_from))
    schemes = [
        *(
            live_scheme(name, make(model.inventory), delay_s)
            for name, make in LIP_MODELS.items()
            for delay_s in DELAYS_S
        ),
        *(as_it_comes(head_audio, delay_s) for delay_s in DELAYS_S),
        *mapped("HeadAudio", found, learnt_from),
        *mapped("wLipSync", _rows("wLipSync", wlipsync, clips), learnt_from),
        *mapped("loudness", _rows("loudness", loudness_rows, clips), learnt_from),
    ]
    scores = []
    for clip in track(held, description="clips", transient=True):
        heard = hear(model, clip, lips, DELAYS_S)
        made = [score_clip(heard, scheme) for scheme in schemes]
        scores += [score for score in made if score is not None]
    return pool(scores)


def _rows(name: str, rows: Rows, clips: Sequence[LipClip]) -> dict[str, Array]:
    return {clip.name: rows(clip) for clip in track(clips, description=name, transient=True)}


def as_it_comes(rows: Mapping[str, Array], delay_s: float) -> Scheme:
    """Return HeadAudio's own mouth from its rows for each clip, by name."""

    def frames(heard: HeardClip) -> Array:
        weights = oculus_order(rows[heard.clip.name][:, : len(HEAD_AUDIO_VISEMES)])
        time_s = np.arange(heard.num_frames) / FRAME_RATE_HZ + min(delay_s, _HEAD_AUDIO_LAG_S)
        faps: Array = weights[np.floor(time_s / ROW_S + 1e-6).astype(int)] @ VISEMES
        return faps

    return Scheme("HeadAudio as is", delay_s, frames)


def mapped(name: str, rows: Mapping[str, Array], learnt_from: Sequence[LipClip]) -> list[Scheme]:
    """Return what the best linear map makes of rows for each clip, by name, at each delay."""

    def scheme(delay_s: float) -> Scheme:
        linear = fit(learnt_from, rows, delay_s)
        return Scheme(
            f"{name}, mapped",
            delay_s,
            lambda heard: linear.frames(rows[heard.clip.name], heard.num_frames),
        )

    return [scheme(delay_s) for delay_s in DELAYS_S]


def figure(scores: Sequence[LipScore]) -> Any:
    """Draw correlation in speech and closures' F1 over the delay: a row for each language."""
    languages = sorted({score.group for score in scores if score.kind == "language"})
    names = [*MEASURES, "closures"]
    drawn = new_figure(3.2 * len(names), 3.0 * len(languages))
    axes = drawn.subplots(len(languages), len(names), sharex=True, sharey=True, squeeze=False)
    for row, language in zip(axes, languages, strict=True):
        for axis, name in zip(row, names, strict=True):
            axis.set_title(f"{language}: {name}", fontsize=9)
            for scheme in dict.fromkeys(score.scheme for score in scores):
                shown = [s for s in scores if (s.group, s.scheme) == (language, scheme)]
                values = [_value(score, name) for score in shown]
                axis.plot([score.delay_ms for score in shown], values, marker=".", label=scheme)
    axes[-1, 0].set_xlabel("delay, ms")
    axes[-1, -1].legend(fontsize=7)
    return drawn


def _value(score: LipScore, name: str) -> float:
    """Return a figure; nan where it was not measured."""
    if name == "closures":
        value = score.closures.f1
    else:
        curve = score.curves.get(name)
        value = curve.correlation_in_speech if curve else None
    return np.nan if value is None else value
