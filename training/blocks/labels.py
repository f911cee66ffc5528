"""Target states of all recordings, from the alignment and from the teacher, stored in a file.

The shipped model aligns the recordings that have a text. The teacher
(:mod:`kouxing.training.neural.teacher`) learns this alignment and labels all recordings, clean and
whole. A target is the average of both, or only the teacher's label if there is no text.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.neural import NeuralModel
from kouxing.training.neural.alignment import align_all, aligner_scores
from kouxing.training.neural.batches import Recording, Targets
from kouxing.training.neural.scoring import samples_of
from kouxing.training.neural.teacher import WholeEncoder, process_all, train_teacher
from kouxing.training.progress import Report
from kouxing.training.training_set import FRAMES_PER_MINUTE, Example, load_untranscribed

_FULL_FOLDER_MINUTES = 35  # longer folders get the weight of this much speech


@dataclass(frozen=True, slots=True, kw_only=True)
class Draw:
    """How much of each kind of speech is drawn, and its share in training."""

    kinds: Mapping[str, tuple[float, int]]  # share, and maximum number of recordings
    untranscribed_share: float
    max_untranscribed: int  # pieces of each folder


def label(
    examples: Sequence[Example],
    untranscribed: Sequence[Path],
    *,
    draw: Draw,
    aligner: NeuralModel,
    encoder: WholeEncoder,
    errors: RowErrors,
    seed: int,
    report: Report,
) -> list[Recording]:
    """Align and label a random selection of recordings.

    ``examples`` have text and samples, in the language of ``aligner``. ``untranscribed`` are
    folders of recordings without text. ``encoder`` is Whisper's, for the teacher.
    """
    rng = np.random.default_rng(seed)
    drawn: list[Example] = []
    for kind, (_, limit) in draw.kinds.items():
        of_kind = [example for example in examples if example.kind == kind]
        drawn += [of_kind[place] for place in rng.permutation(len(of_kind))[:limit]]
    folders: list[list[NDArray[np.int16]]] = []
    for folder in untranscribed:
        pieces = load_untranscribed([folder], errors)
        folders.append(
            [pieces[place] for place in rng.permutation(len(pieces))[: draw.max_untranscribed]]
        )
    aligned = align_all(aligner_scores(aligner, drawn), aligner.topology, drawn, report)
    frames = dict.fromkeys(draw.kinds, 0.0)
    for one in aligned:
        frames[one.example.kind] += one.example.weight * len(one.states)
    recordings = []
    for one in aligned:
        kind = one.example.kind
        weight = draw.kinds[kind][0] * one.example.weight * len(one.states) / frames[kind]
        targets = Targets.hard(one.states)
        recordings.append(
            Recording(samples=samples_of(one.example), targets=targets, weight=weight)
        )
    teacher = train_teacher(encoder, recordings, seed=seed, report=report)
    all_sounds = [
        *(recording.samples for recording in recordings),
        *(sound for sounds in folders for sound in sounds),
    ]
    labels = process_all(teacher.targets_of, all_sounds, "labeled by the teacher", report)
    labeled = [
        Recording(
            samples=recording.samples,
            targets=recording.targets.averaged_with(targets),
            weight=recording.weight,
        )
        for recording, targets in zip(recordings, labels, strict=False)
    ]
    rest = iter(labels[len(recordings) :])
    of_folders = [list(zip(sounds, rest, strict=False)) for sounds in folders]
    sizes = [sum(len(targets) for _, targets in pairs) for pairs in of_folders]
    counted = [min(size, _FULL_FOLDER_MINUTES * FRAMES_PER_MINUTE) for size in sizes]
    for pairs, size, count in zip(of_folders, sizes, counted, strict=True):
        for sound, targets in pairs:
            weight = draw.untranscribed_share * count / sum(counted) * len(targets) / size
            labeled.append(Recording(samples=sound, targets=targets, weight=weight))
    return labeled


def save_labels(path: Path, recordings: Sequence[Recording]) -> None:
    """Write labeled recordings, so that training can resume."""
    width = max(recording.targets.states.shape[1] for recording in recordings)

    def padded(rows: NDArray[np.generic]) -> NDArray[np.generic]:
        return np.pad(rows, ((0, 0), (0, width - rows.shape[1])))

    np.savez(
        path,
        samples=np.concatenate([recording.samples for recording in recordings]),
        num_samples=[len(recording.samples) for recording in recordings],
        states=np.concatenate([padded(recording.targets.states) for recording in recordings]),
        probs=np.concatenate([padded(recording.targets.probs) for recording in recordings]),
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
