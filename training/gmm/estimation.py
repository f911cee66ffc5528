"""Estimates the Gaussian mixture HMMs of the recognizer from transcribed speech.

Source: Li et al. 2011, section 3.1 (the model; the paper trained with HTK); the procedure is the
HTK book's (Young et al. 2009, chapters 8 and 10): flat start, embedded re-estimation along the best
path, Gaussian splitting with realignment, optional pauses between syllables.

Path and mixtures are re-estimated alternately. With a constant number of components, the log
likelihood of the data along the best path never falls:

    L = sum_t log b_{s(t)}(x_t) + sum_t log a_{s(t-1) s(t)},     s = argmax L

======== ================================================ =====================
symbol   meaning                                          shape
======== ================================================ =====================
x        normalized features of the frames of a copy      (frames, 39)
s        state of every frame                             (frames,)
gamma    probability of a component in a frame            (frames, mixtures)
======== ================================================ =====================

Features are decorrelated for diagonal covariances with one matrix for all components (Gales 1999,
"Semi-tied covariance matrices for hidden Markov models").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures, mixture_scores
from kouxing.services.recognizer.front_end.features import (
    NUM_FEATURES,
    RunningMean,
    append_deltas,
    compute_cepstra_batch,
)
from kouxing.services.recognizer.search.forced_path import (
    UtteranceGraph,
    build_utterance_graph,
    segments_of_path,
    viterbi_path,
)
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.arrays import Doubles, Float16, Floats, Integers
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.durations import PhoneDurations
from kouxing.training.training_set import Example

_LOUD_LEVEL = 0.4  # threshold of speech between quiet (0) and loud (1)


@dataclass(frozen=True, slots=True)
class RecordingCopy:
    """A copy of a recording, with or without augmentation."""

    example: Example
    weight: float  # weight of its frames in the estimates
    log_mel: Float16  # (frames, 41)


@dataclass(slots=True, kw_only=True)
class HmmParameters:
    """The parameters to estimate."""

    first_state: Integers  # (num_phones + 1,)
    log_stay: Floats  # (states,)
    log_leave: Floats  # (states,)
    mixtures: GaussianMixtures

    @property
    def num_states(self) -> int:
        """Number of states of all phones."""
        return int(self.first_state[-1])


def flat_path(graph: UtteranceGraph, log_energy: Floats) -> Integers:
    """Make a flat start from the log energy of each frame: phones of equal length, no pauses.

    The energy decides about silence at both ends. Returns the node of each frame, (frames,).
    """
    num_frames = len(log_energy)
    low, high = np.percentile(log_energy, [5, 95])
    loud = np.flatnonzero(log_energy > low + _LOUD_LEVEL * (high - low))
    first_pause = np.flatnonzero(graph.phone_number == 0)
    last_pause = np.flatnonzero(graph.phone_number == graph.phone_number[-1])
    silence = graph.phones[0]  # every graph starts with a pause
    speech = np.flatnonzero(graph.phones[graph.phone_number] != silence)
    start, end = int(loud[0]), int(loud[-1]) + 1
    if end - start < len(speech):
        start, end = 0, num_frames
    pieces = [
        _spread(first_pause, start),
        _spread(speech, end - start),
        _spread(last_pause, num_frames - end),
    ]
    return np.concatenate(pieces)


def _spread(nodes: Integers, num_frames: int) -> Integers:
    return nodes[(np.arange(num_frames) * len(nodes)) // max(1, num_frames)]


def normalized_features(copy: RecordingCopy, prior_mean: Floats, half_width: int) -> Floats:
    """Compute the normalized features of a copy as a new session does, (frames, 39)."""
    features = append_deltas(compute_cepstra_batch(copy.log_mel.astype(np.float32)), half_width)
    return RunningMean(prior_mean).normalize(features)


@dataclass(slots=True)
class FrameSet:
    """Frames of all copies, each with its state."""

    features: Floats  # (frames, 39)
    weights: Floats  # (frames,)
    bounds: Integers  # (copies + 1,) first frame of each copy
    graphs: list[UtteranceGraph]
    states: Integers  # (frames,) -1 if the copy could not be aligned
    paths: list[Integers]

    @classmethod
    def build(
        cls,
        copies: Sequence[RecordingCopy],
        inventory: PhoneInventory,
        first_state: Integers,
        prior_mean: Floats,
        half_width: int,
    ) -> FrameSet:
        """Compute the features and the flat start."""
        blocks = [normalized_features(copy, prior_mean, half_width) for copy in copies]
        silence = inventory.index[inventory.silence]
        graphs = [
            build_utterance_graph(
                copy.example.phones, copy.example.syllables, first_state, silence=silence
            )
            for copy in copies
        ]
        lengths = [len(block) for block in blocks]
        paths = [flat_path(graph, block[:, 0]) for graph, block in zip(graphs, blocks, strict=True)]
        return cls(
            features=np.concatenate(blocks),
            weights=np.repeat(np.array([copy.weight for copy in copies], np.float32), lengths),
            bounds=np.concatenate([[0], np.cumsum(lengths)]),
            graphs=graphs,
            states=np.concatenate([g.states[p] for g, p in zip(graphs, paths, strict=True)]),
            paths=paths,
        )

    def realign(self, hmm: HmmParameters) -> float:
        """Align every copy by its best path; return the mean log likelihood of a frame."""
        matrix = hmm.mixtures.score_matrix().reshape(2 * NUM_FEATURES + 1, hmm.num_states, -1)
        num_mixtures = matrix.shape[2]
        total, frames = 0.0, 0.0
        for number, graph in enumerate(self.graphs):
            start, end = int(self.bounds[number]), int(self.bounds[number + 1])
            present, position = np.unique(graph.states, return_inverse=True)
            chosen = np.ascontiguousarray(matrix[:, present]).reshape(len(matrix), -1)
            scores = mixture_scores(self.features[start:end], chosen, num_mixtures)
            path, log_likelihood = viterbi_path(
                scores, position, graph, hmm.log_stay, hmm.log_leave
            )
            self.paths[number] = path
            if len(path) == 0:
                self.states[start:end] = -1
                continue
            self.states[start:end] = graph.states[path]
            total += log_likelihood * float(self.weights[start])
            frames += float(self.weights[start]) * (end - start)
        return total / max(frames, 1.0)

    def by_state(self, num_states: int) -> list[Integers]:
        """Frame numbers of every state."""
        order = np.argsort(self.states, kind="stable")
        cuts = np.searchsorted(self.states[order], np.arange(num_states + 1))
        return [order[cuts[s] : cuts[s + 1]] for s in range(num_states)]


_VARIANCE_FLOOR = 0.05  # relative to the variance of all speech
_MIN_FRAMES = 8.0  # a component with fewer frames is dropped
_BLOCK_FRAMES = 4096
_NUM_ROTATION_STEPS = 15
_MIN_STAY, _MAX_STAY = 0.05, 0.99


def first_estimate(frames: FrameSet, first_state: Integers) -> HmmParameters:
    """Estimate one Gaussian per state from the flat start."""
    num_states = int(first_state[-1])
    half = np.full(num_states, np.log(0.5), np.float32)
    overall = frames.features.var(axis=0)
    mean_of_all = frames.features.mean(axis=0)
    blank = GaussianMixtures(
        weights=np.ones((num_states, 1), np.float32),
        means=np.tile(mean_of_all, (num_states, 1, 1)).astype(np.float32),
        covars=np.tile(overall, (num_states, 1, 1)).astype(np.float32),
    )
    hmm = HmmParameters(
        first_state=first_state, log_stay=half, log_leave=half.copy(), mixtures=blank
    )
    return estimate(frames, hmm)


def variance_floor(frames: FrameSet) -> Floats:
    """Lowest variance of a component, shape (39,)."""
    return np.asarray(_VARIANCE_FLOOR * frames.features.var(axis=0))


def estimate(frames: FrameSet, hmm: HmmParameters, num_iterations: int = 1) -> HmmParameters:
    """Re-estimate along the current path by expectation maximization (HTK book, eq. 8.6-8.13)."""
    floor = variance_floor(frames)
    mixtures = hmm.mixtures
    weights, means, covars = mixtures.weights.copy(), mixtures.means.copy(), mixtures.covars.copy()
    # With a fixed path the states are independent, so each runs all its iterations at once.
    for state, numbers in enumerate(frames.by_state(hmm.num_states)):
        if len(numbers) < _MIN_FRAMES:
            continue
        x = frames.features[numbers]
        design = np.concatenate([x * x, x, np.ones((len(x), 1), np.float32)], axis=1)
        only_state = slice(state, state + 1)
        for _ in range(num_iterations):
            now = GaussianMixtures(
                weights=weights[only_state], means=means[only_state], covars=covars[only_state]
            )
            sums = _component_sums(design, now.score_matrix(), frames.weights[numbers])
            counts = sums[:, -1]
            is_used = counts > 0
            safe = np.maximum(counts, 1e-9)[:, None]
            mean = sums[:, NUM_FEATURES:-1] / safe
            covar = np.maximum(sums[:, :NUM_FEATURES] / safe - mean**2, floor)
            means[state, is_used] = mean[is_used]
            covars[state, is_used] = covar[is_used]
            weights[state] = counts / counts.sum()
    log_stay, log_leave = _transitions(frames, hmm)
    return replace(
        hmm,
        log_stay=log_stay,
        log_leave=log_leave,
        mixtures=GaussianMixtures(weights=weights, means=means, covars=covars),
    )


def _component_sums(design: Floats, matrix: Floats, weights: Floats) -> Doubles:
    """Sum [x^2, x, 1] over a state's frames, weighted by gamma, shape (mixtures, 79)."""
    sums = np.zeros((matrix.shape[1], design.shape[1]))
    for start in range(0, len(design), _BLOCK_FRAMES):  # short sums keep enough precision
        block = design[start : start + _BLOCK_FRAMES]
        gamma = block @ matrix
        gamma -= gamma.max(axis=1, keepdims=True)
        np.exp(gamma, out=gamma)
        gamma *= (weights[start : start + _BLOCK_FRAMES] / gamma.sum(axis=1))[:, None]
        sums += gamma.T @ block
    return sums


