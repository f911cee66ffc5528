"""Scores of whole recordings, their forced alignment, and the HMM statistics."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from kouxing.corpora.feature_cache import as_floats
from kouxing.corpora.scoring import ErrorCounts, count_errors, first_hypothesis
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Topology
from kouxing.services.recognizer.acoustic.network import MAX_POSITIONS
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.services.recognizer.alignment import spoken
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.live_decoder import LiveDecoder
from kouxing.services.recognizer.search.decoder import Segment
from kouxing.services.recognizer.search.forced_path import (
    segments_of_path,
    utterance_graph,
    viterbi_path,
)
from kouxing.services.recognizer.search.output_rule import MODEL_RULES
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.services.recognizer.speech_scorer import FrameScores, SpeechEnd, SpeechStart
from kouxing.shared.errors import UserError
from kouxing.training.durations import PhoneDurations
from kouxing.training.neural.export import network_of
from kouxing.training.neural.network import Network
from kouxing.training.search_weights import all_scores
from kouxing.training.training_set import Example, Report, with_progress


@torch.no_grad()
def log_posteriors_of(
    network: Network, output: int, samples: NDArray[np.int16]
) -> NDArray[np.float32]:
    """Compute the log posteriors of a recording, (n,) at 16 kHz to (frames, states).

    All positions are computed at once. This is faster than position by position, with equal
    results. ``output`` is the number of the output layer.
    """
    network.eval()
    frames = WhisperMel().accept_waveform(as_floats(samples))
    num_frames, look_ahead = len(frames), network.shape.look_aheads[output]
    num_positions = math.ceil((num_frames + look_ahead) / 2) - 1
    num_missing = max(0, 2 * num_positions + 1 - num_frames)
    padded = np.concatenate([frames, np.repeat(frames[-1:], num_missing, axis=0)])
    pieces = []
    for start in range(0, num_positions, MAX_POSITIONS):  # the recognizer also restarts here
        piece = padded[2 * start : 2 * (start + MAX_POSITIONS) + 1]
        hidden = network(torch.from_numpy(piece)[None])
        pieces.append(network.log_posteriors(hidden, output)[0].flatten(0, 1).numpy())
    rows = np.concatenate(pieces)
    first = 2 - look_ahead  # frame of the first row
    rows = rows[-first:] if first < 0 else np.concatenate([rows[:1]] * first + [rows])
    return np.ascontiguousarray(rows[:num_frames])


def network_scores(
    network: Network, output: int, log_prior: NDArray[np.float32], examples: Sequence[Example]
) -> Iterator[NDArray[np.float32]]:
    """Yield the scores of each recording, shape (frames, states); the acoustic scale is 1."""
    for example in examples:
        yield log_posteriors_of(network, output, samples_of(example)) - log_prior


def samples_of(example: Example) -> NDArray[np.int16]:
    """Return the samples, which neural training always loads, shape (n,)."""
    if example.samples is None:
        raise ValueError("an example has no samples")
    return example.samples


def first_hypothesis_error_rate(
    model: AcousticModel, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
) -> float:
    """Phone error rate of the first hypothesis, from the examples' scaled scores."""
    inventory = model.inventory
    total = ErrorCounts()
    for rows, example in zip(scores, examples, strict=True):
        decoder = LiveDecoder(model.topology, MODEL_RULES["neural"])
        scored = FrameScores(rows, provisional=rows[:0])
        events = decoder.decode([SpeechStart(0), scored, SpeechEnd(len(rows))])
        first = spoken(first_hypothesis(events, set()), inventory)
        reference = [inventory.phones[phone] for phone in example.phones]
        total += count_errors(reference, [phone.symbol for phone in first])
    return total.rate


STATES_PER_PHONE = 3
_LOOK_AHEAD_FRAMES = 3  # of the output layer that aligns; those with more are trained less
_MIN_STAY, _MAX_STAY = 0.05, 0.98
_LM_SCALE = 2.0  # chosen on development data
_PRIOR_SCALE = 0.5  # of the states' log priors; chosen on development data


@dataclass(frozen=True, slots=True)
class AlignedExample:
    """A recording with the state of each frame."""

    number: int  # of the example in the training set
    example: Example
    states: NDArray[np.int64]  # (frames,) STATES_PER_PHONE for each phone
    phones: list[Segment]


