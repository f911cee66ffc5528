"""From corpora to a model file with its card: the Gaussian mixture recognizer."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.scoring import ErrorCounts, count_errors
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import Topology, score_segment
from kouxing.services.recognizer.acoustic.gmm import GmmModel
from kouxing.services.recognizer.front_end.features import (
    NUM_FEATURES,
    LogMel,
    compute_cepstra_batch,
)
from kouxing.services.recognizer.search.decoder import Decoder
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.training.gmm.estimation import (
    FrameSet,
    HmmParameters,
    RecordingCopy,
    decorrelate,
    estimate,
    first_estimate,
    split,
    topology_of,
)
from kouxing.training.model_card import write_card
from kouxing.training.model_files import save_gmm
from kouxing.training.networks.augmentation import augment_samples, scale_level
from kouxing.training.phone_lm.recipe import load_phone_lm, phone_lm_of
from kouxing.training.seed import SEED
from kouxing.training.training_set import Example, load_examples

_STATES_PER_PHONE = 5  # Li et al. 2011, section 3.1
_HALF_WIDTH = 2  # half width of the differences, frames
_FLAT_START_STEP = 4  # the flat start uses every fourth copy
_FLAT_START_ITERATIONS = 4
_DECORRELATED_AT = 8  # mixtures per state when the features are decorrelated
_MIN_SENTENCE_SYLLABLES = 4  # a natural recording with fewer syllables is a word
_SENTENCE_COPIES = 3
_WORD_WEIGHT = 0.3
_MIN_COPY_WEIGHT = 0.5  # recordings with a lower weight are sampled instead
_MEAN_RECORDINGS = 500  # for the mean of the cepstra
_SCALES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)
_PHONE_PENALTIES = (2.0, 1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -2.0)


@dataclass(frozen=True, slots=True)
class SearchWeights:
    """Weights of the search."""

    acoustic_scale: float  # factor of the log scores
    phone_penalty: float  # added to the log score of a path for each phone
    error_rate: float = 1.0  # on the development data

    def __str__(self) -> str:
        return (
            f"acoustic scale {self.acoustic_scale}, phone penalty {self.phone_penalty}; phone error"
            f" rate {100 * self.error_rate:.1f} %"
        )

    def apply_to(self, model: GmmModel) -> GmmModel:
        """Return the model with these weights."""
        topology = replace(model.topology, phone_penalty=self.phone_penalty)
        return replace(model, topology=topology, acoustic_scale=self.acoustic_scale)


_UNTUNED = SearchWeights(acoustic_scale=0.2, phone_penalty=-1.0)


def train_gmm(
    corpora: Sequence[Path],
    output: Path,
    inventory: PhoneInventory,
    *,
    any_license: bool,
    phone_lm: Path | None = None,
    num_mixtures: int = 32,
) -> None:
    """Train the Gaussian mixture recognizer, and write the model with its card.

    ``num_mixtures`` of each state is a power of two. Raises ``UserError`` if there is nothing to
    train on.
    """
    errors = RowErrors()
    examples = load_examples(corpora, errors, inventory, any_license=any_license)
    lm = load_phone_lm(phone_lm, inventory) if phone_lm else phone_lm_of(examples, inventory)
    rng = np.random.default_rng(SEED)
    copies = [copy for example in examples for copy in _copies(example, rng)]
    print_message(f"{len(examples)} recordings, {len(copies)} copies with augmentation")
    first_state = np.arange(len(inventory) + 1) * _STATES_PER_PHONE
    prior_mean = _mean_cepstra(examples)

    flat_start = FrameSet.build(
        copies[::_FLAT_START_STEP], inventory, first_state, prior_mean, _HALF_WIDTH
    )
    hmm = first_estimate(flat_start, first_state)
    for _ in range(_FLAT_START_ITERATIONS):
        print_message(f"flat start: log likelihood {flat_start.realign(hmm):.3f} per frame")
        hmm = estimate(flat_start, hmm)
    frames = FrameSet.build(copies, inventory, first_state, prior_mean, _HALF_WIDTH)
    hmm, rotation = _train_mixtures(frames, hmm, num_mixtures)
    model = GmmModel(
        topology=topology_of(hmm, lm, frames),
        mixtures=hmm.mixtures,
        rotation=rotation,
        prior_mean=prior_mean,
        half_width=_HALF_WIDTH,
    )

    chosen = choose_search_weights(model, corpora, any_license=any_license)
    save_gmm(output, (chosen or _UNTUNED).apply_to(model))
    write_card(
        output,
        title=f"Gaussian mixture recognizer, {num_mixtures} mixtures in each of "
        f"{len(inventory)} x {_STATES_PER_PHONE} states",
        details=f"seed {SEED}",
        recordings=examples,
        errors=errors,
        notes=f"Chosen on dev: {chosen}" if chosen else "",
    )
    errors.report_to(print_message)


def _train_mixtures(
    frames: FrameSet, hmm: HmmParameters, num_mixtures: int
) -> tuple[HmmParameters, NDArray[np.float32]]:
    """Double the mixtures step by step; return the model and the rotation of the features."""
    rotation = np.eye(NUM_FEATURES, dtype=np.float32)
    print_message(f"1 mixture: log likelihood {frames.realign(hmm):.3f} per frame")
    hmm = estimate(frames, hmm, 3)
    size = 1
    while size < num_mixtures:
        size *= 2
        hmm = estimate(frames, split(hmm, frames, size), 5)
        if size == min(_DECORRELATED_AT, num_mixtures):
            hmm, rotation = decorrelate(frames, hmm)
            hmm = estimate(frames, hmm, 3)
            print_message(f"{size} mixtures: log likelihood {frames.realign(hmm):.3f} per frame")
            hmm = estimate(frames, hmm, 3)
    return hmm, rotation


def _copies(example: Example, rng: np.random.Generator) -> list[RecordingCopy]:
    """Make the copies of a recording: three of a natural sentence, one of anything else.

    Half of the first copies are augmented, and all others. Isolated words have a lower weight.
    Low-weight recordings are sampled less often.
    """
    num_copies, weight = 1, example.weight
    if example.speech_kind != "synthetic":
        if len(example.syllables) >= _MIN_SENTENCE_SYLLABLES:
            num_copies = _SENTENCE_COPIES
        else:
            weight *= _WORD_WEIGHT
    if weight < _MIN_COPY_WEIGHT:
        num_copies = int(rng.random() < weight / _MIN_COPY_WEIGHT)
        weight = _MIN_COPY_WEIGHT
    copies = []
    for number in range(num_copies):
        is_augmented = number > 0 or rng.random() < 0.5
        log_mel = _augmented_log_mel(example.samples, rng) if is_augmented else example.log_mel
        copies.append(RecordingCopy(example, weight, log_mel))
    return copies


def _augmented_log_mel(samples: NDArray[np.int16], rng: np.random.Generator) -> NDArray[np.float16]:
    """Compute the features of augmented samples, (frames, 41)."""
    sound, _ = augment_samples(as_floats(samples), rng)
    return LogMel().accept_waveform(scale_level(sound, rng)).astype(np.float16)


def _mean_cepstra(examples: Sequence[Example]) -> NDArray[np.float32]:
    """Compute the mean cepstra of the recordings, shape (13,)."""
    step = max(1, len(examples) // _MEAN_RECORDINGS)
    means = [
        compute_cepstra_batch(example.log_mel.astype(np.float32)).mean(axis=0)
        for example in examples[::step]
    ]
    return np.asarray(np.mean(means, axis=0, dtype=np.float32))


def choose_search_weights(
    model: GmmModel, corpora: Sequence[Path], *, any_license: bool
) -> SearchWeights | None:
    """Choose the weights with the lowest error rate on the split ``dev``; None if it is empty.

    ``model`` has an acoustic scale of 1.
    """
    try:
        dev = load_examples(
            corpora,
            RowErrors(),
            model.inventory,
            split="dev",
            any_license=any_license,
        )
    except UserError:
        print_message("no dev recordings; acoustic scale and phone penalty keep their defaults")
        return None
    # the pitch is unknown, so no band is warped
    features = (np.pad(example.log_mel.astype(np.float32), ((0, 0), (0, 2))) for example in dev)
    scores = [score_segment(model, frames) for frames in features]
    best: SearchWeights | None = None
    for scale in _SCALES:
        scaled = [np.float32(scale) * rows for rows in scores]
        for phone_penalty in _PHONE_PENALTIES:
            topology = replace(model.topology, phone_penalty=phone_penalty)
            error_rate = _offline_error_rate(topology, scaled, dev)
            if best is None or error_rate < best.error_rate:
                best = SearchWeights(scale, phone_penalty, error_rate)
                print_message(str(best))
    return best


def _offline_error_rate(
    topology: Topology, scores: Sequence[NDArray[np.float32]], examples: Sequence[Example]
) -> float:
    """Compute the phone error rate of offline decoding from scores, (frames, states) each."""
    decoder = Decoder(topology)
    inventory = topology.inventory
    total = ErrorCounts()
    for rows, example in zip(scores, examples, strict=True):
        decoder.reset()
        decoder.advance(rows)
        decoded = [inventory.phones[segment.phone] for segment in decoder.final_path()]
        recognized = [phone for phone in decoded if phone != inventory.silence]
        total += count_errors([inventory.phones[phone] for phone in example.phones], recognized)
    return total.rate