def _transitions(frames: FrameSet, hmm: HmmParameters) -> tuple[Floats, Floats]:
    occupied = np.full(hmm.num_states, 2.0)
    left = np.full(hmm.num_states, 1.0)
    for number, (graph, path) in enumerate(zip(frames.graphs, frames.paths, strict=True)):
        if len(path) == 0:
            continue
        weight = float(frames.weights[frames.bounds[number]])
        np.add.at(occupied, graph.states[path], weight)
        ends = np.append(np.flatnonzero(np.diff(path)), len(path) - 1)
        np.add.at(left, graph.states[path[ends]], weight)
    stay = np.clip(1 - left / occupied, _MIN_STAY, _MAX_STAY)
    return np.log(stay).astype(np.float32), np.log(1 - stay).astype(np.float32)


def split(hmm: HmmParameters, frames: FrameSet, num_mixtures: int) -> HmmParameters:
    """Split the heaviest components until every state has ``num_mixtures`` (HTK book, 10.6).

    States with little data keep fewer components; the others have weight 0.
    """
    mixtures = hmm.mixtures
    num_states, num_before, _ = mixtures.means.shape
    weights = np.zeros((num_states, num_mixtures), np.float32)
    means = np.zeros((num_states, num_mixtures, NUM_FEATURES), np.float32)
    covars = np.ones((num_states, num_mixtures, NUM_FEATURES), np.float32)
    weights[:, :num_before] = mixtures.weights
    means[:, :num_before] = mixtures.means
    covars[:, :num_before] = mixtures.covars
    counts = np.array([frames.weights[n].sum() for n in frames.by_state(num_states)])
    for state in range(num_states):
        _drop_light(weights[state], counts[state])
        while True:
            unused = np.flatnonzero(weights[state] == 0)
            heaviest = int(weights[state].argmax())
            if len(unused) == 0 or weights[state, heaviest] * counts[state] < 4 * _MIN_FRAMES:
                break
            free = int(unused[0])
            step = 0.2 * np.sqrt(covars[state, heaviest])
            weights[state, heaviest] /= 2
            weights[state, free] = weights[state, heaviest]
            covars[state, free] = covars[state, heaviest]
            means[state, free] = means[state, heaviest] + step
            means[state, heaviest] -= step
    return replace(hmm, mixtures=GaussianMixtures(weights=weights, means=means, covars=covars))


