"""The frames of the training set, each with its features, its weight and its HMM state."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kouxing.services.recognizer.acoustic.gmm import GaussianMixtures, mixture_scores
from kouxing.services.recognizer.front_end.features import (
    NUM_FEATURES,
    LiveMean,
    cepstra_of_all,
    with_differences,
)
from kouxing.services.recognizer.search.forced_path import (
    UtteranceGraph,
    utterance_graph,
    viterbi_path,
)
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.gmm.augmentation import Augmentation
from kouxing.training.training_set import Example

_LOUD_LEVEL = 0.4  # threshold of speech between quiet (0) and loud (1)


@dataclass(frozen=True, slots=True)
class Copy:
    """A copy of a recording, with or without augmentation."""

    example: Example
    weight: float  # weight of its frames in the estimates
    augmentation: Augmentation | None = None


@dataclass(slots=True, kw_only=True)
class Hmm:
    """The parameters to estimate."""

    first_state: NDArray[np.int64]  # (num_phones + 1,)
    log_stay: NDArray[np.float32]  # (states,)
    log_leave: NDArray[np.float32]  # (states,)
    mixtures: GaussianMixtures

    @property
    def num_states(self) -> int:
        """Number of states of all phones."""
        return int(self.first_state[-1])


def flat_path(graph: UtteranceGraph, log_energy: NDArray[np.float32]) -> NDArray[np.int64]:
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


def _spread(nodes: NDArray[np.int64], num_frames: int) -> NDArray[np.int64]:
    return nodes[(np.arange(num_frames) * len(nodes)) // max(1, num_frames)]


def features_of(
    copy: Copy, prior_mean: NDArray[np.float32], half_width: int
) -> NDArray[np.float32]:
    """Compute the normalized features of a copy as a new session does, (frames, 39)."""
    log_mel = copy.example.log_mel.astype(np.float32)
    if copy.augmentation is not None:
        log_mel = copy.augmentation.apply(log_mel)
    features = with_differences(cepstra_of_all(log_mel), half_width)
    return LiveMean(prior_mean).normalize(features)


@dataclass(slots=True)
class FrameSet:
    """Frames of all copies, each with its state."""

    features: NDArray[np.float32]  # (frames, 39)
    weights: NDArray[np.float32]  # (frames,)
    bounds: NDArray[np.int64]  # (copies + 1,) first frame of each copy
    graphs: list[UtteranceGraph]
    states: NDArray[np.int64]  # (frames,) -1 if the copy could not be aligned
    paths: list[NDArray[np.int64]]

    @classmethod
    def build(
        cls,
        copies: Sequence[Copy],
        inventory: PhoneInventory,
        first_state: NDArray[np.int64],
        prior_mean: NDArray[np.float32],
        half_width: int,
    ) -> FrameSet:
        """Compute the features and the flat start."""
        blocks = [features_of(copy, prior_mean, half_width) for copy in copies]
        silence = inventory.index[inventory.silence]
        graphs = [
            utterance_graph(
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

    def realign(self, hmm: Hmm) -> float:
        """Align every copy by its best path; return the mean log likelihood of a frame."""
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
