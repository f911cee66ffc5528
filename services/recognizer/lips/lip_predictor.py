"""The lip predictor: predicts mouth shapes from the features of the audio encoder.

Source: Cho et al. 2014, "Learning phrase representations using RNN encoder-decoder" (gated
recurrent unit).

======== ============================================================ ==================
symbol   meaning                                                      shape
======== ============================================================ ==================
f        an encoder frame: its two log-mel frames, and the encoder's  (160 + encoder's,)
         features
x        principal components of f                                    (components,)
u        relu(U x + b_u)                                              (units,)
h        state of the gated recurrent unit, driven by u               (units,)
y        for each delay the FAPs, and log odds of closure and of      (delays, 17)
         lip to teeth
======== ============================================================ ==================

    y = A f + B [h, u] + c

The last features are the encoder's own estimate of the lips. This estimate was learned from many
voices, so it generalizes best and contributes most to the FAPs. A also contains linear regressions
to the lips of filmed speakers. B [h, u] follows these speakers more closely.

During speech, there is an encoder frame every 20 ms. From the audio up to T, it gives the mouth at
T - d for every delay d. Elsewhere, there are no lip positions. Every encoder frame is one step, so
neither the chunking nor other sessions affect the lip positions.

Cost: about 4 ms of one core per second of speech.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from kouxing.services.recognizer.acoustic.encoder import load_encoder
from kouxing.services.recognizer.acoustic.model_file import Archive, load_component
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_ENCODER_FRAME
from kouxing.services.recognizer.front_end.whisper_mel import NUM_MELS
from kouxing.services.recognizer.lips.mouth_profile import MouthProfile, parse_mouth_profile
from kouxing.shared.arrays import Floats
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.events import LipPositions

LIP_PREDICTOR_PATH = Path(__file__).parents[1] / "models" / "lips.npz"
FORMAT = "lips 4"
# FAPs that a camera tracks. The left and the right FAP of a pair have the same value.
LIP_FAPS = (3, 4, 5, 6, 8, 10, 12, 16, 17, 51, 52, 53, 55, 57, 59)
OTHER_SIDE = {6: 7, 8: 9, 10: 11, 12: 13, 53: 54, 55: 56, 57: 58, 59: 60}
NUM_LIP_FAPS = len(LIP_FAPS)
CLOSURE, LIP_TO_TEETH = NUM_LIP_FAPS, NUM_LIP_FAPS + 1  # columns of the outputs, after the FAPs
NUM_OUTPUTS = NUM_LIP_FAPS + 2

_MAX_DELAYS, _MAX_DELAY_S = 16, 1.0
_MAX_SIZE = 4096  # limit for the numbers of features, components and units
# columns of the tracked FAPs, of those on one side, and of the same FAPs on the other side
_COLUMNS, _ONES, _OTHERS = (
    np.array([MOUTH_FAPS.index(fap) for fap in faps])
    for faps in (LIP_FAPS, OTHER_SIDE, OTHER_SIDE.values())
)


@dataclass(frozen=True, kw_only=True)
class GruLipPredictor:
    """A lip predictor with a gated recurrent unit, shared by any number of streams."""

    delays: Floats  # (delays,) seconds, ascending; a negative delay is a forecast
    feature_mean: Floats  # (features,)
    projection: Floats  # (features, components)
    entry_weights: Floats  # (components, units): U
    entry_bias: Floats  # (units,): b_u
    input_weights: Floats  # (units, 3 units): reset, update and new
    input_bias: Floats  # (3 units,)
    state_weights: Floats  # (units, 3 units)
    state_bias: Floats  # (3 units,)
    lip_weights: Floats  # (last features, delays, 17): A; the weights of all other features are 0
    output_weights: Floats  # (2 units, delays, 17): B
    output_bias: Floats  # (delays, 17): c

    @cached_property
    def delays_s(self) -> tuple[float, ...]:
        """Available delays in seconds, ascending."""
        return tuple(round(float(delay_s), 6) for delay_s in self.delays)

    @cached_property
    def _weights_by_delays(self) -> dict[tuple[int, ...], tuple[Floats, Floats]]:
        return {}

    def weights_for_delays(self, delays: Sequence[int]) -> tuple[Floats, Floats]:
        """Return A and B for some delays, (features, delays 17), (2 units, delays 17).

        Streams with the same delays share them.
        """
        key = tuple(delays)
        if key not in self._weights_by_delays:
            lips, output = (
                weights[..., list(delays), :].reshape(-1, len(delays) * NUM_OUTPUTS)
                for weights in (self.lip_weights, self.output_weights)
            )
            self._weights_by_delays[key] = lips, output
        return self._weights_by_delays[key]

    def create_stream(self, delays_s: Sequence[float]) -> GruLipPredictorStream:
        """Create a session's stream; raises ``UserError`` if the model lacks one of the delays."""
        unknown = [delay_s for delay_s in delays_s if delay_s not in self.delays_s]
        if unknown:
            choices = ", ".join(f"{1e3 * delay_s:g}" for delay_s in self.delays_s)
            raise UserError(
                f"the lip predictor has no delay of {1e3 * unknown[0]:g} ms; choose {choices}"
            )
        return GruLipPredictorStream(self, [self.delays_s.index(delay_s) for delay_s in delays_s])

    @cached_property
    def digest(self) -> bytes:
        """SHA-256 of the weights, which a mouth profile contains."""
        hasher = hashlib.sha256()
        for field in fields(self):
            hasher.update(getattr(self, field.name).tobytes())
        return hasher.digest()

    @property
    def residual_shape(self) -> tuple[int, int, int]:
        """Shape of a mouth profile's residual."""
        num_inner, num_delays, _ = self.output_weights.shape
        return num_inner, num_delays, NUM_LIP_FAPS

    def with_mouth_profile(self, content: bytes) -> GruLipPredictor:
        """Adapt the model to a mouth profile; raises as ``parse_mouth_profile``."""
        return self.adapt(parse_mouth_profile(content, self.digest, self.residual_shape))

    def adapt(self, profile: MouthProfile) -> GruLipPredictor:
        """Adapt the model to one speaker."""
        faps = slice(NUM_LIP_FAPS)
        lips, output, bias = (
            weights.copy() for weights in (self.lip_weights, self.output_weights, self.output_bias)
        )
        for weights in (lips, output, bias):
            weights[..., faps] *= profile.scale
        output[..., faps] += profile.residual
        bias[..., faps] += profile.offset
        return replace(self, lip_weights=lips, output_weights=output, output_bias=bias)


