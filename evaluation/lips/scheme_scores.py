"""What can be measured of the four schemes (``four_schemes.py``) without people who judge videos.

As ``scores.py`` defines it:

- how alike the mouth is to that of scheme 1 with the same lip model, the paper's upper bound, and
  to tracked lips where there are any: correlation, error in FAP units, closures, and as the sync
  offset the lag of the best correlation of the opening;
- the jerk of the opening;
- the phone delay: from a phone's onset in scheme 1 to the moment in which the face is told of it,
  in steps of 20 ms; of the phones that are right at first. The face waits for its own delay, and
  sound waits for the face.

The mouth alone moves, with an expressiveness of 1.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from rich.progress import track

from kouxing.corpora.lip_clips import LipClip
from kouxing.corpora.scoring import matched_pairs
from kouxing.evaluation.lips.clip_scores import MEASURES, ClipScore, score_clip
from kouxing.evaluation.lips.four_schemes import (
    BOUND,
    RECOGNISED,
    SCHEMES,
    Condition,
    HeardSentence,
    Listener,
    conditions_of,
    events_told,
    face_of,
)
from kouxing.evaluation.lips.measures import rms_jerk
from kouxing.evaluation.lips.schemes import FRAME_RATE_HZ, HeardClip, Scheme
from kouxing.evaluation.lips.scores import LipScore, pool
from kouxing.services.lip_models import lip_model_info
from kouxing.services.mouth_profiles.lip_tracks import level_track
from kouxing.services.recognizer.alignment import spoken
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import Phone, Progress, SoundEvent
from kouxing.shared.phones.inventory import PhoneInventory

Array = NDArray[np.float64]
Scores = Mapping[Condition, Mapping[int, ClipScore]]  # by condition and number of the sentence


@dataclass(slots=True, kw_only=True)
class ConditionScore:
    """What one condition reaches on all sentences."""

    scheme: int
    lips: str
    recognizer: str
    num_sentences: int
    face_delay_ms: float | None  # None: everything is known
    phone_delay_p50_ms: float | None
    phone_delay_p95_ms: float | None
    jerk: float | None  # of the opening, FAP units a second cubed
    like_scheme_1: LipScore | None
    like_real_lips: LipScore | None


@dataclass(slots=True, kw_only=True)
class Order:
    """Whether scheme 1 is better than 2, 2 than 3, 3 than 4, by the correlation of the opening."""

    lips: str
    recognizer: str
    reference: str  # "scheme 1" or "real lips"
    num_sentences: int  # which all four schemes can be made of
    correlations: list[float]  # of schemes 1 to 4, means over the sentences
    holds: bool
    num_holding: int  # sentences in which it holds


@dataclass(slots=True, kw_only=True)
class Outcome:
    """The experiment's figures."""

    sentences: list[str]
    scores: list[ConditionScore]
    orders: list[Order]


def evaluate(
    heard: Sequence[HeardSentence], listeners: Sequence[Listener], lips: Sequence[str]
) -> Outcome:
    """Measure all conditions.

    Raises
    ------
    UserError
        If nothing can be compared: there are neither texts nor tracked lips.
    """
    if all(each.aligned is None and not len(each.sentence.clip.time_s) for each in heard):
        raise UserError("no sentence has a text or tracked lips; give others")
    conditions = conditions_of(listeners, lips)
    mouths = {
        (condition, number): _mouth(condition, each)
        for condition in conditions
        for number, each in enumerate(heard)
    }
    basis = [_as_clip(each, listeners[0]) for each in heard]
    inventory = listeners[0].model.inventory
    like_bound: dict[Condition, dict[int, ClipScore]] = {}
    like_real: dict[Condition, dict[int, ClipScore]] = {}
    for condition in track(conditions, description="measuring", transient=True):
        bound = Condition(BOUND, condition.lips, "")
        real_found = like_real.setdefault(condition, {})
        bound_found = like_bound.setdefault(condition, {})
        for number, clip in enumerate(basis):
            made, reference = mouths[condition, number], mouths[bound, number]
            if made is not None and reference is not None:
                traced = replace(clip, clip=_traced(clip.clip, reference))
                bound_found[number] = _score(condition, traced, made)
            if made is not None and len(clip.clip.time_s):
                real_found[number] = _score(condition, clip, made)
    return Outcome(
        sentences=[each.sentence.clip.name for each in heard],
        scores=[
            _pooled(
                condition,
                [mouth for n in range(len(heard)) if (mouth := mouths[condition, n]) is not None],
                [delay for each in heard for delay in phone_delays(condition, each, inventory)],
                list(like_bound[condition].values()),
                list(like_real[condition].values()),
            )
            for condition in conditions
        ],
        orders=[
            *_orders("scheme 1", like_bound, listeners, lips),
            *_orders("real lips", like_real, listeners, lips),
        ],
    )


