"""Exports the audio encoder to ONNX, writes its model file, and reads it back into PyTorch.

The graph computes one step for any number of sessions.

=========== ================================================================ =====================
symbol      meaning                                                          shape
=========== ================================================================ =====================
frames      the two newest log-mel frames, the older one first               (sessions, 160)
state       states of both recurrent layers                                  (sessions, 2 width)
features    early and late components of Whisper's encoder, and lips: the    (sessions, 307)
            inputs of a lip model
phones      log posteriors                                                   (sessions, phones)
voice       probabilities of no voice, speech, sung or held voice, laughter  (sessions, 4)
scalars     probability of voicing; pitch, log2 of Hz; level; effort         (sessions, 4)
new_state   states after the step                                            (sessions, 2 width)
=========== ================================================================ =====================

Products use 8-bit integers (:mod:`kouxing.training.networks.onnx_graph`).
"""

from pathlib import Path

import numpy as np
import torch

from kouxing.services.recognizer.acoustic.encoder import FORMAT, VoiceKind
from kouxing.services.recognizer.acoustic.model_file import load_component
from kouxing.shared.arrays import Floats, UInt8
from kouxing.training.encoder.network import MEAN_PITCH, NUM_FEATURES, NUM_INPUTS, AudioEncoder
from kouxing.training.model_files import write_archive
from kouxing.training.networks.onnx_graph import (
    Graph,
    floats,
    module_arrays,
    read_tensors,
    read_weight,
)

_NUM_SCALARS = 4  # voicing, pitch, level, effort


def save_encoder(path: Path, encoder: AudioEncoder) -> None:
    """Write the model as an npz file (arrays only, no pickle)."""
    write_archive(path, {"format": np.array(FORMAT), "network": export_onnx(encoder)})


def export_onnx(encoder: AudioEncoder) -> UInt8:
    """Export a network as the bytes of an ONNX file with the inputs and outputs above."""
    return _EncoderGraph(encoder).build_step_model()


def rebuild_encoder(path: Path) -> AudioEncoder:
    """Read a model file back into PyTorch; UserError if it is missing or broken."""
    return load_component(
        path,
        FORMAT,
        "audio encoder",
        lambda file: _rebuild(file.array("network", None).astype(np.uint8)),
    )


def _rebuild(file: UInt8) -> AudioEncoder:
    tensors = read_tensors(file)
    num_outputs, width = len(tensors["output.bias"]), len(tensors["entry.bias"])
    num_phones = num_outputs - NUM_FEATURES - len(VoiceKind) - _NUM_SCALARS
    encoder = AudioEncoder(num_phones, width)
    names = {"entry": "entry.{}", "output": "output.{}"}
    for layer in ("first", "second"):
        for kind in ("ih", "hh"):
            names[f"{layer}.{kind}"] = f"{layer}.{{}}_{kind}_l0"
    state = {}
    for stem, name in names.items():
        weight = np.array(read_weight(tensors, stem), np.float32)
        state[name.format("weight")] = torch.from_numpy(weight)
        state[name.format("bias")] = torch.from_numpy(np.array(tensors[f"{stem}.bias"]))
    encoder.load_state_dict(state)
    return encoder.eval()


class _EncoderGraph(Graph):
    def __init__(self, encoder: AudioEncoder) -> None:
        super().__init__()
        self._parameters = module_arrays(encoder)
        self._width = len(self._parameters["entry.bias"])
        self._num_phones = encoder.columns.num_phones

    def build_step_model(self) -> UInt8:
        """Add all nodes; return the ONNX file."""
        width = self._width
        entered = self.node("Relu", [self.product("frames", self._parameters, "entry")])
        states = self.split("state", ["first_state", "second_state"])
        first = self._step(entered, states[0], "first")
        second = self._step(first, states[1], "second")
        self.node("Concat", [first, second], "new_state", axis=-1)
        rows = self.product(self.node("Add", [first, second]), self._parameters, "output")
        sizes = (NUM_FEATURES, self._num_phones, len(VoiceKind), 1, 3)
        names = ["features", "phone_logits", "voice_logits", "voicing_logit", "others"]
        _, phones, voice, voicing, others = self.split(rows, names, *sizes)
        self.node("LogSoftmax", [phones], "phones", axis=-1)
        self.node("Softmax", [voice], "voice", axis=-1)
        offset = self.constant("offset", np.array([MEAN_PITCH, 0, 0], np.float32))
        parts = [self.node("Sigmoid", [voicing]), self.node("Add", [others, offset])]
        self.node("Concat", parts, "scalars", axis=-1)
        inputs = [floats("frames", "sessions", NUM_INPUTS), floats("state", "sessions", 2 * width)]
        outputs = [
            floats("features", "sessions", NUM_FEATURES),
            floats("phones", "sessions", self._num_phones),
            floats("voice", "sessions", len(VoiceKind)),
            floats("scalars", "sessions", 4),
            floats("new_state", "sessions", 2 * width),
        ]
        return self.file("encoder", inputs, outputs)

    def _step(self, inputs: str, state: str, name: str) -> str:
        """Run a recurrent layer for one step: (sessions, width) to its new state."""
        parts = []
        for kind, values in (("ih", inputs), ("hh", state)):
            weights: dict[str, Floats] = {
                f"{name}.{kind}.{part}": self._parameters[f"{name}.{part}_{kind}_l0"]
                for part in ("weight", "bias")
            }
            gates = self.product(values, weights, f"{name}.{kind}")
            names = [f"{name}.{kind}.{part}" for part in ("gates", "new")]
            parts.append(self.split(gates, names, 2 * self._width, self._width))
        (input_gates, from_input), (state_gates, from_state) = parts
        gates = self.node("Sigmoid", [self.node("Add", [input_gates, state_gates])])
        reset, update = self.split(gates, [f"{name}.reset", f"{name}.update"])
        from_state = self.node("Mul", [reset, from_state])
        new = self.node("Tanh", [self.node("Add", [from_input, from_state])])
        retained = self.node("Mul", [update, self.node("Sub", [state, new])])
        return self.node("Add", [new, retained])
