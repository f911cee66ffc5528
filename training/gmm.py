"""Train the Gaussian mixture HMMs of the recognizer from transcribed speech.

Source: Li et al. 2011, section 3.1 (the model; the paper trained with HTK); the recipe is the HTK
book's (Young et al. 2009, chapters 8 and 10): flat start, embedded re-estimation along the best
path, Gaussian splitting with realignment, pauses allowed between syllables.

With the path and the mixtures re-estimated in turn, the log likelihood of the data along the best
path never falls while the number of components stays the same:

    L = sum_t log b_{s(t)}(x_t) + sum_t log a_{s(t-1) s(t)},     s = argmax L

======== ================================================ =====================
symbol   meaning                                          shape
======== ================================================ =====================
x        normalised feature frames of an utterance        (frames, 39)
s        state of every frame                             (frames,)
gamma    share of a component in a frame                  (frames, mixtures)
======== ================================================ =====================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import Topology
from services.recognizer.features import (
    NUM_FEATURES,
    LiveMean,
    cepstra_of_all,
    with_differences,
)
from services.recognizer.gmm import GaussianMixtures, mixture_scores
from services.recognizer.unit_language import UnitLanguage
from shared.phones import SILENCE, UNIT_INDEX
from training.durations import AlignedUnit, UnitDurations
from training.examples import Example

SIL = UNIT_INDEX[SILENCE]
_VARIANCE_FLOOR = 0.05  # of the variance of all speech
_LEAST_FRAMES = 8.0  # a component must stand for this many frames, else it is dropped
_BLOCK_FRAMES = 4096
_LEAST_STAY, _MOST_STAY = 0.05, 0.99


@dataclass(slots=True, kw_only=True)
class Hmm:
    """Everything that is estimated."""

    first_state: NDArray[np.int64]
    log_stay: NDArray[np.float32]
    log_leave: NDArray[np.float32]
    mixtures: GaussianMixtures

    @property
    def num_states(self) -> int:
        """Number of states of all units."""
        return int(self.first_state[-1])


@dataclass(slots=True, kw_only=True)
class Graph:
    """The states that an utterance goes through, in order; pauses may be skipped."""

    states: NDArray[np.int64]  # (positions,)
    skip_from: NDArray[np.int64]  # (positions,) position before a pause that may be skipped, or -1
    unit_of: NDArray[np.int64]  # (positions,) running number of the unit, pauses included
    units: NDArray[np.int64]  # (running numbers,) the units
    num_last: int  # positions from the end where an utterance may end: 1, or after the last unit


def utterance_graph(
    units: Sequence[int], syllables: Sequence[int], first_state: NDArray[np.int64]
) -> Graph:
    """Lay out the states of an utterance with an optional pause at each syllable boundary."""
    states: list[int] = []
    skip_from: list[int] = []
    unit_of: list[int] = []
    names: list[int] = []

    def add(unit: int, before_pause: int) -> None:
        first, end = int(first_state[unit]), int(first_state[unit + 1])
        for state in range(first, end):
            skip_from.append(before_pause if state == first else -1)
            states.append(state)
            unit_of.append(len(names))
        names.append(unit)

    add(SIL, -1)
    before_pause = -1  # position of the last state before a pause
    position = 0
    for length in syllables:
        for unit in units[position : position + length]:
            add(unit, before_pause)
            before_pause = -1
        position += length
        before_pause = len(states) - 1
        add(SIL, -1)
    return Graph(
        states=np.array(states),
        skip_from=np.array(skip_from),
        unit_of=np.array(unit_of),
        units=np.array(names),
        num_last=int(first_state[SIL + 1] - first_state[SIL]),
    )


def viterbi_path(
    scores: NDArray[np.float32],
    graph: Graph,
    log_stay: NDArray[np.float32],
    log_leave: NDArray[np.float32],
) -> tuple[NDArray[np.int64], float]:
    """Best path through a graph.

    Parameters
    ----------
    scores
        Log densities of every position, shape (frames, positions).
    graph
        The utterance.
    log_stay, log_leave
        Log transition probabilities of all states.

    Returns
    -------
    tuple
        Position of every frame, shape (frames,), and the path's log likelihood; an empty array
        and minus infinity if the utterance has too few frames.
    """
    path, log_likelihood = _viterbi(
        scores,
        graph.skip_from,
        log_stay[graph.states],
        log_leave[graph.states],
        graph.num_last,
        int((graph.unit_of == 0).sum()),
    )
    return path, float(log_likelihood)


@numba.njit(cache=True)
def _viterbi(
    scores: NDArray[np.float32],
    skip_from: NDArray[np.int64],
    stay: NDArray[np.float32],
    leave: NDArray[np.float32],
    num_last: int,
    num_first: int,
) -> tuple[NDArray[np.int64], float]:
    num_frames, num_positions = scores.shape
    score = np.full(num_positions, -np.inf)
    back = np.zeros((num_frames, num_positions), dtype=np.int32)
    score[0] = scores[0, 0]
    score[num_first] = scores[0, num_first]  # the first pause may be missing
    for frame in range(1, num_frames):
        for position in range(num_positions - 1, -1, -1):
            best, origin = score[position] + stay[position], position
            if position > 0:
                value = score[position - 1] + leave[position - 1]
                if value > best:
                    best, origin = value, position - 1
            before = skip_from[position]
            if before >= 0:
                value = score[before] + leave[before]
                if value > best:
                    best, origin = value, before
            score[position] = best + scores[frame, position]
            back[frame, position] = origin
    # The last pause may be missing as well.
    position = num_positions - 1
    before = num_positions - num_last - 1
    if score[before] + leave[before] > score[position] + leave[position]:
        position = before
    total = score[position] + leave[position]
    path = np.zeros(num_frames, dtype=np.int64)
    if total == -np.inf:
        return path[:0], total
    for frame in range(num_frames - 1, -1, -1):
        path[frame] = position
        position = back[frame, position]
    return path, total


def units_of_path(path: NDArray[np.int64], graph: Graph) -> list[AlignedUnit]:
    """Units with their frames, from the position of every frame."""
    runs = graph.unit_of[path]
    starts = np.concatenate([[0], np.flatnonzero(np.diff(runs)) + 1])
    ends = np.concatenate([starts[1:], [len(path)]])
    return [
        AlignedUnit(int(graph.units[runs[start]]), int(start), int(end))
        for start, end in zip(starts, ends, strict=True)
    ]


def flat_path(graph: Graph, log_energy: NDArray[np.float32]) -> NDArray[np.int64]:
    """First guess: silence at both ends by energy, the units between of equal length, no pauses."""
    num_frames = len(log_energy)
    low, high = np.percentile(log_energy, [5, 95])
    loud = np.flatnonzero(log_energy > low + 0.4 * (high - low))
    first_unit = np.flatnonzero(graph.unit_of == 0)
    last_unit = np.flatnonzero(graph.unit_of == graph.unit_of[-1])
    is_pause = graph.units[graph.unit_of] == SIL
    spoken = np.flatnonzero(~is_pause)
    start, end = int(loud[0]), int(loud[-1]) + 1
    if end - start < len(spoken):
        start, end = 0, num_frames
    pieces = [
        _spread(first_unit, start),
        _spread(spoken, end - start),
        _spread(last_unit, num_frames - end),
    ]
    return np.concatenate(pieces)


def _spread(positions: NDArray[np.int64], num_frames: int) -> NDArray[np.int64]:
    return positions[(np.arange(num_frames) * len(positions)) // max(1, num_frames)]


def features_of(
    example: Example, prior_mean: NDArray[np.float32], half_width: int
) -> NDArray[np.float32]:
    """Normalised features of an utterance as a new session would see them, (frames, 39)."""
    log_mel = example.log_mel.astype(np.float32)
    if example.augmentation is not None:
        log_mel = example.augmentation.apply(log_mel)
    features = with_differences(cepstra_of_all(log_mel), half_width)
    return LiveMean(prior_mean).normalise(features)


@dataclass(slots=True)
class FrameSet:
    """Frames of all utterances with the state each belongs to."""

    features: NDArray[np.float32]  # (frames, 39)
    weights: NDArray[np.float32]  # (frames,)
    bounds: NDArray[np.int64]  # (utterances + 1,)
    graphs: list[Graph]
    states: NDArray[np.int64]  # (frames,) -1 where the utterance could not be aligned
    paths: list[NDArray[np.int64]]

    @classmethod
    def build(
        cls,
        examples: Sequence[Example],
        first_state: NDArray[np.int64],
        prior_mean: NDArray[np.float32],
        half_width: int,
    ) -> FrameSet:
        """Compute the features and a flat first alignment."""
        blocks = [features_of(example, prior_mean, half_width) for example in examples]
        graphs = [utterance_graph(e.units, e.syllables, first_state) for e in examples]
        lengths = [len(block) for block in blocks]
        paths = [flat_path(graph, block[:, 0]) for graph, block in zip(graphs, blocks, strict=True)]
        return cls(
            features=np.concatenate(blocks),
            weights=np.repeat(np.array([e.weight for e in examples], np.float32), lengths),
            bounds=np.concatenate([[0], np.cumsum(lengths)]),
            graphs=graphs,
            states=np.concatenate([g.states[p] for g, p in zip(graphs, paths, strict=True)]),
            paths=paths,
        )

    def realign(self, hmm: Hmm) -> float:
        """Put every utterance on its best path; return the mean log likelihood of a frame."""
        matrix = hmm.mixtures.score_matrix().reshape(2 * NUM_FEATURES + 1, hmm.num_states, -1)
        num_mixtures = matrix.shape[2]
        total, frames = 0.0, 0.0
        for number, graph in enumerate(self.graphs):
            start, end = int(self.bounds[number]), int(self.bounds[number + 1])
            present, position = np.unique(graph.states, return_inverse=True)
            chosen = np.ascontiguousarray(matrix[:, present]).reshape(len(matrix), -1)
            scores = mixture_scores(self.features[start:end], chosen, num_mixtures)[:, position]
            path, log_likelihood = viterbi_path(scores, graph, hmm.log_stay, hmm.log_leave)
            self.paths[number] = path
            if len(path) == 0:
                self.states[start:end] = -1
                continue
            self.states[start:end] = graph.states[path]
            total += log_likelihood * float(self.weights[start])
            frames += float(self.weights[start]) * (end - start)
        return total / max(frames, 1.0)

    def by_state(self, num_states: int) -> list[NDArray[np.int64]]:
        """Frame numbers of every state."""
        order = np.argsort(self.states, kind="stable")
        cuts = np.searchsorted(self.states[order], np.arange(num_states + 1))
        return [order[cuts[s] : cuts[s + 1]] for s in range(num_states)]


def first_estimate(frames: FrameSet, first_state: NDArray[np.int64]) -> Hmm:
    """One Gaussian per state from a first alignment."""
    num_states = int(first_state[-1])
    half = np.full(num_states, np.log(0.5), np.float32)
    overall = frames.features.var(axis=0)
    mean_of_all = frames.features.mean(axis=0)
    blank = GaussianMixtures(
        weights=np.ones((num_states, 1), np.float32),
        means=np.tile(mean_of_all, (num_states, 1, 1)).astype(np.float32),
        covars=np.tile(overall, (num_states, 1, 1)).astype(np.float32),
    )
    hmm = Hmm(first_state=first_state, log_stay=half, log_leave=half.copy(), mixtures=blank)
    return estimate(frames, hmm)


def _variance_floor(frames: FrameSet) -> NDArray[np.float32]:
    """Least variance of a component, shape (39,)."""
    floor: NDArray[np.float32] = _VARIANCE_FLOOR * frames.features.var(axis=0)
    return floor


def estimate(frames: FrameSet, hmm: Hmm, num_iterations: int = 1) -> Hmm:
    """Expectation-maximisation along the current path (HTK book, eq. 8.6-8.13)."""
    floor = _variance_floor(frames)
    mixtures = hmm.mixtures
    weights, means, covars = mixtures.weights.copy(), mixtures.means.copy(), mixtures.covars.copy()
    # With the path fixed, states do not depend on each other: each has all its iterations in turn.
    for state, numbers in enumerate(frames.by_state(hmm.num_states)):
        if len(numbers) < _LEAST_FRAMES:
            continue
        x = frames.features[numbers]
        design = np.concatenate([x * x, x, np.ones((len(x), 1), np.float32)], axis=1)
        one = slice(state, state + 1)
        for _ in range(num_iterations):
            now = GaussianMixtures(weights=weights[one], means=means[one], covars=covars[one])
            sums = _component_sums(design, now.score_matrix(), frames.weights[numbers])
            counts = sums[:, -1]
            kept = counts > 0
            safe = np.maximum(counts, 1e-9)[:, None]
            mean = sums[:, NUM_FEATURES:-1] / safe
            covar = np.maximum(sums[:, :NUM_FEATURES] / safe - mean**2, floor)
            means[state, kept] = mean[kept]
            covars[state, kept] = covar[kept]
            weights[state] = counts / counts.sum()
    log_stay, log_leave = _transitions(frames, hmm)
    return replace(
        hmm,
        log_stay=log_stay,
        log_leave=log_leave,
        mixtures=GaussianMixtures(weights=weights, means=means, covars=covars),
    )


def _component_sums(
    design: NDArray[np.float32], matrix: NDArray[np.float32], weights: NDArray[np.float32]
) -> NDArray[np.float64]:
    """Sum [x^2, x, 1] over a state's frames, shared out to its components, (mixtures, 79)."""
    sums = np.zeros((matrix.shape[1], design.shape[1]))
    for start in range(0, len(design), _BLOCK_FRAMES):  # so that single precision is enough
        block = design[start : start + _BLOCK_FRAMES]
        gamma = block @ matrix
        gamma -= gamma.max(axis=1, keepdims=True)
        np.exp(gamma, out=gamma)
        gamma *= (weights[start : start + _BLOCK_FRAMES] / gamma.sum(axis=1))[:, None]
        sums += gamma.T @ block
    return sums