def _drop_light(weights: Floats, count: float) -> None:
    """Set the weights of components with too few frames to 0, in place."""
    light = weights * count < _MIN_FRAMES
    light[weights.argmax()] = False
    weights[light] = 0
    weights /= weights.sum()


def topology_of(hmm: HmmParameters, phone_lm: PhoneLanguageModel, frames: FrameSet) -> Topology:
    """Make the model's topology, with phone durations from the alignment."""
    durations = PhoneDurations(phone_lm.inventory)
    for number, (graph, path) in enumerate(zip(frames.graphs, frames.paths, strict=True)):
        if len(path):
            weight = float(frames.weights[frames.bounds[number]])
            durations.add(segments_of_path(path, graph), weight)
    mean_s, spread_s = durations.mean_and_spread_s()
    return Topology(
        phone_lm=phone_lm,
        first_state=hmm.first_state,
        log_stay=hmm.log_stay,
        log_leave=hmm.log_leave,
        duration_mean_s=mean_s,
        duration_spread_s=spread_s,
    )


def decorrelate(frames: FrameSet, hmm: HmmParameters) -> tuple[HmmParameters, Floats]:
    """Rotate the features, in place, so that diagonal covariances fit best (Gales 1999, eq. 20-24).

    Returns the rotated model and the rotation, (39, 39), for ``x @ rotation``.
    """
    scatter, counts = _component_covariances(frames, hmm)
    num = NUM_FEATURES
    if not counts.any():  # too little speech
        return hmm, np.eye(num, dtype=np.float32)
    flat = scatter.reshape(-1, num * num)
    transform = np.eye(num)  # rows a_i
    for _ in range(_NUM_ROTATION_STEPS):
        covars = np.einsum("ij,gjk,ik->gi", transform, scatter, transform, optimize=True)
        covars = np.maximum(covars, 1e-4)
        moments = ((counts[:, None] / covars).T @ flat).reshape(num, num, num)
        for row in range(num):
            cofactor = np.linalg.inv(transform)[:, row]  # up to the determinant, which cancels
            direction = np.linalg.solve(moments[row], cofactor)
            transform[row] = direction * np.sqrt(counts.sum() / (cofactor @ direction))
    rotation = transform.T.astype(np.float32)
    frames.features = frames.features @ rotation
    floor = variance_floor(frames)
    covars = np.einsum("ij,gjk,ik->gi", transform, scatter, transform, optimize=True)
    shape = hmm.mixtures.covars.shape
    mixtures = GaussianMixtures(
        weights=hmm.mixtures.weights,
        means=(hmm.mixtures.means @ rotation).astype(np.float32),
        covars=np.maximum(covars, floor).reshape(shape).astype(np.float32),
    )
    return replace(hmm, mixtures=mixtures), rotation


def _component_covariances(frames: FrameSet, hmm: HmmParameters) -> tuple[Doubles, Doubles]:
    """Compute the covariance, (components, 39, 39), and weight, (components,), of components."""
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
            members = nearest == component
            count = float(frames.weights[numbers][members].sum())
            if members.sum() < 2 * num:
                continue
            row = state * num_mixtures + component
            centered = (x[members] - mixtures.means[state, component]).astype(np.float64)
            weighted = centered * frames.weights[numbers][members][:, None]
            scatter[row] = weighted.T @ centered / count + 1e-4 * np.eye(num)  # never singular
            counts[row] = count
    return scatter, counts
