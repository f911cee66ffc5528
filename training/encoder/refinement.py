"""Refines a trained audio encoder with more disturbances, above all music.

The trained encoder is the teacher. It receives clean audio, and the refined network receives the
same audio with a background, so no other teacher is needed:

    loss = E(early) + E(late) + 3 E(lips / deviation) + H(phones) / 2 + H(voice) + H(voicing) / 3
           + |pitch| + E(level) / 5 + E(effort) / 5

E, H and the outputs are those of :mod:`kouxing.training.encoder.network`; the targets are the
teacher's outputs. The voiced parts of sung copies count as sung. Breath, and a
background alone, count as no voice.

The result is a weighted mean of the weights before and after. It is better than both: it keeps the
lips in clean audio, and its lips are closer to those in clean audio if there is music or babble.

Sources: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network"; Wortsman et
al. 2022, "Robust fine-tuning of zero-shot models" (the mean of the weights).
"""

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from numpy.typing import ArrayLike, NDArray
from onnx import numpy_helper
from rich.progress import track
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, log_softmax

from kouxing.corpora.feature_cache import load_or_compute
from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.encoder import FORMAT, VoiceKind
from kouxing.services.recognizer.acoustic.model_file import load_component
from kouxing.shared.audio.pcm import as_floats, as_integers
from kouxing.shared.errors import UserError
from kouxing.training.device import DEVICE
from kouxing.training.encoder.batches import (
    NUM_ENCODER_FRAMES,
    BatchSource,
    draw_excerpts,
    network_inputs,
    rows_at,
)
from kouxing.training.encoder.network import LOOK_AHEAD, NUM_FEATURES, AudioEncoder
from kouxing.training.encoder.singing import sing
from kouxing.training.encoder.targets import VOICE, Piece, Samples, SourceRecording, TargetColumns
from kouxing.training.encoder.teachers import ENCODER_FRAME_SAMPLES
from kouxing.training.networks.optimizer import optimize
from kouxing.training.seed import SEED

_LEARNING_RATE, _WARM_UP_STEPS, _DECAY_FRACTION = 5e-4, 60, 0.6
_BACKGROUND_ONLY_PROB = 0.17
_NUM_SUNG_COPIES, _SUNG_WEIGHT = 900, 0.4  # sung copies; their total weight, relative to speech
# chosen on held-out sounds: weight of the refined weights in the mean with the first ones, and the
# number added to the logit of a sung voice
_REFINED_FRACTION, _SUNG_BIAS = 0.6, 1.5
_MAX_SUNG_SAMPLES = 64_000  # limit for the speech of a sung copy
_MIN_SAMPLES, _MAX_SAMPLES = 8000, 320_000
_NUM_SCALARS = 4  # voicing, pitch, level, effort
_TEACHER_PEAK = 0.5  # of the teacher's audio
_LIPS_WEIGHT = 3.0
_PHONES_WEIGHT, _VOICING_WEIGHT, _SCALAR_WEIGHT = 1 / 2, 1 / 3, 1 / 5
_TINY = 1e-9

RefiningBatch = tuple[NDArray[np.float16], NDArray[np.float16], NDArray[np.float32]]


def refine(
    teacher: AudioEncoder,
    student: AudioEncoder,
    recordings: Sequence[SourceRecording],
    backgrounds: Sequence[Samples],
    errors: RowErrors,
    *,
    num_steps: int,
    samples_path: Path,
    checkpoint: Path,
) -> AudioEncoder:
    """Train the student, which has the teacher's weights; return the mean of its weights.

    ``samples_path`` caches the samples of the recordings. Training resumes from ``checkpoint``.
    """
    saved = load_or_compute(samples_path, partial(_read_samples, recordings, errors))
    pieces = _pieces_of(saved)
    batch_source = BatchSource(pieces, backgrounds, TargetColumns(0), _BACKGROUND_ONLY_PROB)
    teacher.to(DEVICE)
    student.to(DEVICE)
    deviation: Tensor | None = None
    batches: Iterator[RefiningBatch] | None = None

    def losses(step: int) -> Iterator[Tensor]:
        nonlocal batches, deviation
        if batches is None:
            numbers = range(step, num_steps)
            batches = process_in_order(partial(draw_refining_batch, batch_source), numbers)
        if deviation is None:
            first = torch.from_numpy(draw_refining_batch(batch_source, 0)[1]).to(DEVICE).float()
            with torch.no_grad():
                deviation = teacher.split(teacher(first)).lips.flatten(0, 1).std(dim=0)
        inputs, clean, voice = (torch.from_numpy(part).to(DEVICE).float() for part in next(batches))
        yield imitation_loss(teacher, student, inputs, clean, voice, deviation)

    first = {name: value.clone() for name, value in student.state_dict().items()}
    refined = optimize(
        student,
        [{"params": list(student.parameters()), "lr": _LEARNING_RATE}],
        losses,
        num_steps=num_steps,
        warm_up_steps=_WARM_UP_STEPS,
        decay_fraction=_DECAY_FRACTION,
        max_norm=1.0,
        checkpoint=checkpoint,
    ).cpu()
    refined.load_state_dict(
        {
            name: torch.lerp(first[name].cpu(), value, _REFINED_FRACTION)
            for name, value in refined.state_dict().items()
        }
    )
    with torch.no_grad():
        refined.split(refined.output.bias).voice[VoiceKind.SUNG] += _SUNG_BIAS
    return refined


