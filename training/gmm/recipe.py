"""From corpora to a model file with its card: the Gaussian mixture recognizer."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.gmm import GmmModel
from kouxing.services.recognizer.front_end.features import (
    NUM_FEATURES,
    LogMel,
    compute_cepstra_batch,
)
from kouxing.shared.arrays import Float16, Floats, Int16
from kouxing.shared.audio.pcm import as_floats
from kouxing.shared.command.terminal import print_message
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
from kouxing.training.gmm.search_weights import SearchWeights, choose_search_weights
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
_UNTUNED = SearchWeights(acoustic_scale=0.2, phone_penalty=-1.0)
_MEAN_RECORDINGS = 500  # for the mean of the cepstra


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
) -> tuple[HmmParameters, Floats]:
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


def _augmented_log_mel(samples: Int16, rng: np.random.Generator) -> Float16:
    """Compute the features of augmented samples, (frames, 41)."""
    sound, _ = augment_samples(as_floats(samples), rng)
    return LogMel().accept_waveform(scale_level(sound, rng)).astype(np.float16)


def _mean_cepstra(examples: Sequence[Example]) -> Floats:
    """Compute the mean cepstra of the recordings, shape (13,)."""
    step = max(1, len(examples) // _MEAN_RECORDINGS)
    means = [
        compute_cepstra_batch(example.log_mel.astype(np.float32)).mean(axis=0)
        for example in examples[::step]
    ]
    return np.asarray(np.mean(means, axis=0, dtype=np.float32))
