"""Refines a trained audio encoder with more disturbances, above all music.

The trained encoder is the teacher. It receives clean audio, and the refined network receives the
same audio with a background, so no other teacher is needed:

    loss = E(early) + E(late) + 3 E(lips / deviation) + H(phones) / 2 + H(voice) + H(voicing) / 3
           + |pitch| + E(level) / 5 + E(effort) / 5

E, H and the outputs are those of :mod:`kouxing.training.encoder.network`; the targets are the
teacher's outputs. The voiced parts of sung copies count as sung. Breath, and a background alone,
count as no voice; the background may be several voices at once.

The result is a weighted mean of the weights before and after. It is better than both: it keeps the
lips in clean audio, and its lips are closer to those in clean audio if there is music or babble.

Sources: Hinton, Vinyals and Dean 2015, "Distilling the knowledge in a neural network"; Wortsman et
al. 2022, "Robust fine-tuning of zero-shot models" (the mean of the weights).
"""

from collections.abc import Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from rich.progress import track
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, log_softmax

from kouxing.corpora.feature_cache import load_or_compute
from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.encoder import VoiceKind
from kouxing.shared.arrays import Float16, Floats
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
from kouxing.training.encoder.network import (
    LIPS_WEIGHT,
    LOOK_AHEAD,
    PHONES_WEIGHT,
    SCALAR_WEIGHT,
    VOICING_WEIGHT,
    AudioEncoder,
    weighted_mean,
)
from kouxing.training.encoder.singing import sing
from kouxing.training.encoder.targets import (
    MAX_SAMPLES,
    MAX_SUNG_SAMPLES,
    MIN_SAMPLES,
    VOICE,
    Piece,
    Samples,
    SourceRecording,
    TargetColumns,
)
from kouxing.training.encoder.teachers import ENCODER_FRAME_SAMPLES
from kouxing.training.encoder.trainer import train_on_batches
from kouxing.training.seed import SEED

_LEARNING_RATE, _WARM_UP_STEPS, _DECAY_FRACTION = 5e-4, 60, 0.6
_BACKGROUND_ONLY_PROB, _BABBLE_ONLY_PROB = 0.2, 0.15
_NUM_SUNG_COPIES, _SUNG_WEIGHT = 900, 0.4  # sung copies; their total weight, relative to speech
# chosen on held-out sounds: weight of the refined weights in the mean with the first ones, and the
# number added to the logit of a sung voice
_REFINED_FRACTION, _SUNG_BIAS = 0.6, 1.5
_TEACHER_PEAK = 0.5  # of the teacher's audio
_TINY = 1e-9

RefiningBatch = tuple[Float16, Float16, Floats]


def refine(
    teacher: AudioEncoder,
    recordings: Sequence[SourceRecording],
    backgrounds: Sequence[Samples],
    errors: RowErrors,
    *,
    num_steps: int,
    samples_path: Path,
    checkpoint: Path,
) -> AudioEncoder:
    """Train a copy of the teacher; return the mean of the weights of both.

    ``samples_path`` caches the samples of the recordings. Training resumes from ``checkpoint``.
    """
    saved = load_or_compute(samples_path, partial(_read_samples, recordings, errors))
    pieces = _pieces_of(saved)
    batch_source = BatchSource(
        pieces, backgrounds, TargetColumns(0), _BACKGROUND_ONLY_PROB, _BABBLE_ONLY_PROB
    )
    student = deepcopy(teacher).to(DEVICE)
    teacher.to(DEVICE)
    _, clean, _ = draw_refining_batch(batch_source, 0)
    with torch.no_grad():
        lips = teacher.split(teacher(torch.from_numpy(clean).to(DEVICE).float())).lips
    refined = train_on_batches(
        student,
        partial(draw_refining_batch, batch_source),
        partial(imitation_loss, teacher, student, lips.flatten(0, 1).std(dim=0)),
        learning_rate=_LEARNING_RATE,
        warm_up_steps=_WARM_UP_STEPS,
        decay_fraction=_DECAY_FRACTION,
        num_steps=num_steps,
        checkpoint=checkpoint,
    )
    first = teacher.cpu().state_dict()
    refined.load_state_dict(
        {
            name: torch.lerp(first[name], value, _REFINED_FRACTION)
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
    deviation: Tensor,
    inputs: Tensor,
    clean: Tensor,
    voice: Tensor,
) -> Tensor:
    """Compute the loss of a batch; ``deviation`` is the lips' standard deviation, (51,)."""
    with torch.no_grad():
        expected = teacher.split(teacher(clean).float())
    outputs = student.split(student(inputs).float())
    has_speech = (~(voice == VoiceKind.NONE).all(dim=1, keepdim=True)).expand_as(voice)
    voices = expected.voice.softmax(dim=-1)
    kinds = torch.cat([voice[:, :1].expand(-1, LOOK_AHEAD), voice[:, :-LOOK_AHEAD]], dim=1)
    for kind in (VoiceKind.NONE, VoiceKind.SUNG):
        voices[kinds == kind] = torch.eye(len(VoiceKind), device=voices.device)[kind]
    entropy = -(expected.phones.softmax(dim=-1) * log_softmax(outputs.phones, dim=-1)).sum(dim=-1)
    is_voiced = expected.voicing.sigmoid()
    voicing = binary_cross_entropy_with_logits(outputs.voicing, is_voiced, reduction="none")
    pitch = (outputs.pitch - expected.pitch).abs()
    lips = (outputs.lips - expected.lips) / deviation
    losses = (
        weighted_mean((outputs.early - expected.early).square().mean(dim=-1), has_speech),
        weighted_mean((outputs.late - expected.late).square().mean(dim=-1), has_speech),
        LIPS_WEIGHT * weighted_mean(lips.square().mean(dim=-1), has_speech),
        PHONES_WEIGHT * weighted_mean(entropy, has_speech),
        -(voices * log_softmax(outputs.voice, dim=-1)).sum(dim=-1).mean(),
        VOICING_WEIGHT * weighted_mean(voicing, has_speech),
        weighted_mean(pitch, has_speech * is_voiced),
        SCALAR_WEIGHT * weighted_mean((outputs.level - expected.level).square(), has_speech),
        SCALAR_WEIGHT * weighted_mean((outputs.effort - expected.effort).square(), has_speech),
    )
    return torch.stack(losses).sum()


def _read_samples(recordings: Sequence[SourceRecording], errors: RowErrors) -> dict[str, ArrayLike]:
    """Read the recordings, and sing copies of some of them."""
    sounds, kinds, weights = [], [], []
    read = process_in_order(partial(_read, recordings), range(len(recordings)))
    for recording, sound in zip(
        recordings, track(read, "recordings", len(recordings)), strict=True
    ):
        if isinstance(sound, str):
            errors.add(recording.name, sound)
        elif len(sound) >= MIN_SAMPLES:
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
        return recordings[number].read()[:MAX_SAMPLES]
    except UserError as error:
        return str(error)


def _sung_copy(
    sounds: Sequence[Samples], number: int
) -> tuple[Samples, NDArray[np.floating]] | None:
    """Sing the start of a recording; return samples and kinds, or None without enough voice."""
    speech = as_floats(sounds[number][:MAX_SUNG_SAMPLES])
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
