"""Trains the small ear from corpora: targets, training, export, model card.

If training is interrupted, the same command resumes it. Next to the output, the folder ``.targets``
contains the targets, and ``.checkpoint.pt`` the training state. Targets of further recordings are
computed during training, so the first checkpoint exists after half an hour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kouxing.corpora.feature_cache import as_integers, read_audio
from kouxing.corpora.lip_clips import LipClip, read_clips
from kouxing.corpora.sounds import read_sounds
from kouxing.corpora.speech_corpus import RowErrors, Utterance, audio_files, is_held_out, may_ship
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.device import mixed_precision
from kouxing.training.ear.batches import BATCH_S, Material, batch_of
from kouxing.training.ear.export import save_ear
from kouxing.training.ear.network import Ear
from kouxing.training.ear.targets import Piece, Recording, Samples, TargetStore, Voice
from kouxing.training.ear.teachers import Teachers
from kouxing.training.model_card import write_card
from kouxing.training.neural.optimizer import Optimizer, warm_up_factor
from kouxing.training.training_set import Report, read_utterances, weights_of

_FIRST_CHUNKS, _STEPS_PER_CHUNK = 64, 24  # chunks at the start; steps until the next one
_RATE, _WARM_UP_STEPS = 1e-3, 200
_VALIDATE_EVERY, _NUM_VALIDATED = 250, 3  # steps; batches
_BACKGROUNDS = ("music", "noise", "babble")
_OTHER_VOICES = {"laughter": Voice.LAUGHTER, "breath": Voice.NONE}  # by the kind of a sound
_OTHER_VOICE_WEIGHT = 0.02  # per recording; the total weight of speech is 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Sources:
    """Folders of recordings."""

    corpora: Sequence[Path]
    untranscribed: Sequence[Path] = ()
    clips: Path | None = None  # with tracked lips; only their audio is used
    sounds: Sequence[Path] = ()
    shipping: bool = True  # use only data whose license allows distributing the model


def load_teachers(whisper: Path) -> tuple[Teachers, PhoneInventory]:
    """Load the teachers and their phone inventory."""
    torch.set_num_threads(1)  # reproducible sums on every machine
    causal, blocks = (load_model(model_path(name)) for name in ("neural", "blocks"))
    if not (isinstance(causal, NeuralModel) and isinstance(blocks, BlockModel)):
        raise UserError("the small ear needs the shipped acoustic models; reinstall kouxing")
    return Teachers(causal, blocks, whisper), blocks.inventory


def train_ear(
    sources: Sources,
    output: Path,
    *,
    whisper: Path,
    seed: int = 0,
    num_steps: int = 20_000,
    report: Report = print,
) -> None:
    """Train the small ear, and write it with its model card.

    Raises UserError if there is nothing to train on, or a file cannot be read.
    """
    teachers, inventory = load_teachers(whisper)
    errors = RowErrors()
    utterances = utterances_of(sources, errors, inventory, "train")
    if not utterances:
        raise errors.no_recording_error("of split 'train' in the corpora")
    sounds = [
        one for one in read_sounds(sources.sounds, shipping=sources.shipping) if not one.is_held_out
    ]
    backgrounds = [sound.samples for sound in sounds if sound.kind in _BACKGROUNDS]
    if not backgrounds:
        raise UserError("no music or noise to mix with the speech; give a folder with --sounds")
    others = [
        Recording(
            sound.name,
            partial(np.copy, sound.samples),
            _OTHER_VOICE_WEIGHT,
            _OTHER_VOICES[sound.kind],
        )
        for sound in sounds
        if sound.kind in _OTHER_VOICES
    ]
    recordings = [*_speech_of(sources, utterances), *others]
    store = TargetStore(output.with_suffix(".targets"), recordings, teachers, errors, seed)
    held_out = [
        piece
        for one in utterances_of(sources, errors, inventory, "dev")
        for piece in store.pieces_of(_recording(one.path, 1.0))
    ]
    trained = _train_network(
        len(inventory), store, held_out, backgrounds, num_steps, seed, output, report
    )
    save_ear(output, trained)
    write_card(
        output,
        title="Small ear: voice and lip features, a recurrent network",
        details=f"with Whisper's encoder as a teacher (Radford et al. 2023, MIT license), seed "
        f"{seed}, {num_steps} steps of {BATCH_S:.0f} s of sound",
        recordings=utterances,
        errors=errors,
        notes=f"It also learned from {len(sources.untranscribed)} folders of speech without text.",
    )
    errors.report_to(report)


def utterances_of(
    sources: Sources, errors: RowErrors, inventory: PhoneInventory, split: str
) -> list[Utterance]:
    """List the recordings of one split of all corpora."""
    return [
        utterance
        for corpus in sources.corpora
        for utterance in read_utterances(
            corpus, errors, inventory, split=split, shipping=sources.shipping
        )
    ]


def _speech_of(sources: Sources, utterances: Sequence[Utterance]) -> list[Recording]:
    """List all speech. Sources are weighted by the square root of their size; the sum is 1."""
    weights = zip(utterances, weights_of(utterances), strict=True)
    of_sources = [[(one.path, weight * one.seconds) for one, weight in weights]]
    for folder in sources.untranscribed:
        of_sources.append([(path, 1.0) for path in audio_files(folder) if not is_held_out(path)])
    if sources.clips:
        clips = read_clips(sources.clips, any_license=not sources.shipping, language=None)
        paths = [sources.clips / f"{clip.name}.flac" for clip in clips if may_train(clip, sources)]
        of_sources.append([(path, 1.0) for path in paths])
    shares = np.sqrt([sum(path.stat().st_size for path, _ in source) for source in of_sources])
    recordings = []
    for source, share in zip(of_sources, shares / shares.sum(), strict=True):
        total = sum(weight for _, weight in source)
        recordings += [_recording(path, share * weight / total) for path, weight in source]
    return recordings


def _recording(path: Path, weight: float) -> Recording:
    return Recording(path.name, lambda: as_integers(read_audio(path)), weight)


def may_train(clip: LipClip, sources: Sources) -> bool:
    """Return whether a clip may be used for training."""
    return clip.part != "held" and (may_ship(clip.license) or not sources.shipping)


def _train_network(
    num_phones: int,
    store: TargetStore,
    held_out: Sequence[Piece],
    backgrounds: Sequence[Samples],
    num_steps: int,
    seed: int,
    output: Path,
    report: Report,
) -> Ear:
    torch.manual_seed(seed)
    ear = Ear(num_phones)
    optimizer = Optimizer(
        ear,
        [{"params": list(ear.parameters()), "lr": _RATE}],
        weight_decay=0.01,
        max_norm=1.0,
        mean_exponent=3,
    )

    def loss_of(pieces: Sequence[Piece], number: int) -> Tensor:
        with mixed_precision():
            return ear.loss(*batch_of(Material(pieces, backgrounds), seed, number))

    def loss(step: int) -> Tensor:
        if step % _VALIDATE_EVERY == 0 and held_out:
            with torch.no_grad():
                losses = [float(loss_of(held_out, number)) for number in range(_NUM_VALIDATED)]
            report(f"step {step}: held-out loss {np.mean(losses):.3f}")
        return loss_of(store.pieces(_FIRST_CHUNKS + step // _STEPS_PER_CHUNK), step)

    return optimizer.train(
        loss,
        lambda step: warm_up_factor(step, _WARM_UP_STEPS),
        num_steps=num_steps,
        seed=seed,
        report=report,
        checkpoint=output.with_suffix(".checkpoint.pt"),
    )
