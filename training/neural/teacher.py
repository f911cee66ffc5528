"""The network's teacher: Whisper's whole encoder with a readout of states.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder with its front end, section 2.2, and its weights); Cho et al. 2014, "Learning phrase
representations using RNN encoder-decoder for statistical machine translation" (the GRU); Hinton,
Vinyals and Dean 2015, "Distilling the knowledge in a neural network" (a large network's posteriors
are the targets of a small one). The encoder is frozen; the readout learns the states of an
alignment. Because the teacher sees the whole recording, it makes far fewer errors than a live
network can, also on recordings without text.

    m[k, j] = (max(log10 max(B[k] P[j], 1e-10), max log10 - 8) + 4) / 4
    z = clip((concat(h_4, h_5, h_6) - mean) / deviation, -6, 6)
    a = gelu(W z)
    y = log softmax(V concat(GRU(a), a))

========== ========================================================== ======================
symbol     meaning                                                    shape
========== ========================================================== ======================
P          power spectra of 25 ms, centred on samples 160 j           (201, frames)
B          mel filters of                                             (80, 201)
           :mod:`kouxing.services.recognizer.front_end.whisper_mel`
m          log-mel bands; the floor is eight decades below the        (80, frames)
           recording's maximum
h_l        positions after layer l, centred on samples 320 p          (positions, width)
mean,      of the features in the training data                       (3 width,)
deviation
a          input of the GRU, which is bidirectional                   (positions, 256)
y          log posteriors of the states at two frames                 (positions, 2, states)
========== ========================================================== ======================

The recognizer's frame ``t`` is centred on sample ``160 t + 200``, so frames ``2 p - 2`` and
``2 p - 1`` lie around the middle of position ``p`` and are its output. Position 0 is dropped.

Whisper takes 30 s at most: longer recordings are cut into pieces. Cost: about a second of one core
for 35 s of sound, or for 80 s in mixed precision.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import gelu, log_softmax
from torch.optim.swa_utils import AveragedModel

from kouxing.corpora.feature_cache import as_floats
from kouxing.services.recognizer.front_end.features import HOP_SAMPLES, WINDOW_SAMPLES, frames_in
from kouxing.services.recognizer.front_end.whisper_mel import mel_bands
from kouxing.training.neural.batches import Recording, Sample, Targets, batches_of, sampling_probs
from kouxing.training.neural.network import Encoder, Shape, mixed_precision
from kouxing.training.neural.trainer import cross_entropy, late_mean, take_step
from kouxing.training.progress import Report, with_progress

NUM_LAYERS = 6  # of Whisper base's encoder
_NUM_STEPS = 300  # batches of 70 s of sound
KEPT_LAYERS = (-3, -2, -1)  # places among the layers
_PIECE_FRAMES = 2960  # with the padding, less than 30 s
_PADDING = np.zeros(4800, np.float32)  # samples after a piece
_MIN_POWER, _FLOOR_DECADES = 1e-10, 8.0
_MAX_HALF = 6e4  # a 16-bit float's range
_NUM_TARGETS = 8  # likeliest states of a frame

_INNER, _GRU = 256, 160  # widths in the readout
_DROPOUT = 0.3
_MAX_DEVIATIONS = 6.0
_STANDARD_RECORDINGS = 250  # for mean and deviation
_NOISE = 0.3  # deviations, of each position; as much again is constant in a recording
_HIDDEN_INPUTS = 0.1  # fraction of the inputs that are 0 in a whole recording
_NUM_MASKS, _MASK_PROB, _MAX_MASKED = 2, 0.5, 7  # masks, probability of each, positions

_BATCH_POSITIONS = 3500
_CROP_POSITIONS = 250
_RATE = 2e-3
_WEIGHT_DECAY = 0.02
_WARM_UP_STEPS = 30
_FALL = 0.5  # fraction of the steps, at the end, over which the rate falls to 0
_MAX_GRADIENT_NORM = 2.0
_MEAN_EXPONENT = 8  # of the running mean of the weights

T = TypeVar("T")


class WholeEncoder(Encoder):
    """Whisper's encoder: every position attends to the whole recording."""

    def __init__(self, shape: Shape, kept_layers: Sequence[int] = KEPT_LAYERS) -> None:
        super().__init__(shape, dropout=0.0, padding=1)
        self.kept_layers = kept_layers

    def forward(self, bands: Tensor, start: int = 0) -> Tensor:
        """Return the kept layers: (batch, 80, frames) to (batch, positions, kept width).

        ``start`` is the first position's row in the table.
        """
        hidden = self.embed(bands, start)
        after = []
        for layer in self.layers:
            hidden = layer(hidden)
            after.append(hidden)
        return torch.cat([after[place] for place in self.kept_layers], dim=-1)

    @torch.no_grad()
    def features(self, samples: NDArray[np.int16]) -> NDArray[np.float16]:
        """Encode a recording.

        Parameters
        ----------
        samples
            Shape (n,), 16 kHz.

        Returns
        -------
        NDArray
            Features of each two frames, shape (ceil(frames / 2), 3 width).
        """
        pieces = []
        num_frames = frames_in(len(samples))
        for start in range(0, num_frames, _PIECE_FRAMES):
            end = min(start + _PIECE_FRAMES, num_frames)
            piece = samples[HOP_SAMPLES * start : HOP_SAMPLES * (end - 1) + WINDOW_SAMPLES]
            bands = centred_mel(np.concatenate([as_floats(piece), _PADDING]))
            with mixed_precision():
                hidden = self(bands[None])[0, 1 : 1 + math.ceil((end - start) / 2)]
            pieces.append(hidden.clamp(-_MAX_HALF, _MAX_HALF).half().numpy())
        return np.concatenate(pieces)


