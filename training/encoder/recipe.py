"""Trains the audio encoder from corpora: targets, training, export, model card.

    clips, block network, Whisper's encoder -> lip teacher
    recordings, teachers -> targets -> audio encoder

Training can be interrupted. Next to the output, the folder ``.targets`` contains the lip teacher
and the targets, and ``.checkpoint.pt`` the training state. The same command resumes from them, and
deletes them at the end.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.lip_clips import (
    LipClip,
    label_clips,
    no_clip_error,
    read_clips,
    training_clips,
)
from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.sounds import read_sounds, training_backgrounds
from kouxing.corpora.speech_corpus import RowErrors, Utterance, audio_files, read_corpus
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.encoder import VoiceKind
from kouxing.services.recognizer.acoustic.load import load_model, model_path
from kouxing.services.recognizer.front_end.features import SAMPLE_RATE_HZ
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory
from kouxing.training.device import DEVICE
from kouxing.training.encoder.batches import BATCH_S, BatchSource, draw_batch
from kouxing.training.encoder.export import rebuild_encoder, save_encoder
from kouxing.training.encoder.lip_teacher import LipTeacher, teacher_features, train_lip_teacher
from kouxing.training.encoder.network import AudioEncoder
from kouxing.training.encoder.refinement import refine
from kouxing.training.encoder.targets import Samples, SourceRecording, TargetColumns, TargetStore
from kouxing.training.encoder.teachers import Teachers
from kouxing.training.encoder.trainer import train_on_batches
from kouxing.training.model_card import write_card
from kouxing.training.seed import SEED
from kouxing.training.training_set import weights_of

_LEARNING_RATE, _WARM_UP_STEPS, _DECAY_FRACTION = 2e-3, 200, 0.5
# by the kind of a sound
_OTHER_VOICES = {
    "laughter": VoiceKind.LAUGHTER,
    "breath": VoiceKind.NONE,
    "singing": VoiceKind.SUNG,
}
_BACKGROUND_SAMPLES = 30 * SAMPLE_RATE_HZ  # a longer background is split
_OTHER_VOICE_WEIGHT = 0.02  # per recording; the total weight of speech is 1


def load_teachers(whisper: Path) -> tuple[Teachers, PhoneInventory]:
    """Load the teachers and their phone inventory."""
    torch.set_num_threads(1)  # reproducible sums on every machine
    blocks = load_model(model_path("blocks"))
    if not isinstance(blocks, BlockModel):
        raise UserError("the audio encoder needs the shipped acoustic model; reinstall kouxing")
    return Teachers(blocks, whisper), blocks.inventory


@dataclass(frozen=True, slots=True)
class Sources:
    """The recordings for the training of an audio encoder."""

    utterances: Sequence[Utterance]
    num_untranscribed: int  # folders of speech without text
    clips: Sequence[LipClip]
    recordings: Sequence[SourceRecording]  # all speech, and other sounds of a voice
    backgrounds: Sequence[Samples]
    errors: RowErrors


def train_encoder(sources: Sources, output: Path, *, whisper: Path, num_steps: int) -> None:
    """Train the audio encoder, and write it with its model card.

    ``whisper`` is the folder of Whisper's model. Raises ``UserError`` if a file cannot be read.
    """
    teachers, inventory = load_teachers(whisper)
    folder, checkpoint = (output.with_suffix(end) for end in (".targets", ".checkpoint.pt"))
    folder.mkdir(parents=True, exist_ok=True)
    lip_teacher = _load_lip_teacher(folder / "lip_teacher.pt", sources.clips, teachers)
    store = TargetStore(folder, sources.recordings, teachers, lip_teacher, sources.errors)
    columns = TargetColumns(len(inventory))
    batch_source = BatchSource(store.pieces(), sources.backgrounds, columns)
    trained = _train_network(batch_source, num_steps, checkpoint)
    trained.rescale_lips(store.basis["lips_mean"], store.basis["lips_deviation"])
    teacher = "Whisper's encoder as a teacher (Radford et al. 2023, MIT license)"
    _write_model(output, trained, teacher, num_steps, sources)
    checkpoint.unlink()
    shutil.rmtree(folder)


def refine_encoder(sources: Sources, output: Path, *, start: Path, num_steps: int) -> None:
    """Refine the audio encoder ``start`` with more disturbances, and write it with its model card.

    Raises ``UserError`` if a file cannot be read.
    """
    torch.set_num_threads(1)  # reproducible sums on every machine
    recordings, checkpoint = (output.with_suffix(end) for end in (".samples.npz", ".checkpoint.pt"))
    refined = refine(
        rebuild_encoder(start),
        sources.recordings,
        sources.backgrounds,
        sources.errors,
        num_steps=num_steps,
        samples_path=recordings,
        checkpoint=checkpoint,
    )
    teacher = f"`{start.name}` as the first weights and the teacher"
    _write_model(output, refined, teacher, num_steps, sources)
    for path in (recordings, checkpoint):
        path.unlink()


def read_sources(
    corpora: Sequence[Path],
    clips: Path,
    untranscribed: Sequence[Path],
    sounds: Sequence[Path],
    *,
    any_license: bool,
) -> Sources:
    """Find what to train on; raises ``UserError`` if there is no speech, clip or background."""
    errors, inventory = RowErrors(), load_inventory(DEFAULT_LANGUAGE)
    utterances = [
        utterance
        for corpus in corpora
        for utterance in read_corpus(
            corpus, errors, inventory, split="train", any_license=any_license
        )
    ]
    if not utterances:
        raise errors.no_recording_error("of split 'train' in the corpora")
    all_sounds = read_sounds(sounds, any_license=any_license)
    backgrounds = [
        sound[start : start + _BACKGROUND_SAMPLES]
        for sound in training_backgrounds(all_sounds)
        for start in range(0, len(sound), _BACKGROUND_SAMPLES)
    ]
    if not backgrounds:
        raise UserError("no music or noise to mix with the speech; add a folder with --sounds")
    others = [
        SourceRecording(
            sound.name,
            partial(np.copy, sound.samples),
            _OTHER_VOICE_WEIGHT,
            _OTHER_VOICES[sound.kind],
        )
        for sound in all_sounds
        if sound.kind in _OTHER_VOICES and not sound.is_held_out
    ]
    all_clips = read_clips(clips, any_license=any_license, language=None)
    filmed = training_clips(all_clips, any_license=any_license)
    if not any(clip.is_in_sync for clip in filmed):
        raise no_clip_error(clips)
    paths = [clips / f"{clip.name}.flac" for clip in filmed]
    recordings = [*_speech_of(utterances, untranscribed, paths), *others]
    return Sources(utterances, len(untranscribed), filmed, recordings, backgrounds, errors)


def _write_model(
    output: Path, encoder: AudioEncoder, teacher: str, num_steps: int, sources: Sources
) -> None:
    """Write the model with its card, and report the recordings that could not be used."""
    save_encoder(output, encoder)
    write_card(
        output,
        title="Audio encoder: a recurrent network for voice and lip features",
        details=f"with {teacher}, seed {SEED}, {num_steps} steps of {BATCH_S:.0f} s of audio",
        recordings=sources.utterances,
        errors=sources.errors,
        notes=f"It also learned from {sources.num_untranscribed} folders of speech without text.",
    )
    sources.errors.report_to(print_message)


def _speech_of(
    utterances: Sequence[Utterance], untranscribed: Sequence[Path], filmed: Sequence[Path]
) -> list[SourceRecording]:
    """List all speech. Sources are weighted by the square root of their size; the sum is 1."""
    weights = zip(utterances, weights_of(utterances), strict=True)
    files_by_source = [
        [(utterance.path, weight * utterance.seconds) for utterance, weight in weights]
    ]
    for folder in untranscribed:
        files_by_source.append([(path, 1.0) for path in audio_files(folder)])
    files_by_source.append([(path, 1.0) for path in filmed])
    source_weights = np.sqrt(
        [sum(path.stat().st_size for path, _ in source) for source in files_by_source]
    )
    recordings = []
    for source, source_weight in zip(
        files_by_source, source_weights / source_weights.sum(), strict=True
    ):
        total = sum(weight for _, weight in source)
        recordings += [
            SourceRecording(path.name, partial(_read, path), source_weight * weight / total)
            for path, weight in source
        ]
    return recordings


def _read(path: Path) -> Samples:
    return as_integers(read_audio(path))


def _load_lip_teacher(path: Path, all_clips: Sequence[LipClip], teachers: Teachers) -> LipTeacher:
    """Load the lip teacher, or train it on the clips whose audio is in sync."""
    if not path.exists():
        clips = [clip for clip in all_clips if clip.is_in_sync]
        features = list(
            process_in_order(partial(teacher_features, teachers), [clip.samples for clip in clips])
        )
        phones = label_clips(load_model(), clips)
        unfinished = path.with_suffix(".part")
        train_lip_teacher(clips, features, phones).save(unfinished)
        unfinished.replace(path)
    return LipTeacher.load(path)


def _train_network(batch_source: BatchSource, num_steps: int, checkpoint: Path) -> AudioEncoder:
    torch.manual_seed(SEED)
    encoder = AudioEncoder(batch_source.columns.num_phones).to(DEVICE)
    return train_on_batches(
        encoder,
        partial(draw_batch, batch_source),
        encoder.loss,
        learning_rate=_LEARNING_RATE,
        warm_up_steps=_WARM_UP_STEPS,
        decay_fraction=_DECAY_FRACTION,
        num_steps=num_steps,
        checkpoint=checkpoint,
    )