class GruLipPredictorStream:
    """Predicts the lip positions of one session, segment by segment."""

    def __init__(self, model: GruLipPredictor, delays: Sequence[int]) -> None:
        self._model = model
        self._delays_s = [model.delays_s[delay] for delay in delays]
        self._lip_weights, self._output_weights = model.weights_for_delays(delays)
        self._output_bias = model.output_bias[list(delays)]
        self.reset()

    def reset(self) -> None:
        """Start a new segment of speech."""
        self._state = np.zeros(len(self._model.state_weights), np.float32)
        # [h, u] at the last encoder frame
        self.inner = np.zeros(len(self._model.output_weights), np.float32)

    def process_encoder_frame(
        self, known_s: float, frames: Floats, features: Floats
    ) -> list[LipPositions]:
        """Return the lip positions of an encoder frame; see ``LipPredictorStream``."""
        outputs = self.step(join_features(frames, features))
        return [
            LipPositions(
                time_s=known_s - delay_s,
                delay_s=delay_s,
                faps=expand_mouth_faps(row[:NUM_LIP_FAPS]),
                closure=float(_sigmoid(row[CLOSURE])),
                lip_to_teeth=float(_sigmoid(row[LIP_TO_TEETH])),
            )
            for delay_s, row in zip(self._delays_s, outputs, strict=True)
        ]

    def step(self, features: Floats) -> Floats:
        """Compute the outputs, (delays, 17), from an encoder frame's features, (features,)."""
        model = self._model
        centered = features - model.feature_mean
        component = (centered @ model.projection).astype(np.float32, copy=False)
        hidden_input = np.maximum(component @ model.entry_weights + model.entry_bias, 0)
        from_input = hidden_input @ model.input_weights + model.input_bias
        from_state = self._state @ model.state_weights + model.state_bias
        size = len(self._state)
        gates = _sigmoid(from_input[: 2 * size] + from_state[: 2 * size])
        reset, update = gates[:size], gates[size:]
        new = np.tanh(from_input[2 * size :] + reset * from_state[2 * size :])
        self._state = (1 - update) * new + update * self._state
        from_lips = features[-len(model.lip_weights) :] @ self._lip_weights
        self.inner = np.concatenate([self._state, hidden_input])
        recurrent = self.inner @ self._output_weights
        outputs: Floats = (from_lips + recurrent).reshape(self._output_bias.shape)
        return outputs + self._output_bias


