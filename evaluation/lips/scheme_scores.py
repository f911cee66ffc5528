"""Measures of the four schemes (``four_schemes.py``) that need no judges.

- Agreement of the mouth with scheme 1 with the same lip model, which is the paper's upper bound,
  and with tracked lips: correlation, error and closures. The lag of the opening with the highest
  correlation is the sync offset.
- The jerk of the opening.
- The phone delay: from a phone's onset in scheme 1 to the moment when the face receives the phone,
  in steps of 20 ms. Only phones whose first hypothesis is right count. The face adds its own delay.

Only the mouth moves, with an expressiveness of 1.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from kouxing.corpora.lip_clips import LipClip
from kouxing.corpora.scoring import align_symbols
from kouxing.evaluation.lips.agreement import Agreement, MouthPair, agreement_of
from kouxing.evaluation.lips.curves import rms_jerk
from kouxing.evaluation.lips.four_schemes import (
    ALIGNED,
    RECOGNIZED,
    Condition,
    RecognizedSentence,
    RecognizerSetup,
    all_conditions,
    face_input,
    make_frames,
)
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import Mouth, clip_mouth, predicted_mouth, real_mouth
from kouxing.evaluation.percentiles import percentiles
from kouxing.services.lip_models import lip_model_info
from kouxing.services.recognizer.offline.alignment import drop_pauses
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, Progress, SoundEvent
from kouxing.shared.phones.inventory import PhoneInventory


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
    jerk: float | None  # jerk of the opening, FAP units per second cubed
    like_scheme_1: Agreement | None
    like_real_lips: Agreement | None


def score_schemes(
    sentences: Sequence[RecognizedSentence],
    recognizers: Sequence[RecognizerSetup],
    lips: Sequence[str],
) -> list[ConditionScore]:
    """Score all conditions; raises ``UserError`` if there are neither texts nor tracked lips."""
    if all(s.aligned is None and not len(s.sentence.clip.time_s) for s in sentences):
        raise UserError("no sentence has a text or tracked lips")
    conditions = all_conditions(recognizers, lips)
    frames = {
        condition: [_mouth_frames(condition, sentence) for sentence in sentences]
        for condition in conditions
    }
    clips = [sentence.sentence.clip for sentence in sentences]
    inventory = recognizers[0].model.inventory
    scores = []
    for condition in conditions:
        aligned = frames[Condition(ALIGNED, condition.lips, "")]
        delays_s = [d for s in sentences for d in phone_delays_s(condition, s, inventory)]
        scores.append(_score_condition(condition, frames[condition], aligned, clips, delays_s))
    return scores


def _mouth_frames(condition: Condition, sentence: RecognizedSentence) -> Doubles | None:
    config = SynthesizerConfig(
        lips=condition.lips, idle_motion=False, expressiveness=1.0, feeling=0.0
    )
    frames = make_frames(condition, sentence, config)
    return None if frames is None else np.array([faps for _, faps in frames], dtype=float)


def _score_condition(
    condition: Condition,
    frames: Sequence[Doubles | None],
    aligned: Sequence[Doubles | None],
    clips: Sequence[LipClip],
    delays_s: Sequence[float],
) -> ConditionScore:
    """Compare frames with those of scheme 1, and with tracked lips, sentence by sentence."""
    mouths: list[Mouth] = []
    with_aligned: list[MouthPair] = []
    with_tracked: list[MouthPair] = []
    for faps, reference, clip in zip(frames, aligned, clips, strict=True):
        if faps is None:
            continue
        mouth = predicted_mouth(faps)
        mouths.append(mouth)
        if reference is not None:
            time_s = np.arange(len(reference)) / FRAME_RATE_HZ
            with_aligned.append((mouth, real_mouth(time_s, reference)))
        if len(clip.time_s):
            with_tracked.append((mouth, clip_mouth(clip)))
    is_live = condition.scheme > RECOGNIZED
    delay_ms = percentiles(1e3 * np.array(delays_s))
    return ConditionScore(
        scheme=condition.scheme,
        lips=condition.lips,
        recognizer=condition.recognizer,
        num_sentences=len(mouths),
        face_delay_ms=lip_model_info(condition.lips).delay_ms if is_live else None,
        phone_delay_p50_ms=delay_ms.get("p50"),
        phone_delay_p95_ms=delay_ms.get("p95"),
        jerk=rms_jerk([mouth.opening for mouth in mouths], FRAME_RATE_HZ),
        like_scheme_1=agreement_of(with_aligned) if with_aligned else None,
        like_real_lips=agreement_of(with_tracked) if with_tracked else None,
    )


def phone_delays_s(
    condition: Condition, sentence: RecognizedSentence, inventory: PhoneInventory
) -> list[float]:
    """Return the phone delays of a live condition, if the text is known."""
    if condition.scheme <= RECOGNIZED or sentence.sentence.aligned is None:
        return []
    events = face_input(condition, sentence.outputs[condition.recognizer])
    hypotheses = [pair for pair in first_hypotheses(events) if pair[0].symbol != inventory.silence]
    truth = drop_pauses(sentence.sentence.aligned, inventory)
    pairs = align_symbols(
        [phone.symbol for phone in truth], [phone.symbol for phone, _ in hypotheses]
    )
    return [
        hypotheses[j][1] - truth[i].onset_s
        for i, j in pairs
        if i is not None and j is not None and truth[i].symbol == hypotheses[j][0].symbol
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
