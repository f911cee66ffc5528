"""Aligns recordings with their phones by a small classifier of features.

Source: Young et al. 2009, "The HTK book", chapter 8 (Viterbi training). A classifier of the
positions' features is first trained on the hand-labeled recordings. A phone without labels is
likely where phones with similar features are likely:

    p(u | x) = sum_v w[u, v] p(v | x),    w[u, v] ~ exp(-d(u, v) / 1.5)

d is the number of panphon's features in which the phones differ, and v are the phones with labels.
The classifier then aligns all recordings and is trained on this alignment, repeatedly.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from rich.progress import track
from torch import Tensor, nn
from torch.nn.functional import cross_entropy

from kouxing.corpora.speech_corpus import Utterance
from kouxing.corpora.universal_phones import labeled_phones
from kouxing.services.recognizer.front_end.features import HOP_S, WINDOW_S
from kouxing.services.recognizer.search.forced_path import (
    UtteranceGraph,
    build_utterance_graph,
    viterbi_path,
)
from kouxing.shared.arrays import Doubles, Floats, Integers
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.shared.phones.universal.segments import features
from kouxing.training.networks.labels import STATES_PER_PHONE
from kouxing.training.seed import SEED
from kouxing.training.universal.features import Features

_NUM_COMPONENTS, _INNER = 192, 384
_NUM_ROUNDS, _STEPS, _BATCH, _LEARNING_RATE = 3, 700, 512, 2e-3
_NUM_FOR_COMPONENTS = 400  # recordings
_PRIOR_SCALE = 0.6
_STAY, _LEAVE = 0.75, 0.25  # probabilities of a position's and a frame's state
_POSITION_S, _MIDDLE_S = 2 * HOP_S, (WINDOW_S + HOP_S) / 2  # from one to the next, of the first
_MIN_LABELED = 40  # positions of a phone with labels
_SIMILARITY, _OTHER_WEIGHT, _MIN_PROB = 1.5, 0.15, 1e-5


@dataclass(frozen=True, slots=True)
class Aligner:
    """Aligns recordings with the universal phones of their words."""

    recordings: Mapping[str, Utterance]  # by name
    inventory: PhoneInventory  # universal

    @property
    def num_phones(self) -> int:
        """Number of universal phones, silence included."""
        return len(self.inventory)

    def align(self, stored: Sequence[Features]) -> dict[str, Integers]:
        """Return the states of the frames of recordings, (2 positions,) each, by name.

        A recording with too few positions for its phones is left out.
        """
        torch.manual_seed(SEED)
        components = _components(stored)
        labels = [self._hand_labels(features) for features in stored]
        by_hand = [len(phones) > 0 for phones in labels]
        if not any(by_hand):
            raise UserError("no recording has hand-made labels; add the Berlin EmoDB")
        for number in range(_NUM_ROUNDS):
            known = [index for index, phones in enumerate(labels) if len(phones)]
            classifier, log_prior = _classifier(
                [components[index] for index in known],
                [labels[index] for index in known],
                self.num_phones,
            )
            similar = self._similarity_weights(labels) if number == 0 else None
            for index, rows in enumerate(track(components, f"alignment, round {number + 1}")):
                if by_hand[index]:
                    continue
                with torch.no_grad():
                    log_probs = classifier(rows).log_softmax(dim=-1).numpy()
                if similar is None:
                    scores = log_probs - _PRIOR_SCALE * log_prior
                else:
                    scores = np.log(np.exp(log_probs) @ similar.T + _MIN_PROB)
                graph = self._graph(stored[index].name, 1)
                labels[index] = _states_on_path(scores.astype(np.float32), graph)
        return {
            features.name: _split_into_states(phones.repeat(2))
            for features, phones in zip(stored, labels, strict=True)
            if len(phones)
        }

    def _graph(self, name: str, num_states: int) -> UtteranceGraph:
        recording = self.recordings[name]
        first_state = num_states * np.arange(self.num_phones + 1)
        return build_utterance_graph(
            recording.phones,
            recording.syllables,
            first_state,
            silence=self.inventory.index[self.inventory.silence],
        )

    def _hand_labels(self, stored: Features) -> Integers:
        """Return the phones of a recording's positions; empty without hand-made labels."""
        table = self.recordings[stored.name].labels
        if table is None:
            return np.empty(0, np.int64)
        ends_s, symbols = zip(*labeled_phones(table), strict=True)
        time_s = np.arange(-(-stored.num_frames // 2)) * _POSITION_S + _MIDDLE_S
        phones = np.array([self.inventory.index[symbol] for symbol in symbols])
        return np.asarray(phones[np.minimum(np.searchsorted(ends_s, time_s), len(phones) - 1)])

    def _similarity_weights(self, labels: Sequence[Integers]) -> Doubles:
        """Return w, (phones, phones)."""
        counts = np.bincount(np.concatenate(labels), minlength=self.num_phones)
        is_known = counts >= _MIN_LABELED
        known = features()
        silent = [np.nan] * len(known["a"])
        values = np.array([known.get(phone, silent) for phone in self.inventory.phones])
        distance = (values[:, None] != values).sum(axis=-1)  # a pause differs in all features
        weight = np.exp(-distance / _SIMILARITY) * is_known
        weight[is_known] *= _OTHER_WEIGHT
        weight[is_known, is_known] = 1.0
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))


