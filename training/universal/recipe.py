"""Trains the universal readout from corpora, and writes its model card."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import NDArray

from kouxing.corpora.feature_cache import load_or_compute
from kouxing.corpora.speech_corpus import RowErrors, Utterance
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.blocks import EXTENSION_PREFIX, BlockModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.search.decoder import PathSegment
from kouxing.shared.arrays import Floats, Integers, UInt8
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import UNIVERSAL, PhoneInventory, load_inventory
from kouxing.training.blocks.export import ReadoutGraph
from kouxing.training.blocks.network import BlockReadout
from kouxing.training.model_card import write_card
from kouxing.training.model_files import save_universal
from kouxing.training.networks.labels import STATES_PER_PHONE, Alignment, alignment_statistics
from kouxing.training.networks.teacher import KEPT_LAYERS
from kouxing.training.phone_lm.recipe import estimate_phone_lm, join_sentences
from kouxing.training.seed import SEED
from kouxing.training.universal.alignment import Aligner
from kouxing.training.universal.encoder import FeatureEncoder
from kouxing.training.universal.features import LAYERS, WIDTH, Features, FeatureStore
from kouxing.training.universal.recordings import read_training_set
from kouxing.training.universal.trainer import CROPS_S, READOUT, train_readout

# chosen on held-out recordings
_ACOUSTIC_SCALE, _PHONE_PENALTY, _LM_SCALE, _RATE_WEIGHT = 0.6, 6.0, 1.0, 120.0
_LM_ORDER, _LM_NGRAMS = 3, 20_000


def train_universal(
    mandarin: Sequence[Path],
    output: Path,
    *,
    learners: Sequence[Path],
    languages: Sequence[Path],
    clips: Path | None,
    num_steps: int,
    any_license: bool,
) -> None:
    """Train the universal readout of the shipped block model, and write it with its card.

    The arguments are the options of ``kouxing train universal``. Raises ``UserError`` if there is
    nothing to train on, or a file cannot be read.
    """
    model = load_model()
    if not isinstance(model, BlockModel):
        raise UserError("the shipped model is not a block model; reinstall kouxing")
    torch.set_num_threads(1)  # reproducible sums on every machine
    torch.manual_seed(SEED)
    errors = RowErrors()
    inventory = load_inventory(UNIVERSAL)
    recordings, weights = read_training_set(
        mandarin, learners, languages, clips, errors, any_license=any_license
    )
    folder, states_file, checkpoint = (
        output.with_suffix(end) for end in (".features", ".states.npz", ".readout.pt")
    )
    store = FeatureStore(folder, FeatureEncoder(model, LAYERS))
    store.standardize(recordings)
    stored = list(store.read(recordings))
    by_name = {recording.utterance_id: recording for recording in recordings}
    aligner = Aligner(by_name, inventory)
    saved = load_or_compute(states_file, partial(_aligned_states, aligner, stored))
    pieces = np.split(saved["states"].astype(np.int64), np.cumsum(saved["lengths"])[:-1])
    states = dict(zip(saved["names"].tolist(), pieces, strict=True))
    aligned = [features for features in stored if features.name in states]
    readout = train_readout(
        BlockReadout(WIDTH, STATES_PER_PHONE * len(inventory), READOUT),
        aligned,
        states,
        [weights[features.name] for features in aligned],
        num_steps=num_steps,
        checkpoint=checkpoint,
    )
    topology, log_prior = _statistics(by_name, states, weights, inventory)
    readout.mean[:] = torch.from_numpy(store.mean)
    readout.deviation[:] = torch.from_numpy(store.deviation)
    extension = export_extension(readout, model, LAYERS)
    universal = replace(
        model,
        topology=replace(
            topology, lm_scale=_LM_SCALE, phone_penalty=_PHONE_PENALTY, rate_weight=_RATE_WEIGHT
        ),
        network=np.concatenate([model.network, extension]),
        log_prior=log_prior,
        acoustic_scale=_ACOUSTIC_SCALE,
    )
    save_universal(output, universal, extension)
    write_card(
        output,
        title="Universal phones: a second readout of the block network",
        details=f"on layers of `blocks.npz`, which is not changed, seed {SEED}, "
        f"{num_steps} steps of {CROPS_S:.0f} s of audio, on the recordings below",
        recordings=recordings,
        errors=errors,
    )
    errors.report_to(print_message)
    for path in (states_file, checkpoint):
        path.unlink()
    shutil.rmtree(folder)


def _aligned_states(aligner: Aligner, stored: Sequence[Features]) -> dict[str, NDArray[Any]]:
    """Align recordings; return the arrays of the file of states."""
    states = aligner.align(stored)
    return {
        "names": np.array(list(states)),
        "lengths": np.array([len(path) for path in states.values()]),
        "states": np.concatenate(list(states.values())).astype(np.int16),
    }


def _statistics(
    recordings: Mapping[str, Utterance],
    states: Mapping[str, Integers],
    weight_of: Mapping[str, float],
    inventory: PhoneInventory,
) -> tuple[Topology, Floats]:
    """Count transitions, durations and n-grams of phones; return the states' log priors too."""
    aligned = [
        Alignment(states=path, phones=_phones_of(path), weight=weight_of[name])
        for name, path in states.items()
    ]
    stream = join_sentences([recordings[name].phones for name in states], inventory)
    phone_lm = estimate_phone_lm([stream], inventory, order=_LM_ORDER, max_ngrams=_LM_NGRAMS)
    weights = [weight_of[name] for name in states]
    return alignment_statistics(aligned, list(np.array(weights) / sum(weights)), phone_lm)


def _phones_of(states: Integers) -> list[PathSegment]:
    """Return the phones of aligned frames. Equal neighbors differ in their states' order."""
    starts = np.flatnonzero(
        np.diff(states // STATES_PER_PHONE, prepend=-1) | (np.diff(states, prepend=0) < 0)
    )
    ends = np.append(starts[1:], len(states))
    return [
        PathSegment(int(states[start]) // STATES_PER_PHONE, int(start), int(end))
        for start, end in zip(starts, ends, strict=True)
    ]


def export_extension(readout: BlockReadout, model: BlockModel, layers: Sequence[int]) -> UInt8:
    """Export a readout. Its layers must be among those that the model's readout reads.

    The result is a part of an ONNX file. Appended to the bytes of the block network, it adds the
    readout's nodes, an input and two outputs, because joined protocol buffers merge their lists.
    One run then computes both, because the readout's inputs are hidden layers of the block network.
    """
    sizes = model.runner.sizes
    network = onnx.load_from_string(model.network.tobytes()).graph
    standardized = next(node for node in network.node if "readout.mean" in node.input)
    joined = next(node for node in network.node if standardized.input[0] in node.output)
    kept = [joined.input[KEPT_LAYERS.index(layer)] for layer in layers]
    graph = ReadoutGraph(readout, sizes.block, sizes.length, EXTENSION_PREFIX)
    graph.log_posteriors(graph.node("Concat", kept, axis=-1))
    return graph.extension([graph.state], graph.outputs)