def draw_refining_batch(batch_source: BatchSource, number: int) -> RefiningBatch:
    """Draw a batch by its number.

    Return the inputs of student and teacher, (batch, positions, 160), and the kinds of voice,
    (batch, positions), NaN where the teacher decides.
    """
    disturbed, clean, voice = [], [], []
    for excerpt in draw_excerpts(batch_source, number):
        peak = np.abs(excerpt.clean).max() + _TINY
        level_clean = (excerpt.clean * (_TEACHER_PEAK / peak)).astype(np.float32)
        disturbed.append(network_inputs(excerpt.disturbed)[:NUM_ENCODER_FRAMES])
        clean.append(network_inputs(level_clean)[:NUM_ENCODER_FRAMES])
        voice.append(rows_at(excerpt.targets, excerpt.source_positions())[:, VOICE])
    return (
        np.stack(disturbed, dtype=np.float16),
        np.stack(clean, dtype=np.float16),
        np.stack(voice, dtype=np.float32),
    )


def imitation_loss(
    teacher: AudioEncoder,
    student: AudioEncoder,
    inputs: Tensor,
    clean: Tensor,
    voice: Tensor,
    deviation: Tensor,
) -> Tensor:
    """Compute the loss of a batch; ``deviation`` is the lips' standard deviation, (51,)."""
    with torch.no_grad():
        expected = teacher.split(teacher(clean))
    outputs = student.split(student(inputs))
    has_speech = ~(voice == VoiceKind.NONE).all(dim=1, keepdim=True)
    voices = expected.voice.softmax(dim=-1)
    kinds = torch.cat([voice[:, :1].expand(-1, LOOK_AHEAD), voice[:, :-LOOK_AHEAD]], dim=1)
    for kind in (VoiceKind.NONE, VoiceKind.SUNG):
        voices[kinds == kind] = torch.eye(len(VoiceKind), device=voices.device)[kind]
    entropy = -(expected.phones.softmax(dim=-1) * log_softmax(outputs.phones, dim=-1)).sum(dim=-1)
    is_voiced = expected.voicing.sigmoid()
    voicing = binary_cross_entropy_with_logits(outputs.voicing, is_voiced, reduction="none")
    pitch = (outputs.pitch - expected.pitch).abs()
    losses = (
        _mean((outputs.early - expected.early).square().mean(dim=-1), has_speech),
        _mean((outputs.late - expected.late).square().mean(dim=-1), has_speech),
        _LIPS_WEIGHT
        * _mean(((outputs.lips - expected.lips) / deviation).square().mean(dim=-1), has_speech),
        _PHONES_WEIGHT * _mean(entropy, has_speech),
        -(voices * log_softmax(outputs.voice, dim=-1)).sum(dim=-1).mean(),
        _VOICING_WEIGHT * _mean(voicing, has_speech),
        _mean(pitch, has_speech * is_voiced),
        _SCALAR_WEIGHT * _mean((outputs.level - expected.level).square(), has_speech),
        _SCALAR_WEIGHT * _mean((outputs.effort - expected.effort).square(), has_speech),
    )
    return torch.stack(losses).sum()


def rebuild_encoder(path: Path) -> AudioEncoder:
    """Read a model file back into PyTorch; UserError if it is missing or broken."""
    return load_component(
        path,
        FORMAT,
        "audio encoder",
        lambda file: _rebuild(file.array("network", None).astype(np.uint8)),
    )