class Readout(nn.Module):
    """Computes the posteriors of the states of two frames from each position's features."""

    mean: Tensor  # (inputs,)
    deviation: Tensor  # (inputs,)

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        num_inputs = len(KEPT_LAYERS) * shape.width
        self.register_buffer("mean", torch.zeros(num_inputs))
        self.register_buffer("deviation", torch.ones(num_inputs))
        self.inner = nn.Linear(num_inputs, _INNER)
        self.gru = nn.GRU(_INNER, _GRU, batch_first=True, bidirectional=True)
        self.output = nn.Linear(2 * _GRU + _INNER, 2 * shape.num_states)
        self.dropout = nn.Dropout(_DROPOUT)

    def forward(self, features: Tensor) -> Tensor:
        """Compute log posteriors: (batch, positions, inputs) to (batch, 2 positions, states)."""
        standard = ((features - self.mean) / self.deviation).clamp(
            -_MAX_DEVIATIONS, _MAX_DEVIATIONS
        )
        if self.training:
            standard = _noisy(standard)
        inner = self.dropout(gelu(self.inner(standard)))
        context, _ = self.gru(inner)
        logits = self.output(self.dropout(torch.cat([context, inner], dim=-1)))
        return log_softmax(logits.unflatten(-1, (2, -1)).flatten(1, 2), dim=-1)


@dataclass(frozen=True, slots=True)
class Teacher:
    """Whisper's encoder with a trained readout."""

    encoder: WholeEncoder
    readout: Readout

    @torch.no_grad()
    def targets_of(self, samples: NDArray[np.int16]) -> Targets:
        """Find the likeliest states of a recording's frames; their probabilities sum to one.

        Parameters
        ----------
        samples
            Shape (n,), 16 kHz, 25 ms or more.
        """
        features = torch.from_numpy(self.encoder.features(samples)).float()
        log_posteriors = self.readout(features[None])[0, : frames_in(len(samples))]
        best, states = log_posteriors.topk(min(_NUM_TARGETS, log_posteriors.shape[-1]))
        probs = best.softmax(dim=-1)
        return Targets(states.numpy().astype(np.uint16), probs.numpy().astype(np.float16))