def _transitions(frames: FrameSet, hmm: Hmm) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    occupied = np.full(hmm.num_states, 2.0)
    left = np.full(hmm.num_states, 1.0)
    for number, (graph, path) in enumerate(zip(frames.graphs, frames.paths, strict=True)):
        if len(path) == 0:
            continue
        weight = float(frames.weights[frames.bounds[number]])
        np.add.at(occupied, graph.states[path], weight)
        ends = np.append(np.flatnonzero(np.diff(path)), len(path) - 1)
        np.add.at(left, graph.states[path[ends]], weight)
    stay = np.clip(1 - left / occupied, _LEAST_STAY, _MOST_STAY)
    return np.log(stay).astype(np.float32), np.log(1 - stay).astype(np.float32)


def split(hmm: Hmm, frames: FrameSet, num_mixtures: int) -> Hmm:
    """Split the heaviest components until every state has ``num_mixtures`` (HTK book, 10.6).

    States with little data keep fewer; their missing components have weight 0.
    """
    mixtures = hmm.mixtures
    num_states, had, _ = mixtures.means.shape
    weights = np.zeros((num_states, num_mixtures), np.float32)
    means = np.zeros((num_states, num_mixtures, NUM_FEATURES), np.float32)
    covars = np.ones((num_states, num_mixtures, NUM_FEATURES), np.float32)
    weights[:, :had], means[:, :had], covars[:, :had] = (
        mixtures.weights,
        mixtures.means,
        mixtures.covars,
    )
    counts = np.array([frames.weights[n].sum() for n in frames.by_state(num_states)])
    for state in range(num_states):
        _drop_light(weights[state], counts[state])
        while True:
            room = np.flatnonzero(weights[state] == 0)
            heaviest = int(weights[state].argmax())
            if len(room) == 0 or weights[state, heaviest] * counts[state] < 4 * _LEAST_FRAMES:
                break
            free = int(room[0])
            step = 0.2 * np.sqrt(covars[state, heaviest])
            weights[state, heaviest] /= 2
            weights[state, free] = weights[state, heaviest]
            covars[state, free] = covars[state, heaviest]
            means[state, free] = means[state, heaviest] + step
            means[state, heaviest] -= step
    return replace(hmm, mixtures=GaussianMixtures(weights=weights, means=means, covars=covars))


