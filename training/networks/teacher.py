"""The teacher: Whisper's whole encoder with a readout of states.

Sources: Radford et al. 2023, "Robust speech recognition via large-scale weak supervision" (the
encoder with its front end, section 2.2, and its weights); Hinton, Vinyals and Dean 2015,
"Distilling the knowledge in a neural network" (a large network's posteriors are the targets of a
small one). The encoder is frozen. The readout learns the states of an alignment. The teacher sees
the whole recording, so it makes far fewer errors than a live network, also without text.

    m[k, j] = (max(log10 max(B[k] P[j], 1e-10), max log10 - 8) + 4) / 4

========== ========================================================== ======================
symbol     meaning                                                    shape
========== ========================================================== ======================
P          power spectra of 25 ms, centered on samples 160 j          (201, frames)
B          mel filters of                                             (80, 201)
           :mod:`kouxing.services.recognizer.front_end.whisper_mel`
m          log-mel bands; the floor is eight decades below the        (80, frames)
           recording's maximum
========== ========================================================== ======================

Position ``p`` of the encoder is centered on sample ``320 p``, the recognizer's frame ``t`` on
sample ``160 t + 200``. Frames ``2 p - 2`` and ``2 p - 1`` are closest to position ``p``, so they
are its output. Position 0 is dropped.

Whisper takes at most 30 s, so longer recordings are cut into pieces. One core processes 35 s of
audio in about a second, or 80 s in mixed precision.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from rich.progress import track
from torch import Tensor

from kouxing.services.recognizer.front_end.features import HOP_SAMPLES, WINDOW_SAMPLES, count_frames
from kouxing.services.recognizer.front_end.whisper_mel import mel_bands
from kouxing.shared.arrays import Float16, Floats, Int16
from kouxing.shared.audio.pcm import as_floats
from kouxing.training.device import DEVICE, mixed_precision
from kouxing.training.networks.batches import (
    FrameTargets,
    LabeledRecording,
    Sample,
    padded_batch,
    sampling_probs,
)
from kouxing.training.networks.network import Encoder, EncoderShape, Readout, ReadoutShape
from kouxing.training.networks.optimizer import cross_entropy, optimize
from kouxing.training.seed import SEED

NUM_LAYERS = 6  # layers of Whisper base's encoder
_NUM_STEPS = 600  # batches of up to 70 s of audio
KEPT_LAYERS = (-3, -2, -1)  # indices of the layers that are read
_PIECE_FRAMES = 2960  # with the padding, less than 30 s
_PADDING = np.zeros(4800, np.float32)  # appended to a piece
_MIN_POWER, _FLOOR_DECADES = 1e-10, 8.0
_MAX_HALF = 6e4  # a 16-bit float's range
_NUM_TARGETS = 8  # likeliest states of a frame
_BATCH_SAMPLES = 16_000 * (300 if DEVICE.type == "cuda" else 30)  # labeled together

READOUT = ReadoutShape(
    inner=256, gru=160, dropout=0.3, noise=0.3, constant_noise=0.3, feature_dropout=0.1, num_masks=2
)
_NUM_STANDARDIZED = 250  # recordings that mean and deviation are computed from

_NUM_CROPS = 14  # in a batch
_CROP_POSITIONS = 250
_LEARNING_RATE, _WARM_UP_STEPS = 2e-3, 30
_DECAY_FRACTION = 0.5  # fraction of the steps, at the end, over which the rate falls to 0


class WholeEncoder(Encoder):
    """Whisper's encoder: every position attends to the whole recording."""

    def __init__(self, shape: EncoderShape, kept_layers: Sequence[int] = KEPT_LAYERS) -> None:
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
        return torch.cat([after[layer] for layer in self.kept_layers], dim=-1)

    @torch.no_grad()
    def features(self, samples: Int16) -> Float16:
        """Encode samples, (n,) at 16 kHz; two frames share a row, (ceil(frames / 2), 3 width)."""
        pieces = []
        num_frames = count_frames(len(samples))
        for start in range(0, num_frames, _PIECE_FRAMES):
            end = min(start + _PIECE_FRAMES, num_frames)
            piece = samples[HOP_SAMPLES * start : HOP_SAMPLES * (end - 1) + WINDOW_SAMPLES]
            hidden = self.encode(np.concatenate([as_floats(piece), _PADDING])[None])
            hidden = hidden[0, 1 : 1 + math.ceil((end - start) / 2)]
            pieces.append(hidden.clamp(-_MAX_HALF, _MAX_HALF).half().cpu().numpy())
        return np.concatenate(pieces)

    def encode(self, samples: Floats) -> Tensor:
        """Encode padded samples, (batch, n), to (batch, positions, 3 width)."""
        with mixed_precision():
            hidden: Tensor = self(centered_mel(torch.from_numpy(samples).to(self.positions.device)))
        return hidden


