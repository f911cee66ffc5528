"""Align recordings with their texts, and let a teacher label them.

The teacher (:mod:`kouxing.training.networks.teacher`) learns the alignment and labels all
recordings, clean and whole. A target is the average of both, or only the teacher's label if there
is no text.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.progress import track

from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import (
    AcousticModel,
    Topology,
    score_segment,
)
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.search.decoder import PathSegment
from kouxing.services.recognizer.search.forced_path import (
    build_utterance_graph,
    segments_of_path,
    viterbi_path,
)
from kouxing.services.recognizer.search.phone_lm import PhoneLanguageModel
from kouxing.shared.arrays import Floats, Integers
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.errors import UserError
from kouxing.training.durations import PhoneDurations
from kouxing.training.networks.batches import FrameTargets, LabeledRecording
from kouxing.training.networks.teacher import WholeEncoder, train_teacher
from kouxing.training.seed import SEED
from kouxing.training.training_set import FRAMES_PER_MINUTE, Example, load_untranscribed

STATES_PER_PHONE = 3
_MIN_STAY, _MAX_STAY = 0.05, 0.98
_LM_SCALE = 2.0  # chosen on development data
_PRIOR_SCALE = 0.5  # scale of the states' log priors; chosen on development data
_TEACHER_SET = 2000  # recordings of each kind that the teacher is trained on
_FULL_FOLDER_MINUTES = 45  # longer folders get the weight of this much speech


@dataclass(frozen=True, slots=True, kw_only=True)
class Alignment:
    """The state of each frame of a recording."""

    states: Integers  # (frames,) STATES_PER_PHONE for each phone
    phones: list[PathSegment]
    weight: float  # of the phones in statistics of durations


def label(
    examples: Sequence[Example],
    untranscribed: Sequence[Path],
    kinds: Mapping[str, float],
    fraction: float,
    *,
    aligner: AcousticModel,
    encoder: WholeEncoder,
    errors: RowErrors,
) -> tuple[list[Alignment], list[LabeledRecording]]:
    """Align and label recordings; those with text come first, in random order.

    ``examples`` have text and samples, in the language of ``aligner``. ``untranscribed`` are
    folders of recordings without text. ``kinds`` is the fraction of each kind of speech with text
    in training, and ``fraction`` that of the recordings without text. ``encoder`` is Whisper's, for
    the teacher. Returns the alignments of the recordings with text, and all recordings.
    """
    rng = np.random.default_rng(SEED)
    folders = [load_untranscribed(folder, errors) for folder in untranscribed]
    in_random_order = [examples[index] for index in rng.permutation(len(examples))]
    aligned, alignments = _align_examples(aligner, in_random_order)
    recordings = _recordings(aligned, alignments, kinds)
    num_of_kind: Counter[str] = Counter()
    teacher_set = []
    for example, recording in zip(aligned, recordings, strict=True):
        num_of_kind[example.speech_kind] += 1
        if num_of_kind[example.speech_kind] <= _TEACHER_SET:
            teacher_set.append(recording)
    teacher = train_teacher(encoder, teacher_set, STATES_PER_PHONE * len(aligner.inventory))
    sounds = [recording.samples for recording in recordings]
    sounds += [sound for pieces in folders for sound in pieces]
    labels = iter(teacher.label(sounds))
    labeled = [
        replace(recording, targets=recording.targets.average_with(targets))
        for recording, targets in zip(recordings, labels, strict=False)
    ]
    pairs_by_folder = [list(zip(pieces, labels, strict=False)) for pieces in folders]
    sizes = [sum(len(targets) for _, targets in pairs) for pairs in pairs_by_folder]
    counted = [min(size, _FULL_FOLDER_MINUTES * FRAMES_PER_MINUTE) for size in sizes]
    for pairs, size, count in zip(pairs_by_folder, sizes, counted, strict=True):
        for sound, targets in pairs:
            weight = fraction * count / sum(counted) * len(targets) / size
            labeled.append(LabeledRecording(samples=sound, targets=targets, weight=weight))
    width = max(recording.targets.states.shape[1] for recording in labeled)
    return alignments, [
        replace(recording, targets=recording.targets.pad_states(width)) for recording in labeled
    ]


def _recordings(
    examples: Sequence[Example], alignments: Sequence[Alignment], kinds: Mapping[str, float]
) -> list[LabeledRecording]:
    """Weight recordings: a kind of speech has a fixed total weight; rare speakers weigh more."""
    pairs = list(zip(examples, alignments, strict=True))
    frames = dict.fromkeys(kinds, 0.0)
    for example, alignment in pairs:
        frames[example.speech_kind] += example.weight * len(alignment.states)
    return [
        LabeledRecording(
            samples=example.samples,
            targets=FrameTargets.hard(alignment.states),
            weight=kinds[example.speech_kind]
            * example.weight
            * len(alignment.states)
            / frames[example.speech_kind],
        )
        for example, alignment in pairs
    ]


def _align_examples(
    aligner: AcousticModel, examples: Sequence[Example]
) -> tuple[list[Example], list[Alignment]]:
    """Align each recording with its text; drop recordings that do not fit.

    Raises ``UserError`` if no recording fits its text.
    """
    topology = aligner.topology
    inventory = topology.inventory
    silence = inventory.index[inventory.silence]
    num_states = np.diff(topology.first_state)
    phone = np.repeat(np.arange(len(inventory)), num_states)
    place = np.arange(len(phone)) - topology.first_state[phone]
    # the middle of a phone's n-th state, among STATES_PER_PHONE
    new_place = (2 * place + 1) * STATES_PER_PHONE // (2 * num_states[phone])
    if isinstance(aligner, BlockModel):
        aligner = replace(aligner, acoustic_scale=1.0)

    def align(number: int) -> Alignment | None:
        example = examples[number]
        graph = build_utterance_graph(
            example.phones, example.syllables, topology.first_state, silence=silence
        )
        front_end = aligner.create_front_end()
        rows = score_segment(aligner, front_end.accept_waveform(as_floats(example.samples)))
        path, _ = viterbi_path(rows, graph.states, graph, topology.log_stay, topology.log_leave)
        on_path = graph.states[path]
        states = phone[on_path] * STATES_PER_PHONE + new_place[on_path]
        if not len(path):
            return None
        phones = segments_of_path(path, graph)
        return Alignment(states=states, phones=phones, weight=example.weight)

    found = process_in_order(align, range(len(examples)))
    aligned, alignments = [], []
    for example, alignment in zip(track(examples, "aligned recordings"), found, strict=True):
        if alignment:
            aligned.append(example)
            alignments.append(alignment)
    if not aligned:
        raise UserError("no recording fits its text; check the texts and the aligner")
    return aligned, alignments


def alignment_statistics(
    alignments: Sequence[Alignment], weights: Sequence[float], phone_lm: PhoneLanguageModel
) -> tuple[Topology, Floats]:
    """Count transitions and durations, and the states' log priors, (states,).

    ``weights`` are the relative sampling weights of the recordings in training.
    """
    num_states = STATES_PER_PHONE * len(phone_lm.inventory)
    counts = np.ones(num_states)
    occupied, left = np.full(num_states, 2.0), np.ones(num_states)
    durations = PhoneDurations(phone_lm.inventory)
    for alignment, weight in zip(alignments, weights, strict=True):
        in_states = np.bincount(alignment.states, minlength=num_states)
        counts += weight * len(alignments) / len(alignment.states) * in_states
        occupied += in_states
        ends = np.append(np.flatnonzero(np.diff(alignment.states)), len(alignment.states) - 1)
        np.add.at(left, alignment.states[ends], 1.0)
        durations.add(alignment.phones, alignment.weight)
    stay = np.clip(1 - left / occupied, _MIN_STAY, _MAX_STAY)
    mean_s, spread_s = durations.mean_and_spread_s()
    topology = Topology(
        phone_lm=phone_lm,
        first_state=np.arange(len(phone_lm.inventory) + 1) * STATES_PER_PHONE,
        log_stay=np.log(stay).astype(np.float32),
        log_leave=np.log(1 - stay).astype(np.float32),
        lm_scale=_LM_SCALE,
        duration_mean_s=mean_s,
        duration_spread_s=spread_s,
    )
    return topology, (_PRIOR_SCALE * np.log(counts / counts.sum())).astype(np.float32)
