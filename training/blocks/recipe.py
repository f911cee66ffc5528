"""From corpora to the block model: labels, tuned encoder with its readout, model card.

A trained acoustic model aligns the recordings with their texts, and a teacher labels all recordings
(:mod:`kouxing.training.networks.labels`). Some recordings get a sung copy. Then encoder and readout
are tuned in blocks. The HMMs are estimated from the alignment; the phone language model comes from
the acoustic model.

Training can be interrupted. Labels and checkpoint are stored next to the output, as ``.labels.npz``
and ``.network.pt``. The same command resumes from them, and deletes them at the end.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from rich.progress import track

from kouxing.corpora.feature_cache import load_or_compute
from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.sounds import read_sounds, training_backgrounds
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import Topology
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.model_file import Archive, parse_topology
from kouxing.services.recognizer.acoustic.network import FRAMES_PER_ENCODER_FRAME
from kouxing.services.recognizer.front_end.features import HOP_SAMPLES, count_frames
from kouxing.shared.arrays import Floats
from kouxing.shared.audio.pcm import as_floats, as_integers
from kouxing.shared.command.terminal import print_message
from kouxing.training.blocks.batches import BATCH_S, BATCHES_PER_STEP, BatchSource
from kouxing.training.blocks.export import export_onnx
from kouxing.training.blocks.network import READOUT, BlockEncoder, BlockReadout
from kouxing.training.blocks.trainer import BlockNetwork, train_network
from kouxing.training.encoder.singing import sing
from kouxing.training.model_card import write_card
from kouxing.training.model_files import save_blocks, topology_arrays
from kouxing.training.networks.batches import FrameTargets, LabeledRecording
from kouxing.training.networks.labels import STATES_PER_PHONE, alignment_statistics, label
from kouxing.training.networks.whisper import init_encoder, load_whisper
from kouxing.training.seed import SEED
from kouxing.training.training_set import FRAMES_PER_MINUTE, load_examples

# Live, in positions. A short block gives early hypotheses. Its positions have less right context
# than the first positions of a long block, so R is longer than in training.
BLOCK_LENGTH, _RIGHT_CONTEXT, _PAST = 2, 14, 124
_ACOUSTIC_SCALE = 0.5
_PHONE_PENALTY, _RATE_WEIGHT = 3.2, 120.0  # chosen on speech of many rates, for `light` too
# fractions of the kinds of speech with text, and of recordings without text
_KINDS, _UNTRANSCRIBED = {"sentence": 0.16, "word": 0.06, "synthetic": 0.26}, 0.52
_SUNG_EVERY, _SUNG_WEIGHT = 10, 0.8  # every 10th recording has a sung copy; its relative weight
_MAX_SUNG_FRAMES = 800  # limit for the sung part of a recording


def train_blocks(
    corpora: Sequence[Path],
    output: Path,
    *,
    whisper: Path,
    start: Path | None,
    untranscribed: Sequence[Path],
    sounds: Sequence[Path],
    num_steps: int,
    any_license: bool,
) -> None:
    """Train the block model, and write it with its card.

    The arguments are the options of ``kouxing train blocks``. Raises ``UserError`` if there is
    nothing to train on, or a file cannot be read.
    """
    start = start or model_path("blocks")
    before = load_model(start)
    torch.set_num_threads(1)  # reproducible sums on every machine
    torch.set_float32_matmul_precision("high")  # faster on a GPU
    torch.manual_seed(SEED)
    num_states = STATES_PER_PHONE * len(before.inventory)
    whole = init_encoder(whisper)
    errors = RowErrors()
    backgrounds = training_backgrounds(read_sounds(sounds, any_license=any_license))
    examples = load_examples(corpora, errors, before.inventory, any_license=any_license)
    labels, checkpoint = (output.with_suffix(end) for end in (".labels.npz", ".network.pt"))

    def compute_labels() -> dict[str, ArrayLike]:
        alignments, recordings = label(
            examples,
            untranscribed,
            _KINDS,
            _UNTRANSCRIBED,
            aligner=before,
            encoder=whole,
            errors=errors,
        )
        weights = [recording.weight for recording in recordings[: len(alignments)]]
        statistics = alignment_statistics(alignments, weights, before.topology.phone_lm)
        return _label_arrays([*recordings, *_sung_copies(recordings)], *statistics)

    saved = load_or_compute(labels, compute_labels)
    recordings = _labeled_recordings(saved)
    encoder = BlockEncoder(whole.shape)
    load_whisper(encoder, whisper)
    readout = BlockReadout(whole.shape.width * len(whole.kept_layers), num_states, READOUT)
    network = train_network(
        BlockNetwork(encoder, readout),
        whole,
        BatchSource(recordings, backgrounds),
        num_steps=num_steps,
        checkpoint=checkpoint,
    ).cpu()
    topology = parse_topology(Archive(saved))
    model = BlockModel(
        topology=replace(topology, phone_penalty=_PHONE_PENALTY, rate_weight=_RATE_WEIGHT),
        network=export_onnx(network.encoder, network.readout, BLOCK_LENGTH, _RIGHT_CONTEXT, _PAST),
        log_prior=saved["log_prior"],
        acoustic_scale=_ACOUSTIC_SCALE,
    )
    save_blocks(output, model)
    minutes = sum(len(recording.targets) for recording in recordings) / FRAMES_PER_MINUTE
    write_card(
        output,
        title="Block model: Whisper's encoder in blocks with a cached past, gently tuned",
        details=f"with Whisper's weights (Radford et al. 2023, MIT license), seed {SEED}, "
        f"{num_steps} steps of {BATCHES_PER_STEP * BATCH_S} s of audio, aligned by `{start.name}`, "
        f"on {len(recordings)} recordings of {minutes:.0f} minutes: those below, speech "
        "without text, and sung copies",
        recordings=examples,
        errors=errors,
    )
    errors.report_to(print_message)
    for path in (labels, checkpoint):
        path.unlink()


def _label_arrays(
    recordings: Sequence[LabeledRecording], topology: Topology, log_prior: Floats
) -> dict[str, ArrayLike]:
    """Return labeled recordings and the statistics of their alignment as arrays of a file."""
    targets = [recording.targets for recording in recordings]
    return {
        **topology_arrays(topology),
        "log_prior": log_prior,
        "samples": np.concatenate([recording.samples for recording in recordings]),
        "num_samples": [len(recording.samples) for recording in recordings],
        "states": np.concatenate([frame_targets.states for frame_targets in targets]),
        "probs": np.concatenate([frame_targets.probs for frame_targets in targets]),
        "num_frames": [len(frame_targets) for frame_targets in targets],
        "weights": [recording.weight for recording in recordings],
    }


def _labeled_recordings(saved: dict[str, NDArray[Any]]) -> list[LabeledRecording]:
    """Restore the recordings from :func:`_label_arrays`."""
    samples = np.split(saved["samples"], np.cumsum(saved["num_samples"])[:-1])
    bounds = np.cumsum(saved["num_frames"])[:-1]
    states, probs = np.split(saved["states"], bounds), np.split(saved["probs"], bounds)
    return [
        LabeledRecording(samples=sound, targets=FrameTargets(*pair), weight=float(weight))
        for sound, *pair, weight in zip(samples, states, probs, saved["weights"], strict=True)
    ]


def _sung_copies(recordings: Sequence[LabeledRecording]) -> Iterator[LabeledRecording]:
    """Yield copies of some recordings that are sung, or have a held vowel."""
    numbers = np.random.default_rng(SEED).permutation(len(recordings))[::_SUNG_EVERY].tolist()
    copies = process_in_order(partial(_sung_copy, recordings), numbers)
    for copy in track(copies, "sung copies", len(numbers)):
        if copy:
            yield copy


def _sung_copy(recordings: Sequence[LabeledRecording], number: int) -> LabeledRecording | None:
    """Sing the start of a recording; None if it has too little voice."""
    recording = recordings[number]
    speech = as_floats(recording.samples[: HOP_SAMPLES * _MAX_SUNG_FRAMES])
    num_positions = len(speech) // HOP_SAMPLES // FRAMES_PER_ENCODER_FRAME
    sung = sing(speech, num_positions, np.random.default_rng([SEED, number]))
    if sung is None:
        return None
    frames = FRAMES_PER_ENCODER_FRAME * sung.source[:, None] + np.arange(FRAMES_PER_ENCODER_FRAME)
    targets = recording.targets.select(np.minimum(frames.flatten(), len(recording.targets) - 1))
    num_frames = min(len(targets), count_frames(len(sung.samples)))
    return LabeledRecording(
        samples=as_integers(sung.samples),
        targets=targets.select(slice(num_frames)),
        weight=_SUNG_WEIGHT * recording.weight,
    )