def train_teacher(
    encoder: WholeEncoder,
    recordings: Sequence[Recording],
    *,
    seed: int,
    report: Report,
) -> Teacher:
    """Train a readout.

    Parameters
    ----------
    encoder
        With Whisper's weights, see :func:`kouxing.training.neural.whisper_weights.load_whisper`.
    recordings
        With the states of an alignment as targets. Their features are held in memory, 150 KB a
        second with Whisper base.
    seed
        Of the order. New weights, dropout and noise draw from PyTorch's own generator.
    report
        Receives lines of progress.
    """
    rng = np.random.default_rng(seed)
    sampling = sampling_probs(recordings)
    samples = [recording.samples for recording in recordings]
    features = process_all(encoder.features, samples, "encoded for the teacher", report)

    def draw() -> Sample:
        number = rng.choice(len(sampling), p=sampling)
        max_start = max(0, len(features[number]) - _CROP_POSITIONS)
        start = int(rng.integers(max_start + 1))
        end = start + _CROP_POSITIONS
        targets = recordings[number].targets.of(slice(2 * start, 2 * end))
        return features[number][start:end], targets

    readout = Readout(encoder.shape)
    drawn = rng.choice(len(sampling), size=_STANDARD_RECORDINGS, p=sampling)
    some = np.concatenate([features[number].astype(np.float32) for number in drawn])
    readout.mean[:] = torch.from_numpy(some.mean(axis=0))
    readout.deviation[:] = torch.from_numpy(some.std(axis=0) + 1e-3)
    averaged = AveragedModel(readout, avg_fn=late_mean(_MEAN_EXPONENT))
    optimizer = torch.optim.AdamW(readout.parameters(), weight_decay=_WEIGHT_DECAY)
    batches = batches_of(draw, _BATCH_POSITIONS, rng)
    for step in range(_NUM_STEPS):
        rise = min(1.0, (step + 1) / _WARM_UP_STEPS)
        fall = min(1.0, (_NUM_STEPS - step) / (_FALL * _NUM_STEPS))
        optimizer.param_groups[0]["lr"] = _RATE * rise * fall
        inputs, states, probs = next(batches)
        loss = cross_entropy(readout(inputs)[:, : states.shape[1]], states, probs)
        take_step(loss, optimizer, readout, averaged, _MAX_GRADIENT_NORM)
        if (step + 1) % math.ceil(_NUM_STEPS / 5) == 0:
            report(f"teacher, step {step + 1}: {float(loss.detach()):.3f} nats a frame")
    return Teacher(encoder.eval(), cast(Readout, averaged.module).eval())


def centred_mel(samples: NDArray[np.float32]) -> Tensor:
    """Whisper's log-mel bands of a whole recording, shape (80, n // 160)."""
    spectra = torch.stft(
        torch.from_numpy(samples),
        WINDOW_SAMPLES,
        HOP_SAMPLES,
        window=torch.hann_window(WINDOW_SAMPLES),
        return_complex=True,
    )[:, :-1]
    power = torch.from_numpy(mel_bands().T).float() @ spectra.abs().square()
    log_power = power.clamp(min=_MIN_POWER).log10()
    return (log_power.clamp(min=float(log_power.max()) - _FLOOR_DECADES) + 4) / 4


def process_all(
    process: Callable[[NDArray[np.int16]], T],
    recordings: Sequence[NDArray[np.int16]],
    what: str,
    report: Report,
) -> list[T]:
    """Process recordings side by side, one core each: faster than each on all cores.

    Parameters
    ----------
    process
        Takes samples of shape (n,).
    recordings
        Samples of each recording.
    what
        What has been done, for the lines of progress.
    report
        Receives them.
    """
    num_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    pool = ThreadPoolExecutor(num_threads)
    try:
        followed = with_progress(recordings, what, report)
        return [result for result, _ in zip(pool.map(process, recordings), followed, strict=True)]
    finally:
        pool.shutdown(cancel_futures=True)
        torch.set_num_threads(num_threads)


def _noisy(standard: Tensor) -> Tensor:
    """Add noise to features, (batch, positions, inputs); set some inputs and positions to 0."""
    batch, num_positions, num_inputs = standard.shape
    constant = torch.randn(batch, 1, num_inputs) * torch.rand(batch, 1, 1)
    noisy = standard + _NOISE * (constant + torch.randn_like(standard))
    noisy = noisy * (torch.rand(batch, 1, num_inputs) >= _HIDDEN_INPUTS)
    position = torch.arange(num_positions)[:, None]
    for _ in range(_NUM_MASKS):
        first = torch.randint(num_positions, (batch, 1, 1))
        width = torch.randint(1, _MAX_MASKED + 1, (batch, 1, 1))
        is_used = torch.rand(batch, 1, 1) < _MASK_PROB
        noisy = noisy * ~(is_used & (position >= first) & (position < first + width))
    return noisy
