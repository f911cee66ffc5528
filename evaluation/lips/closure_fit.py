"""How the learnt lips weigh evidence of closures: settings compared on clips for choices.

Each constant of ``ClosureRule`` is varied alone, from the best found so far. What counts is, as a
mean over speakers, the correlation of the opening, the F1 of closures, and by half the share of
b p m that close. So a closure too many counts as much as one that is missed.

The model of lips trains on clips for choices, too, where their licence allows it; on those it knows
closures better than on a stranger's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rich.console import Console
from rich.progress import track

from kouxing.corpora.lip_clips import read_clips
from kouxing.evaluation.lips.clip_scores import score_clip
from kouxing.evaluation.lips.schemes import DEFAULT_DELAY_S, HeardClip, hear, live_scheme
from kouxing.evaluation.lips.scores import pool
from kouxing.services.recognizer.acoustic.load import load_live_model
from kouxing.services.recognizer.lips import lips_for
from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.learnt.closures import ClosureRule
from kouxing.services.synthesizer.lips.learnt.model import LearntLips
from kouxing.shared.errors import UserError

TRIED = {
    "sound": (1.0, 1.5, 2.0, 2.5),
    "phone": (1.5, 2.2, 3.0),
    "doubt": (0.4, 0.8, 1.2),
    "parted": (0.0, 0.01, 0.02),
    "rounded": (0.0, 0.012, 0.024),
}


@dataclass(frozen=True, slots=True)
class RuleScore:
    """What a setting reaches."""

    rule: ClosureRule
    correlation: float  # of the opening, mean over speakers
    f1: float  # of closures, mean over speakers
    bpm: float  # share that close, mean over speakers

    @property
    def total(self) -> float:
        """What is to be as large as possible."""
        return self.correlation + self.f1 + 0.5 * self.bpm


def main(folder: Path) -> list[RuleScore]:
    """Score settings on the clips for choices of a folder; the best of all comes last.

    Raises
    ------
    UserError
        If there is no such clip in sync.
    """
    model = load_live_model()
    lips = lips_for(model)
    clips = [
        clip
        for clip in read_clips(folder, language=None)
        if clip.part == "choice" and clip.is_in_sync
    ]
    if not clips:
        raise UserError(f"{folder}: no clip is for choices and in sync")
    heard = [
        hear(model, clip, lips, (DEFAULT_DELAY_S,))
        for clip in track(clips, description="clips", transient=True)
    ]
    return compare(DynamicVisemes(load_parameters(), model.inventory), heard)


def compare(visemes: DynamicVisemes, heard: Sequence[HeardClip]) -> list[RuleScore]:
    """Score settings on some clips; the best of all comes last."""
    best = _score(visemes, ClosureRule(), heard)
    scores = []
    for name, values in TRIED.items():
        tried = [_score(visemes, replace(best.rule, **{name: value}), heard) for value in values]
        scores += tried
        best = max(best, *tried, key=lambda score: score.total)
    return [*scores, best]


def _score(visemes: DynamicVisemes, rule: ClosureRule, heard: Sequence[HeardClip]) -> RuleScore:
    scheme = live_scheme("learnt", LearntLips(visemes, rule), DEFAULT_DELAY_S)
    found = [score for each in heard if (score := score_clip(each, scheme)) is not None]
    pooled = [score for score in pool(found) if score.kind == "speaker"]
    f1 = [score.closures.f1 for score in pooled]
    openings = [
        score.curves["opening"].correlation for score in pooled if "opening" in score.curves
    ]
    bpm = [score.bpm_met / score.bpm for score in pooled if score.bpm]
    return RuleScore(rule, *(_mean(figures) for figures in (openings, f1, bpm)))


def _mean(figures: Sequence[float | None]) -> float:
    known = [figure for figure in figures if figure is not None]
    return sum(known) / len(known) if known else 0.0


def print_scores(scores: Sequence[RuleScore], console: Console) -> None:
    """Print a line for each setting."""
    for score in scores:
        console.print(
            f"correlation {score.correlation:.3f}, F1 {score.f1:.3f}, b p m that close "
            f"{score.bpm:.3f}: {score.rule}"
        )