def _rebuild(file: NDArray[np.uint8]) -> AudioEncoder:
    graph = onnx.load_from_string(file.tobytes()).graph
    tensors = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    num_outputs, width = len(tensors["output.bias"]), len(tensors["entry.bias"])
    num_phones = num_outputs - NUM_FEATURES - len(VoiceKind) - _NUM_SCALARS
    encoder = AudioEncoder(num_phones, width)
    names = {"entry": "entry.{}", "output": "output.{}"}
    for layer in ("first", "second"):
        for kind in ("ih", "hh"):
            names[f"{layer}.{kind}"] = f"{layer}.{{}}_{kind}_l0"
    state = {}
    for stem, name in names.items():
        weight = (tensors[f"{stem}.integers"] * tensors[f"{stem}.scales"]).T
        state[name.format("weight")] = torch.from_numpy(np.array(weight, np.float32))
        state[name.format("bias")] = torch.from_numpy(np.array(tensors[f"{stem}.bias"]))
    encoder.load_state_dict(state)
    return encoder.eval()


def _mean(values: Tensor, weights: Tensor) -> Tensor:
    weights = weights.expand_as(values).float()
    return (values * weights).sum() / weights.sum().clamp(min=1)


def _read_samples(recordings: Sequence[SourceRecording], errors: RowErrors) -> dict[str, ArrayLike]:
    """Read the recordings, and sing copies of some of them."""
    sounds, kinds, weights = [], [], []
    read = process_in_order(partial(_read, recordings), range(len(recordings)))
    for recording, sound in zip(
        recordings, track(read, "recordings", len(recordings)), strict=True
    ):
        if isinstance(sound, str):
            errors.add(recording.name, sound)
        elif len(sound) >= _MIN_SAMPLES:
            known = float(VoiceKind.NONE) if recording.voice == VoiceKind.NONE else np.nan
            sounds.append(sound)
            kinds.append(np.full(len(sound) // ENCODER_FRAME_SAMPLES, known))
            weights.append(recording.weight)
    total = sum(weights)
    rng = np.random.default_rng(SEED)
    chosen = rng.choice(
        len(sounds), min(_NUM_SUNG_COPIES, len(sounds)), replace=False, p=np.array(weights) / total
    )
    copies = process_in_order(partial(_sung_copy, sounds), chosen.tolist())
    sung = [copy for copy in track(copies, "sung copies", len(chosen)) if copy]
    for samples, voices in sung:
        sounds.append(samples)
        kinds.append(voices)
        weights.append(_SUNG_WEIGHT * total / len(sung))
    return {
        "samples": np.concatenate(sounds),
        "num_samples": [len(sound) for sound in sounds],
        "kinds": np.concatenate(kinds).astype(np.float16),
        "weights": weights,
    }


def _read(recordings: Sequence[SourceRecording], number: int) -> Samples | str:
    """Read the start of a recording; return the message if it cannot be read."""
    try:
        return recordings[number].read()[:_MAX_SAMPLES]
    except UserError as error:
        return str(error)


def _sung_copy(
    sounds: Sequence[Samples], number: int
) -> tuple[Samples, NDArray[np.floating]] | None:
    """Sing the start of a recording; return samples and kinds, or None without enough voice."""
    speech = as_floats(sounds[number][:_MAX_SUNG_SAMPLES])
    sung = sing(speech, len(speech) // ENCODER_FRAME_SAMPLES, np.random.default_rng([SEED, number]))
    if sung is None:
        return None
    num_positions = min(len(sung.source), len(sung.samples) // ENCODER_FRAME_SAMPLES)
    samples = as_integers(sung.samples[: ENCODER_FRAME_SAMPLES * num_positions])
    is_voiced = (sung.is_sung & ~np.isnan(sung.pitch))[:num_positions]
    return samples, np.where(is_voiced, VoiceKind.SUNG, np.nan)


def _pieces_of(saved: dict[str, NDArray[Any]]) -> list[Piece]:
    ends = np.cumsum(saved["num_samples"])
    samples = np.split(saved["samples"], ends[:-1])
    positions = saved["num_samples"] // ENCODER_FRAME_SAMPLES
    kinds = np.split(saved["kinds"], np.cumsum(positions)[:-1])
    pieces = []
    for sound, kind, weight in zip(samples, kinds, saved["weights"], strict=True):
        targets = np.full((len(kind), VOICE + 1), np.nan, np.float16)
        targets[:, VOICE] = kind
        pieces.append(Piece(sound, targets, float(weight)))
    return pieces