def _mouth(condition: Condition, heard: HeardSentence) -> Array | None:
    config = SynthesizerConfig(lips=condition.lips, idle_motion_seed=0, expressiveness=1.0)
    frames = face_of(condition, heard, config)
    return None if frames is None else np.array([faps for _, faps in frames], dtype=float)


def _as_clip(heard: HeardSentence, listener: Listener) -> HeardClip:
    clip, hearing = heard.sentence.clip, heard.hearings[listener.name]
    return HeardClip(
        clip=clip,
        num_frames=0,
        levels=level_track(clip.samples),
        events=hearing.live,
        inventory=listener.model.inventory,
        recognised=hearing.recognised.phones,
        aligned=heard.sentence.aligned,
    )


def _traced(clip: LipClip, made: Array) -> LipClip:
    """Return a clip whose lips are made ones."""
    mouth = made[:, np.array(MOUTH_FAPS) - 1]
    return replace(clip, time_s=np.arange(len(mouth)) / FRAME_RATE_HZ, faps=mouth, is_in_sync=True)


def _score(condition: Condition, heard: HeardClip, made: Array) -> ClipScore:
    score = score_clip(heard, Scheme(condition.name, None, lambda _heard: made))
    assert score is not None  # noqa: S101 - the scheme makes something of every clip
    return score


def _pooled(
    condition: Condition,
    mouths: Sequence[Array],
    phone_delays_s: Sequence[float],
    like_bound: Sequence[ClipScore],
    like_real: Sequence[ClipScore],
) -> ConditionScore:
    p50, p95 = np.percentile(phone_delays_s, [50, 95]) * 1e3 if phone_delays_s else (None, None)
    is_live = condition.scheme > RECOGNISED
    return ConditionScore(
        scheme=condition.scheme,
        lips=condition.lips,
        recognizer=condition.recognizer,
        num_sentences=len(mouths),
        face_delay_ms=lip_model_info(condition.lips).delay_ms if is_live else None,
        phone_delay_p50_ms=p50,
        phone_delay_p95_ms=p95,
        jerk=rms_jerk([MEASURES["opening"](mouth) for mouth in mouths], FRAME_RATE_HZ),
        like_scheme_1=_all_of(like_bound),
        like_real_lips=_all_of(like_real),
    )


def _all_of(scores: Sequence[ClipScore]) -> LipScore | None:
    return next((score for score in pool(scores) if score.kind == "all"), None)


def phone_delays(
    condition: Condition, heard: HeardSentence, inventory: PhoneInventory
) -> list[float]:
    """Time from each true phone's onset to when the face is told of it, seconds.

    Of the phones that are right at first; none where nothing is live or the text is not known.
    """
    if condition.scheme <= RECOGNISED or heard.sentence.aligned is None:
        return []
    told = first_told(events_told(condition, heard.hearings[condition.recognizer]))
    made = [(phone, time_s) for phone, time_s in told if phone.symbol != inventory.silence]
    truth = spoken(heard.sentence.aligned, inventory)
    pairs = matched_pairs([phone.symbol for phone in truth], [phone.symbol for phone, _ in made])
    return [
        made[j][1] - truth[i].onset_s
        for i, j in pairs
        if i is not None and j is not None and truth[i].symbol == made[j][0].symbol
    ]


def first_told(events: Sequence[SoundEvent]) -> list[tuple[Phone, float]]:
    """Each phone as it comes first, and up to when the sound was known then, seconds."""
    first: dict[int, Phone] = {}
    told_s: list[float] = []
    for event in events:
        if isinstance(event, Phone):
            first.setdefault(event.index, event)
        elif isinstance(event, Progress):
            told_s += [event.time_s] * (len(first) - len(told_s))
    return list(zip(first.values(), told_s, strict=False))


def _orders(
    reference: str,
    scores: Scores,
    listeners: Sequence[Listener],
    lips: Sequence[str],
) -> Iterator[Order]:
    for name in lips:
        for listener in listeners:
            schemes = [
                scores.get(Condition(scheme, name, listener.name if scheme != BOUND else ""), {})
                for scheme in SCHEMES
            ]
            by_sentence = {
                number: row
                for number in schemes[0]
                if None not in (row := [_correlation(each.get(number)) for each in schemes])
            }
            if by_sentence:
                table = np.array(list(by_sentence.values()), dtype=float)
                means = table.mean(axis=0)
                yield Order(
                    lips=name,
                    recognizer=listener.name,
                    reference=reference,
                    num_sentences=len(table),
                    correlations=means.tolist(),
                    holds=falls(means),
                    num_holding=sum(falls(row) for row in table),
                )


def _correlation(score: ClipScore | None) -> float | None:
    opening = score.curves.get("opening") if score else None
    return opening.everything.correlation if opening else None


def falls(figures: Array) -> bool:
    """Whether each figure is less than the one before."""
    return bool((np.diff(figures) < 0.0).all())
