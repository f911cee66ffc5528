"""From corpora to the block model: labels, readout, tuned encoder, model card.

A trained neural model supplies HMMs, phone language model, state prior and acoustic scale, and
aligns the recordings with their texts (:mod:`kouxing.training.neural.labels`). First a readout is
trained on windows of Whisper's unchanged encoder. Then encoder and readout are tuned in blocks.

Training can be interrupted. Labels and checkpoints are stored next to the output, as
``.labels.npz``, ``.readout.pt`` and ``.network.pt``. The same command resumes from them, and
deletes them at the end.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import NEURAL_PATH, load_model
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.shared.errors import UserError
from kouxing.training.blocks.batches import BATCH_S
from kouxing.training.blocks.export import onnx_of
from kouxing.training.blocks.network import BlockEncoder, BlockReadout
from kouxing.training.blocks.readout import train_readout
from kouxing.training.blocks.trainer import BlockNetwork, train_network
from kouxing.training.model_card import write_card
from kouxing.training.neural.batches import Recording, Targets
from kouxing.training.neural.initial_network import init_encoder, load_whisper
from kouxing.training.neural.labels import Mix, label
from kouxing.training.training_set import FRAMES_PER_MINUTE, Report, load_examples


def save_labels(path: Path, recordings: Sequence[Recording]) -> None:
    """Write labeled recordings, so that training can resume."""
    np.savez(
        path,
        samples=np.concatenate([recording.samples for recording in recordings]),
        num_samples=[len(recording.samples) for recording in recordings],
        states=np.concatenate([recording.targets.states for recording in recordings]),
        probs=np.concatenate([recording.targets.probs for recording in recordings]),
        num_frames=[len(recording.targets) for recording in recordings],
        weights=[recording.weight for recording in recordings],
    )


def load_labels(path: Path) -> list[Recording]:
    """Read a file of :func:`save_labels`."""
    with np.load(path, allow_pickle=False) as file:
        kept = {name: file[name] for name in file.files}
    samples = np.split(kept["samples"], np.cumsum(kept["num_samples"])[:-1])
    bounds = np.cumsum(kept["num_frames"])[:-1]
    states, probs = np.split(kept["states"], bounds), np.split(kept["probs"], bounds)
    return [
        Recording(samples=sound, targets=Targets(*pair), weight=float(weight))
        for sound, *pair, weight in zip(samples, states, probs, kept["weights"], strict=True)
    ]


BLOCK_LENGTH = 5  # positions, live
_PHONE_PENALTY = 2.0  # most of the network's errors are deletions
_MIX = Mix({"sentence": (0.20, 400), "word": (0.04, 150), "synthetic": (0.04, 450)}, 0.72)


def train_blocks(
    corpora: Sequence[Path],
    output: Path,
    *,
    whisper: Path,
    start: Path | None = None,
    untranscribed: Sequence[Path] = (),
    seed: int = 0,
    num_readout_steps: int = 450,
    num_steps: int = 475,
    shipping: bool = True,
    report: Report = print,
) -> None:
    """Train the block model, and write it with its card.

    The arguments are the options of ``kouxing train blocks``. Raises UserError if there is nothing
    to train on, ``start`` is not a neural model, or a file cannot be read.
    """
    start = start or NEURAL_PATH
    before = load_model(start)
    if not isinstance(before, NeuralModel):
        raise UserError(f"{start} is not a neural model; give one from 'kouxing train neural'")
    torch.set_num_threads(1)  # reproducible sums on every machine
    torch.manual_seed(seed)
    whole = init_encoder(whisper, before.topology.num_states)
    errors = RowErrors()
    examples = load_examples(
        corpora, errors, before.inventory, shipping=shipping, with_samples=True
    )
    labels, readout_state, network_state = stored = [
        output.with_suffix(suffix) for suffix in (".labels.npz", ".readout.pt", ".network.pt")
    ]
    if not labels.exists():
        _, labeled = label(
            examples,
            untranscribed,
            _MIX,
            aligner=before,
            encoder=whole,
            errors=errors,
            seed=seed,
            report=report,
        )
        save_labels(labels, labeled)
    recordings = load_labels(labels)
    first = train_readout(
        whole,
        recordings,
        before.topology.num_states,
        seed=seed,
        num_steps=num_readout_steps,
        checkpoint=readout_state,
        report=report,
    )
    encoder = BlockEncoder(whole.shape)
    load_whisper(encoder, whisper)
    readout = BlockReadout(len(first.mean), encoder.shape.num_states, first.shape)
    readout.load_state_dict(first.state_dict())
    network = train_network(
        BlockNetwork(encoder, readout),
        whole,
        recordings,
        seed=seed,
        num_steps=num_steps,
        checkpoint=network_state,
        report=report,
    )
    model = BlockModel(
        topology=replace(before.topology, phone_penalty=_PHONE_PENALTY),
        network=onnx_of(network.encoder, network.readout, BLOCK_LENGTH),
        log_prior=before.log_prior,
        acoustic_scale=before.acoustic_scale,
    )
    model.save(output)
    minutes = sum(len(one.targets) for one in recordings) / FRAMES_PER_MINUTE
    write_card(
        output,
        title="Block model: Whisper's encoder in blocks with a cached past, gently tuned",
        details=f"with Whisper's weights (Radford et al. 2023, MIT license), seed {seed}, "
        f"{num_readout_steps} steps of the readout, {num_steps} of {BATCH_S} s of sound of all, "
        f"aligned by `{start.name}`, on {len(recordings)} recordings of {minutes:.0f} minutes "
        "drawn from those below",
        recordings=examples,
        errors=errors,
    )
    errors.report_to(report)
    for path in stored:
        path.unlink()