@dataclass(frozen=True, slots=True)
class Teacher:
    """Whisper's encoder with a trained readout."""

    encoder: WholeEncoder
    readout: Readout

    @torch.no_grad()
    def label(self, sounds: Sequence[Int16]) -> list[FrameTargets]:
        """Find the likeliest states of the frames of recordings, (n,) at 16 kHz, 25 ms or longer.

        Recordings of similar lengths are computed together.
        """
        labels: dict[int, FrameTargets] = {}
        order = sorted(range(len(sounds)), key=lambda number: len(sounds[number]))
        batch: list[int] = []
        for number in track(order, "labeled recordings"):
            batch.append(number)
            if number == order[-1] or len(batch) * len(sounds[number]) > _BATCH_SAMPLES:
                targets = self._targets_of([sounds[index] for index in batch])
                labels.update(zip(batch, targets, strict=True))
                batch = []
        return [labels[number] for number in range(len(sounds))]

    def _targets_of(self, sounds: Sequence[Int16]) -> Iterator[FrameTargets]:
        """Yield the targets of recordings. The last recording must be the longest."""
        longest = count_frames(len(sounds[-1]))
        if longest > _PIECE_FRAMES:  # each alone, in pieces
            features = [torch.from_numpy(self.encoder.features(sound))[None] for sound in sounds]
        else:
            padded = np.zeros((len(sounds), len(sounds[-1]) + len(_PADDING)), np.float32)
            for row, sound in zip(padded, sounds, strict=True):
                row[: len(sound)] = as_floats(sound)
            features = [self.encoder.encode(padded)[:, 1 : 1 + math.ceil(longest / 2)]]
        for batch in features:
            log_posteriors = self.readout(batch.to(DEVICE).float())
            best, states = log_posteriors.topk(min(_NUM_TARGETS, log_posteriors.shape[-1]))
            rows = zip(states.cpu().numpy(), best.softmax(dim=-1).cpu().numpy(), strict=True)
            for (row, probs), sound in zip(rows, sounds, strict=False):
                window = slice(count_frames(len(sound)))
                yield FrameTargets(row[window].astype(np.uint16), probs[window].astype(np.float16))


def train_teacher(
    encoder: WholeEncoder, recordings: Sequence[LabeledRecording], num_states: int
) -> Teacher:
    """Train a readout on recordings whose targets are the states of an alignment.

    Their features stay in memory, 150 KB a second with Whisper base.
    """
    rng = np.random.default_rng(SEED)
    sampling = sampling_probs(recordings)
    tracked = track(recordings, "encoded for the teacher")
    features = [encoder.features(recording.samples) for recording in tracked]

    def draw() -> Sample:
        number = rng.choice(len(sampling), p=sampling)
        max_start = max(0, len(features[number]) - _CROP_POSITIONS)
        start = int(rng.integers(max_start + 1))
        end = start + _CROP_POSITIONS
        targets = recordings[number].targets.select(slice(2 * start, 2 * end))
        return features[number][start:end], targets

    readout = Readout(features[0].shape[1], num_states, READOUT).to(DEVICE)
    drawn = rng.choice(len(sampling), size=_NUM_STANDARDIZED, p=sampling)
    readout.standardize(torch.cat([torch.from_numpy(features[number]).float() for number in drawn]))

    def losses(_step: int) -> Iterator[Tensor]:
        batch = padded_batch([draw() for _ in range(_NUM_CROPS)])
        inputs, states, probs = (tensor.to(DEVICE) for tensor in batch)
        yield cross_entropy(readout(inputs)[:, : states.shape[1]], states, probs)

    trained = optimize(
        readout,
        [{"params": list(readout.parameters()), "lr": _LEARNING_RATE}],
        losses,
        num_steps=_NUM_STEPS,
        warm_up_steps=_WARM_UP_STEPS,
        decay_fraction=_DECAY_FRACTION,
        weight_decay=0.02,
    )
    return Teacher(encoder.eval(), trained)


def centered_mel(samples: Tensor) -> Tensor:
    """Whisper's log-mel bands of whole recordings, (batch, n) to (batch, 80, n // 160)."""
    spectra = torch.stft(
        samples,
        WINDOW_SAMPLES,
        HOP_SAMPLES,
        window=torch.hann_window(WINDOW_SAMPLES, device=samples.device),
        return_complex=True,
    )[..., :-1]
    bands = torch.from_numpy(mel_bands().T).float().to(samples.device)
    log_power = (bands @ spectra.abs().square()).clamp(min=_MIN_POWER).log10()
    loudest = log_power.amax(dim=(1, 2), keepdim=True)
    return (log_power.maximum(loudest - _FLOOR_DECADES) + 4) / 4