@dataclass(frozen=True, slots=True)
class Statistics:
    """The parts of a model that are counted on an alignment."""

    topology: Topology
    log_prior: NDArray[np.float32]  # (states,)


def aligning_output(look_aheads: Sequence[int]) -> int:
    """Return the output layer that aligns best; it sees a little of what follows an onset."""
    return int(np.abs(np.array(look_aheads) - _LOOK_AHEAD_FRAMES).argmin())


def aligner_scores(
    aligner: AcousticModel, examples: Sequence[Example]
) -> Iterator[NDArray[np.float32]]:
    """Yield the aligner's scores of each recording, shape (frames, states).

    A network of this package computes whole recordings at once, which is faster.
    """
    if not isinstance(aligner, NeuralModel):
        return all_scores(aligner, examples)
    look_aheads = aligner.look_aheads.tolist()
    output = aligning_output(look_aheads)
    with suppress(KeyError):
        network = network_of(aligner.network, look_aheads)
        return network_scores(network, output, aligner.log_prior, examples)
    return all_scores(replace(aligner, output_layer=output, acoustic_scale=1.0), examples)


def align_all(
    scores: Iterable[NDArray[np.float32]],
    topology: Topology,
    examples: Sequence[Example],
    report: Report,
) -> list[AlignedExample]:
    """Align each recording with its text; drop recordings that do not fit.

    ``topology`` has the HMMs of the scores, (frames, states) of each recording, with any number of
    states per phone. Raises UserError if no recording fits its text.
    """
    aligned = []
    inventory = topology.inventory
    silence = inventory.index[inventory.silence]
    num_states = np.diff(topology.first_state)
    phone = np.repeat(np.arange(len(inventory)), num_states)
    place = np.arange(len(phone)) - topology.first_state[phone]
    # the middle of a phone's n-th state, among STATES_PER_PHONE
    new_place = (2 * place + 1) * STATES_PER_PHONE // (2 * num_states[phone])
    tracked = with_progress(examples, "aligned", report)
    for number, (rows, example) in enumerate(zip(scores, tracked, strict=True)):
        graph = utterance_graph(
            example.phones, example.syllables, topology.first_state, silence=silence
        )
        path, _ = viterbi_path(rows[:, graph.states], graph, topology.log_stay, topology.log_leave)
        if len(path):
            on_path = graph.states[path]
            states = phone[on_path] * STATES_PER_PHONE + new_place[on_path]
            aligned.append(AlignedExample(number, example, states, segments_of_path(path, graph)))
    if not aligned:
        raise UserError("no recording fits its text; check the texts and the aligner")
    return aligned


def statistics_of(
    aligned: Sequence[AlignedExample], weights: Sequence[float], phone_lm: PhoneLanguageModel
) -> Statistics:
    """Count priors, transitions and durations.

    ``weights`` are the relative sampling weights of the recordings in training.
    """
    num_states = STATES_PER_PHONE * len(phone_lm.inventory)
    counts = np.ones(num_states)
    occupied, left = np.full(num_states, 2.0), np.ones(num_states)
    durations = PhoneDurations(phone_lm.inventory)
    for one, weight in zip(aligned, weights, strict=True):
        in_states = np.bincount(one.states, minlength=num_states)
        counts += weight * len(aligned) * in_states
        occupied += in_states
        ends = np.append(np.flatnonzero(np.diff(one.states)), len(one.states) - 1)
        np.add.at(left, one.states[ends], 1.0)
        durations.add(one.phones, one.example.weight)
    stay = np.clip(1 - left / occupied, _MIN_STAY, _MAX_STAY)
    mean_s, spread_s = durations.mean_and_spread_s()
    topology = Topology(
        phone_lm=phone_lm,
        first_state=np.arange(len(phone_lm.inventory) + 1) * STATES_PER_PHONE,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        lm_scale=_LM_SCALE,
        duration_mean_s=mean_s,
        duration_spread_s=spread_s,
    )
    log_prior = _PRIOR_SCALE * np.log(counts / counts.sum())
    return Statistics(topology, log_prior.astype(np.float32))
