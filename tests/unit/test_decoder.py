"""The search, compared with brute force on small models."""

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.search import frame_search
from kouxing.services.recognizer.search.decoder import Decoder, PathSegment
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from tests.languages import MANDARIN, NUM_PHONES, SIL, Table, random_topology


@dataclass(frozen=True)
class Path:
    """A path up to a frame."""

    score: float
    ended: tuple[PathSegment, ...]
    phone: int
    state: int  # state of the phone
    start: int  # start frame of the phone


def phone_penalties(model: Topology, scores: NDArray[np.float32]) -> list[float]:
    """Return the penalty of phones that start at each frame."""
    first = model.first_state[:-1]
    phones = np.add.reduceat(np.exp(scores.astype(float)), first, axis=1)
    roots = np.sqrt(phones / phones.sum(axis=1, keepdims=True))
    changes = np.append(0.0, 1.0 - (roots[1:] * roots[:-1]).sum(axis=1))
    rate, penalties = 1.0 / 60.0, []
    for frame, change in enumerate(changes):
        rate += (change - rate) / 200.0 if frame else 0.0
        penalties.append(
            model.phone_penalty + np.clip(model.rate_weight * (rate - 1.0 / 60.0), -2.0, 2.0)
        )
    return penalties


def brute_force(
    model: Topology, table: Table, scores: NDArray[np.float32], phones: list[int]
) -> list[PathSegment]:
    """Try every path that the loop allows."""

    penalties = phone_penalties(model, scores)

    def cost(before: tuple[int, ...], phone: int, frame: int) -> float:
        log_prob = 0.0 if before == (SIL,) and phone == SIL else table.after(before, phone)
        return model.lm_scale * log_prob + penalties[frame]

    paths = [Path(cost((SIL,), phone, 0), (), phone, 0, 0) for phone in phones]
    for frame, observed in enumerate(scores):
        longer = []
        for path in paths:
            at = int(model.first_state[path.phone]) + path.state
            score = path.score + float(observed[at])
            left = score + float(model.log_leave[at])
            longer.append(replace(path, score=score + float(model.log_stay[at])))
            if at + 1 < model.first_state[path.phone + 1]:
                longer.append(replace(path, score=left, state=path.state + 1))
                continue
            ended = (*path.ended, PathSegment(path.phone, path.start, frame + 1))
            before = (SIL, *(segment.phone for segment in ended))
            is_last = frame + 1 == len(scores)
            longer += [
                Path(
                    left + (0.0 if is_last else cost(before, phone, frame + 1)),
                    ended,
                    phone,
                    0,
                    frame + 1,
                )
                for phone in phones
            ]
        paths = longer
    complete = [path for path in paths if path.start == len(scores)]
    return list(max(complete, key=lambda path: path.score).ended)


@pytest.mark.parametrize("rate_weight", [0.0, 120.0])
@pytest.mark.parametrize(
    ("order", "kept", "states_per_phone", "num_frames"),
    [(2, 1.0, 2, 8), (2, 1.0, 3, 9), (3, 1.0, 2, 9), (3, 0.5, 2, 9), (4, 0.6, 1, 7)],
)
def test_finds_the_best_of_all_paths(
    order: int, kept: float, states_per_phone: int, num_frames: int, rate_weight: float
) -> None:
    rng = np.random.default_rng(0)
    phones = [3, 40, SIL]
    table = Table.draw(rng, phones, order=order, kept=kept)
    model = replace(
        random_topology(states_per_phone, rng, table.tree()),
        lm_scale=1.5,
        phone_penalty=1.25,
        rate_weight=rate_weight,
    )
    scores = rng.normal(size=(num_frames, model.num_states)).astype(np.float32)
    others = np.isin(np.arange(NUM_PHONES), phones, invert=True).repeat(states_per_phone)
    scores[:, others] = -1e4  # impossible
    decoder = Decoder(model)
    decoder.advance(scores)
    assert decoder.final_path() == brute_force(model, table, scores, phones)


def crowded_language() -> PhoneLanguageModel:
    """Make all strings of three phones, and one continuation of each, equally likely."""
    levels = [np.zeros(1, np.uint8)]
    children = [np.array([NUM_PHONES], np.uint8)]
    for num_children in (NUM_PHONES, NUM_PHONES, 1, 0):
        parents = children[-1]
        levels.append(np.concatenate([np.arange(n) for n in parents]).astype(np.uint8))
        begins = (levels[-1] != SIL) | (len(levels) == 2)
        children.append(np.where(begins, num_children, 0).astype(np.uint8))
    phone = np.concatenate(levels)
    return PhoneLanguageModel(
        inventory=MANDARIN,
        num_children=np.concatenate(children),
        phone=phone,
        log_prob=np.full(len(phone), -np.log(NUM_PHONES), np.float32),
        log_backoff=np.zeros(len(phone), np.float32),
    )


def test_limits_the_number_of_tokens() -> None:
    model = random_topology(1, np.random.default_rng(0), crowded_language())
    decoder = Decoder(model)
    max_tokens = 0
    for _ in range(30):
        decoder.advance(np.zeros((1, model.num_states), np.float32))
        max_tokens = max(max_tokens, decoder._num_tokens)
    assert max_tokens == frame_search.MAX_TOKENS
    path = decoder.final_path()
    assert (path[0].start, path[-1].end) == (0, 30)
    assert all(segment.end == following.start for segment, following in pairwise(path))
