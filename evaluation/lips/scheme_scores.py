"""Measures of the four schemes (``four_schemes.py``) that need no judges.

- Agreement of the mouth with scheme 1 with the same lip model, which is the paper's upper bound,
  and with tracked lips: correlation, error and closures. The lag of the opening with the highest
  correlation is the sync offset.
- The jerk of the opening.
- The phone delay: from a phone's onset in scheme 1 to the moment when the face receives the phone,
  in steps of 20 ms. Only phones whose first hypothesis is right count. The face adds its own delay.

Only the mouth moves, with an expressiveness of 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.scoring import matched_pairs
from kouxing.evaluation.lips.agreement import Agreement, Pair, agreement_of, moments
from kouxing.evaluation.lips.curves import rms_jerk
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
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import made_mouth, real_faps, real_mouth
from kouxing.services.lip_models import lip_model_info
from kouxing.services.recognizer.alignment import spoken
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, Progress, SoundEvent
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]
Pairs = dict[Condition, dict[int, Pair]]  # by condition and number of the sentence


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
    like_scheme_1: Agreement | None
    like_real_lips: Agreement | None


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
    frames = {
        (condition, number): _mouth_frames(condition, sentence)
        for condition in conditions
        for number, sentence in enumerate(sentences)
    }
    inventory = recognizers[0].model.inventory
    like_aligned: Pairs = {condition: {} for condition in conditions}
    like_real: Pairs = {condition: {} for condition in conditions}
    for (condition, number), faps in frames.items():
        clip = sentences[number].sentence.clip
        reference = frames[Condition(ALIGNED, condition.lips, ""), number]
        if faps is not None and reference is not None:
            time_s = np.arange(len(reference)) / FRAME_RATE_HZ
            like_aligned[condition][number] = made_mouth(faps), real_mouth(time_s, reference)
        if faps is not None and len(clip.time_s):
            real = real_mouth(clip.time_s, real_faps(clip))
            like_real[condition][number] = made_mouth(faps), real
    return Outcome(
        sentences=[sentence.sentence.clip.name for sentence in sentences],
        scores=[
            _condition_score(
                condition,
                [f for n in range(len(sentences)) if (f := frames[condition, n]) is not None],
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


def _mouth_frames(condition: Condition, sentence: RecognizedSentence) -> Array | None:
    config = SynthesizerConfig(lips=condition.lips, idle_motion_seed=0, expressiveness=1.0)
    frames = make_frames(condition, sentence, config)
    return None if frames is None else np.array([faps for _, faps in frames], dtype=float)


def _condition_score(
    condition: Condition,
    frames: Sequence[Array],
    delays_s: Sequence[float],
    like_aligned: Mapping[int, Pair],
    like_real: Mapping[int, Pair],
) -> ConditionScore:
    p50, p95 = np.percentile(delays_s, [50, 95]) * 1e3 if delays_s else (None, None)
    is_live = condition.scheme > RECOGNIZED
    return ConditionScore(
        scheme=condition.scheme,
        lips=condition.lips,
        recognizer=condition.recognizer,
        num_sentences=len(frames),
        face_delay_ms=lip_model_info(condition.lips).delay_ms if is_live else None,
        phone_delay_p50_ms=p50,
        phone_delay_p95_ms=p95,
        jerk=rms_jerk([made_mouth(faps).opening for faps in frames], FRAME_RATE_HZ),
        like_scheme_1=agreement_of([*like_aligned.values()]) if like_aligned else None,
        like_real_lips=agreement_of([*like_real.values()]) if like_real else None,
    )


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
    pairs: Pairs,
    recognizers: Sequence[TestedRecognizer],
    lips: Sequence[str],
) -> Iterator[Order]:
    for name in lips:
        for recognizer in recognizers:
            schemes = [pairs.get(Condition(ALIGNED, name, ""), {})]
            schemes += [pairs.get(Condition(n, name, recognizer.name), {}) for n in SCHEMES[1:]]
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


def _correlation(pair: Pair | None) -> float | None:
    return moments([pair], "opening").correlation if pair else None


def is_decreasing(figures: Array) -> bool:
    """Whether each figure is less than the one before."""
    return bool((np.diff(figures) < 0.0).all())
