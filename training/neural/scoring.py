"""Score whole recordings with PyTorch as the recognizer does live."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from kouxing.corpora.feature_cache import as_floats
from kouxing.corpora.scoring import ErrorCounts, count_errors, first_hypothesis
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.network import MAX_POSITIONS
from kouxing.services.recognizer.alignment import spoken
from kouxing.services.recognizer.front_end.whisper_mel import WhisperMel
from kouxing.services.recognizer.live_decoder import LiveDecoder
from kouxing.services.recognizer.search.output_rule import MODEL_RULES
from kouxing.services.recognizer.speech_scorer import FrameScores, SpeechEnd, SpeechStart
from kouxing.training.neural.network import Network
from kouxing.training.training_set import Example


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