def join_features(frames: Floats, features: Floats) -> Floats:
    """Join an encoder frame's log-mel frames, (2, 80), with the encoder's features."""
    return np.concatenate([frames, features], axis=None)


def expand_mouth_faps(lips: Floats) -> Floats:
    """Return all FAPs of the mouth, (28,), from the FAPs that a camera tracks, (15,)."""
    faps = np.zeros(len(MOUTH_FAPS), np.float32)
    faps[_COLUMNS] = lips
    faps[_OTHERS] = faps[_ONES]
    return faps


def _sigmoid(x: Floats) -> Floats:
    """Return 1 / (1 + exp(-x)); this form cannot overflow."""
    half = np.float32(0.5)
    probability: Floats = half * np.tanh(half * x) + half
    return probability


def load_lip_predictor(path: Path = LIP_PREDICTOR_PATH) -> GruLipPredictor:
    """Read a file; raises ``UserError`` if it is missing, broken or of another format."""
    return load_component(path, FORMAT, "lip predictor", _parse_lip_predictor)


def _parse_lip_predictor(archive: Archive) -> GruLipPredictor:
    """Build the predictor after checking every size; raises ``ValueError`` if a size is wrong."""
    delays = archive.floats("delays", *_read_shape(archive, "delays", 1))
    if len(delays) > _MAX_DELAYS or np.abs(delays).max() > _MAX_DELAY_S:
        raise ValueError(f"its delays are {delays.tolist()}")
    if (np.diff(delays) <= 0).any():
        raise ValueError("its delays do not rise")
    num_features, num_components = _read_shape(archive, "projection", 2)
    _, units = _read_shape(archive, "entry_weights", 2)
    num_lips = _read_shape(archive, "lip_weights", 3)[0]
    if num_features != FRAMES_PER_ENCODER_FRAME * NUM_MELS + load_encoder().num_features:
        raise ValueError("it was trained with another encoder.npz; run kouxing train lips")
    if num_lips > num_features:
        raise ValueError(f"it reads {num_lips} lip values from {num_features} features")
    outputs = (len(delays), NUM_OUTPUTS)
    return GruLipPredictor(
        delays=delays,
        feature_mean=archive.floats("feature_mean", num_features),
        projection=archive.floats("projection", num_features, num_components),
        entry_weights=archive.floats("entry_weights", num_components, units),
        entry_bias=archive.floats("entry_bias", units),
        input_weights=archive.floats("input_weights", units, 3 * units),
        input_bias=archive.floats("input_bias", 3 * units),
        state_weights=archive.floats("state_weights", units, 3 * units),
        state_bias=archive.floats("state_bias", 3 * units),
        lip_weights=archive.floats("lip_weights", num_lips, *outputs),
        output_weights=archive.floats("output_weights", 2 * units, *outputs),
        output_bias=archive.floats("output_bias", *outputs),
    )


def _read_shape(archive: Archive, name: str, num_axes: int) -> tuple[int, ...]:
    shape = archive.array(name, None).shape
    if len(shape) != num_axes or not all(1 <= size <= _MAX_SIZE for size in shape):
        raise ValueError(f"{name} has shape {shape}")
    return shape
