"""Measures of the four schemes (``four_schemes.py``) that need no judges.

- Agreement of the mouth with scheme 1 with the same lip model, which is the paper's upper bound,
  and with tracked lips: correlation, error and closures (``scores.py``). The lag of the opening
  with the highest correlation is the sync offset.
- The jerk of the opening.
- The phone delay: from a phone's onset in scheme 1 to the moment when the face receives the phone,
  in steps of 20 ms. Only phones whose first hypothesis is right count. The face adds its own delay.

Only the mouth moves, with an expressiveness of 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip
from kouxing.corpora.scoring import matched_pairs
from kouxing.evaluation.lips.four_schemes import (
    ALIGNED,
    RECOGNIZED,
    SCHEMES,
    Condition,
    RecognizedSentence,
    TestedRecognizer,
    all_conditions,
    face_input,
    make_frames,
)
from kouxing.evaluation.lips.measures import rms_jerk
from kouxing.evaluation.lips.schemes import FRAME_RATE_HZ, RecognizedClip, Scheme
from kouxing.evaluation.lips.scores import MEASURES, ClipScore, LipScore, pool, score_clip
from kouxing.services.lip_models import lip_model_info
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.recognizer.alignment import spoken
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone, Progress, SoundEvent
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]
Scores = dict[Condition, dict[int, ClipScore]]  # by condition and number of the sentence


@dataclass(slots=True, kw_only=True)
class ConditionScore:
    """One condition on all sentences."""

    scheme: int
    lips: str
    recognizer: str
    num_sentences: int
    face_delay_ms: float | None  # None: not live
    phone_delay_p50_ms: float | None
    phone_delay_p95_ms: float | None
    jerk: float | None  # of the opening, FAP units per second cubed
    like_scheme_1: LipScore | None
    like_real_lips: LipScore | None


@dataclass(slots=True, kw_only=True)
class Order:
    """Whether scheme 1 beats 2, 2 beats 3, and 3 beats 4, by the correlation of the opening."""

    lips: str
    recognizer: str
    reference: str  # "scheme 1" or "real lips"
    num_sentences: int  # with all four schemes
    correlations: list[float]  # of schemes 1 to 4, mean over the sentences
    holds: bool
    num_holding: int  # sentences in which it holds


@dataclass(slots=True, kw_only=True)
class Outcome:
    """Results of the experiment."""

    sentences: list[str]
    scores: list[ConditionScore]
    orders: list[Order]


def score_schemes(
    sentences: Sequence[RecognizedSentence],
    recognizers: Sequence[TestedRecognizer],
    lips: Sequence[str],
) -> Outcome:
    """Score all conditions; raises UserError if there are neither texts nor tracked lips."""
    if all(s.aligned is None and not len(s.sentence.clip.time_s) for s in sentences):
        raise UserError("no sentence has a text or tracked lips; use other sentences")
    conditions = all_conditions(recognizers, lips)
    mouths = {
        (condition, number): _mouth(condition, sentence)
        for condition in conditions
        for number, sentence in enumerate(sentences)
    }
    clips = [_recognized_clip(sentence, recognizers[0]) for sentence in sentences]
    inventory = recognizers[0].model.inventory
    like_aligned: Scores = {condition: {} for condition in conditions}
    like_real: Scores = {condition: {} for condition in conditions}
    for condition in track(conditions, description="measuring", transient=True):
        for number, clip in enumerate(clips):
            made = mouths[condition, number]
            reference = mouths[Condition(ALIGNED, condition.lips, ""), number]
            if made is not None and reference is not None:
                against = replace(clip, clip=_with_lips(clip.clip, reference))
                like_aligned[condition][number] = _score(condition, against, made)
            if made is not None and len(clip.clip.time_s):
                like_real[condition][number] = _score(condition, clip, made)
    return Outcome(
        sentences=[sentence.sentence.clip.name for sentence in sentences],
        scores=[
            _condition_score(
                condition,
                [m for n in range(len(sentences)) if (m := mouths[condition, n]) is not None],
                [d for s in sentences for d in phone_delays_s(condition, s, inventory)],
                like_aligned[condition],
                like_real[condition],
            )
            for condition in conditions
        ],
        orders=[
            *_orders("scheme 1", like_aligned, recognizers, lips),
            *_orders("real lips", like_real, recognizers, lips),
        ],
    )


def _mouth(condition: Condition, sentence: RecognizedSentence) -> Array | None:
    config = SynthesizerConfig(lips=condition.lips, idle_motion_seed=0, expressiveness=1.0)
    frames = make_frames(condition, sentence, config)
    return None if frames is None else np.array([faps for _, faps in frames], dtype=float)


def _recognized_clip(sentence: RecognizedSentence, recognizer: TestedRecognizer) -> RecognizedClip:
    clip, output = sentence.sentence.clip, sentence.outputs[recognizer.name]
    return RecognizedClip(
        clip=clip,
        num_frames=0,
        levels=level_track(clip.samples),
        events=output.live,
        inventory=recognizer.model.inventory,
        recognized=output.offline.phones,
        aligned=sentence.sentence.aligned,
    )


def _with_lips(clip: LipClip, made: Array) -> LipClip:
    """Return a clip whose tracked lips are made ones."""
    mouth = made[:, np.array(MOUTH_FAPS) - 1]
    return replace(clip, time_s=np.arange(len(mouth)) / FRAME_RATE_HZ, faps=mouth, is_in_sync=True)


def _score(condition: Condition, clip: RecognizedClip, made: Array) -> ClipScore:
    score = score_clip(clip, Scheme(condition.name, None, lambda _clip: made))
    assert score is not None  # noqa: S101 - this scheme applies to every clip
    return score


def _condition_score(
    condition: Condition,
    mouths: Sequence[Array],
    delays_s: Sequence[float],
    like_aligned: Mapping[int, ClipScore],
    like_real: Mapping[int, ClipScore],
) -> ConditionScore:
    p50, p95 = np.percentile(delays_s, [50, 95]) * 1e3 if delays_s else (None, None)
    is_live = condition.scheme > RECOGNIZED
    return ConditionScore(
        scheme=condition.scheme,
        lips=condition.lips,
        recognizer=condition.recognizer,
        num_sentences=len(mouths),
        face_delay_ms=lip_model_info(condition.lips).delay_ms if is_live else None,
        phone_delay_p50_ms=p50,
        phone_delay_p95_ms=p95,
        jerk=rms_jerk([MEASURES["opening"](mouth) for mouth in mouths], FRAME_RATE_HZ),
        like_scheme_1=_pool_all(like_aligned),
        like_real_lips=_pool_all(like_real),
    )


def _pool_all(scores: Mapping[int, ClipScore]) -> LipScore | None:
    pooled = pool(list(scores.values()))
    return next((score for score in pooled if score.kind == "all"), None)


def phone_delays_s(
    condition: Condition, sentence: RecognizedSentence, inventory: PhoneInventory
) -> list[float]:
    """Return the phone delays of a live condition, if the text is known."""
    if condition.scheme <= RECOGNIZED or sentence.sentence.aligned is None:
        return []
    events = face_input(condition, sentence.outputs[condition.recognizer])
    made = [pair for pair in first_hypotheses(events) if pair[0].symbol != inventory.silence]
    truth = spoken(sentence.sentence.aligned, inventory)
    pairs = matched_pairs([phone.symbol for phone in truth], [phone.symbol for phone, _ in made])
    return [
        made[j][1] - truth[i].onset_s
        for i, j in pairs
        if i is not None and j is not None and truth[i].symbol == made[j][0].symbol
    ]


def first_hypotheses(events: Sequence[SoundEvent]) -> list[tuple[Phone, float]]:
    """Return each phone as first received, and how much audio had been processed then, seconds."""
    first: dict[int, Phone] = {}
    times_s: list[float] = []
    for event in events:
        if isinstance(event, Phone):
            first.setdefault(event.index, event)
        elif isinstance(event, Progress):
            times_s += [event.time_s] * (len(first) - len(times_s))
    return list(zip(first.values(), times_s, strict=False))


def _orders(
    reference: str,
    scores: Scores,
    recognizers: Sequence[TestedRecognizer],
    lips: Sequence[str],
) -> Iterator[Order]:
    for name in lips:
        for recognizer in recognizers:
            schemes = [scores.get(Condition(ALIGNED, name, ""), {})]
            schemes += [scores.get(Condition(n, name, recognizer.name), {}) for n in SCHEMES[1:]]
            rows = [[_correlation(by_number.get(n)) for by_number in schemes] for n in schemes[0]]
            table = np.array([row for row in rows if None not in row], dtype=float)
            if len(table):
                means = table.mean(axis=0)
                yield Order(
                    lips=name,
                    recognizer=recognizer.name,
                    reference=reference,
                    num_sentences=len(table),
                    correlations=means.tolist(),
                    holds=is_decreasing(means),
                    num_holding=sum(is_decreasing(row) for row in table),
                )


def _correlation(score: ClipScore | None) -> float | None:
    opening = score.curves.get("opening") if score else None
    return opening.everything.correlation if opening else None


def is_decreasing(figures: Array) -> bool:
    """Whether each figure is less than the one before."""
    return bool((np.diff(figures) < 0.0).all())
