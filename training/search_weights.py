"""Choose the search weights on development data: acoustic scale and phone penalty."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from kouxing.corpora.feature_cache import as_floats
from kouxing.corpora.scoring import ErrorCounts, count_errors
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Topology
from kouxing.services.recognizer.acoustic.blocks import BlockModel
from kouxing.services.recognizer.acoustic.gmm import GmmModel
from kouxing.services.recognizer.front_end.vtln import without_pitch
from kouxing.services.recognizer.search.decoder import Decoder
from kouxing.shared.errors import UserError
from kouxing.training.training_set import Example, Report, load_examples

M = TypeVar("M", GmmModel, BlockModel)

_SCALES = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4)
_PHONE_PENALTIES = (2.0, 1.5, 1.0, 0.5, 0.0, -0.5, -1.0, -2.0)
_BATCH_SIZE = 16  # recordings that are scored together


@dataclass(frozen=True, slots=True)
class SearchWeights:
    """Weights of the search."""

    acoustic_scale: float  # factor of the log scores
    phone_penalty: float  # added to the log score of a path for each phone
    error_rate: float = 1.0  # on the development data

    def applied_to(self, model: M) -> M:
        """Return the model with these weights."""
        topology = replace(model.topology, phone_penalty=self.phone_penalty)
        return replace(model, topology=topology, acoustic_scale=self.acoustic_scale)


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


def choose_search_weights(
    model: AcousticModel,
    corpora: Sequence[Path],
    *,
    scales: Sequence[float] = _SCALES,
    shipping: bool = True,
    with_samples: bool = False,
    report: Report = print,
) -> SearchWeights | None:
    """Choose the weights with the lowest error rate on the split ``dev``; None if it is empty.

    ``model`` has an acoustic scale of 1. ``with_samples`` computes the features with the model's
    front end instead of from cached log-mel features.
    """
    try:
        dev = load_examples(
            corpora,
            RowErrors(),
            model.inventory,
            split="dev",
            shipping=shipping,
            with_samples=with_samples,
        )
    except UserError:
        report("no dev recordings; acoustic scale and phone penalty keep their defaults")
        return None
    scores = list(all_scores(model, dev))
    best: SearchWeights | None = None
    for scale in scales:
        scaled = [np.float32(scale) * rows for rows in scores]
        for phone_penalty in _PHONE_PENALTIES:
            topology = replace(model.topology, phone_penalty=phone_penalty)
            error_rate = _offline_error_rate(topology, scaled, dev)
            if best is None or error_rate < best.error_rate:
                best = SearchWeights(scale, phone_penalty, error_rate)
                report(
                    f"{100 * error_rate:.1f} % errors on dev with acoustic scale {scale} and phone "
                    f"penalty {phone_penalty}"
                )
    return best


def all_scores(model: AcousticModel, examples: Sequence[Example]) -> Iterator[NDArray[np.float32]]:
    """Yield the scores of each recording without augmentation, shape (frames, states).

    The model's front end computes the features from the samples, if an example has samples.
    Otherwise its log-mel features are used.
    """
    for start in range(0, len(examples), _BATCH_SIZE):
        batch = examples[start : start + _BATCH_SIZE]
        streams = [model.create_stream() for _ in batch]
        features = [_features(model, example) for example in batch]
        first = model.score(list(zip(streams, features, strict=True)))
        last = model.score([(stream, None) for stream in streams])
        for pair in zip(first, last, strict=True):
            yield np.concatenate(pair)


def _features(model: AcousticModel, example: Example) -> NDArray[np.float32]:
    if not len(example.samples):
        return without_pitch(example.log_mel.astype(np.float32))
    return model.create_front_end().accept_waveform(as_floats(example.samples))