def _components(stored: Sequence[Features]) -> list[Tensor]:
    """Return whitened principal components of the positions, (positions, 256) each."""
    rng = np.random.default_rng(SEED)
    size = min(_NUM_FOR_COMPONENTS, len(stored))
    sampled = np.concatenate(
        [
            stored[index].position_features()
            for index in rng.choice(len(stored), size, replace=False)
        ]
    )
    mean = sampled.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov((sampled - mean).T))
    axes = (axes / np.sqrt(variance + 1e-3))[:, -_NUM_COMPONENTS:].astype(np.float32)
    return [torch.from_numpy((features.position_features() - mean) @ axes) for features in stored]


def _classifier(
    features: Sequence[Tensor], labels: Sequence[Integers], num_phones: int
) -> tuple[nn.Module, Floats]:
    """Train a classifier of positions; return it with the phones' log priors."""
    inputs, targets = torch.cat(list(features)), torch.from_numpy(np.concatenate(labels))
    classifier = nn.Sequential(
        nn.Linear(_NUM_COMPONENTS, _INNER),
        nn.GELU(),
        nn.Dropout(0.2),
        nn.Linear(_INNER, num_phones),
    )
    optimizer = torch.optim.AdamW(classifier.parameters(), weight_decay=0.02)
    for step in range(_STEPS):
        optimizer.param_groups[0]["lr"] = _LEARNING_RATE * (1 - step / _STEPS)
        batch = torch.randint(len(inputs), (_BATCH,))
        noisy = inputs[batch] + 0.2 * torch.randn(_BATCH, _NUM_COMPONENTS)
        loss = cross_entropy(classifier(noisy), targets[batch], label_smoothing=0.05)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    counts = 1.0 + np.bincount(targets.numpy(), minlength=num_phones)
    return classifier.eval(), np.log(counts / counts.sum()).astype(np.float32)


def _states_on_path(scores: Floats, graph: UtteranceGraph) -> Integers:
    """Return the state of each row of scores, or nothing if there are too few rows."""
    num_states = scores.shape[1]
    stay, leave = (np.full(num_states, np.log(prob), np.float32) for prob in (_STAY, _LEAVE))
    path, _ = viterbi_path(scores, graph.states, graph, stay, leave)
    return np.asarray(graph.states[path])


def _split_into_states(phones: Integers) -> Integers:
    """Divide each phone's frames equally among its states."""
    starts = np.flatnonzero(np.diff(phones, prepend=-1))
    lengths = np.diff(np.append(starts, len(phones)))
    within = np.arange(len(phones)) - starts.repeat(lengths)
    return phones * STATES_PER_PHONE + within * STATES_PER_PHONE // lengths.repeat(lengths)