def _drop_light(weights: NDArray[np.float32], count: float) -> None:
    light = weights * count < _LEAST_FRAMES
    light[weights.argmax()] = False
    weights[light] = 0
    weights /= weights.sum()


def topology_of(hmm: Hmm, language: UnitLanguage, frames: FrameSet) -> Topology:
    """Make the search part of the model, with unit durations measured on the alignment."""
    durations = UnitDurations()
    for number, (graph, path) in enumerate(zip(frames.graphs, frames.paths, strict=True)):
        if len(path):
            weight = float(frames.weights[frames.bounds[number]])
            durations.add(units_of_path(path, graph), weight)
    mean_s, spread_s = durations.mean_and_spread_s()
    return Topology(
        first_state=hmm.first_state,
        log_stay=hmm.log_stay,
        log_leave=hmm.log_leave,
        language=language,
        duration_mean_s=mean_s,
        duration_spread_s=spread_s,
    )


def decorrelate(
    frames: FrameSet, hmm: Hmm, num_iterations: int = 15
) -> tuple[Hmm, NDArray[np.float32]]:
    """Rotate the features so that diagonal covariances fit best (Gales 1999, eq. 20-24).

    The frames are rotated in place.

    Returns
    -------
    tuple
        The rotated model and the rotation, shape (39, 39): ``x @ rotation``.
    """
    scatter, counts = _component_covariances(frames, hmm)
    num = NUM_FEATURES
    if not counts.any():  # too little speech to tell
        return hmm, np.eye(num, dtype=np.float32)
    flat = scatter.reshape(-1, num * num)
    transform = np.eye(num)  # rows a_i
    for _ in range(num_iterations):
        covars = np.einsum("ij,gjk,ik->gi", transform, scatter, transform, optimize=True)
        covars = np.maximum(covars, 1e-4)
        moments = ((counts[:, None] / covars).T @ flat).reshape(num, num, num)
        for row in range(num):
            cofactor = np.linalg.inv(transform)[:, row]  # up to the determinant, which cancels
            direction = np.linalg.solve(moments[row], cofactor)
            transform[row] = direction * np.sqrt(counts.sum() / (cofactor @ direction))
    rotation = transform.T.astype(np.float32)
    frames.features = frames.features @ rotation
    floor = _variance_floor(frames)
    covars = np.einsum("ij,gjk,ik->gi", transform, scatter, transform, optimize=True)
    shape = hmm.mixtures.covars.shape
    mixtures = GaussianMixtures(
        weights=hmm.mixtures.weights,
        means=(hmm.mixtures.means @ rotation).astype(np.float32),
        covars=np.maximum(covars, floor).reshape(shape).astype(np.float32),
    )
    return replace(hmm, mixtures=mixtures), rotation


def _component_covariances(
    frames: FrameSet, hmm: Hmm
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Full covariance around each component's mean, (components, 39, 39), and their counts."""
    mixtures = hmm.mixtures
    num_states, num_mixtures, num = mixtures.means.shape
    matrix = mixtures.score_matrix().reshape(2 * num + 1, num_states, num_mixtures)
    scatter = np.tile(np.eye(num), (num_states * num_mixtures, 1, 1))
    counts = np.zeros(num_states * num_mixtures)
    for state, numbers in enumerate(frames.by_state(num_states)):
        if len(numbers) == 0:
            continue
        x = frames.features[numbers]
        design = np.concatenate([x * x, x, np.ones((len(x), 1), np.float32)], axis=1)
        nearest = (design @ matrix[:, state]).argmax(axis=1)
        for component in range(num_mixtures):
            mine = nearest == component
            count = float(frames.weights[numbers][mine].sum())
            if mine.sum() < 2 * num:
                continue
            at = state * num_mixtures + component
            centred = (x[mine] - mixtures.means[state, component]).astype(np.float64)
            scatter[at] = (centred * frames.weights[numbers][mine][:, None]).T @ centred / count
            counts[at] = count
    return scatter, counts
