"""Chooses the search weights on development data: acoustic scale and phone penalty."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from kouxing.corpora.scoring import ErrorCounts, count_errors
from kouxing.corpora.speech_corpus import RowErrors
from kouxing.services.recognizer.acoustic.acoustic_model import Topology, score_segment
from kouxing.services.recognizer.acoustic.gmm import GmmModel
from kouxing.services.recognizer.search.decoder import Decoder
from kouxing.shared.arrays import Floats
from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.training.training_set import Example, load_examples

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


def choose_search_weights(
    model: GmmModel, corpora: Sequence[Path], *, any_license: bool
) -> SearchWeights | None:
    """Choose the weights with the lowest error rate on the split ``dev``; None if it is empty.

    ``model`` has an acoustic scale of 1.
    """
    try:
        dev = load_examples(
            corpora, RowErrors(), model.inventory, split="dev", any_license=any_license
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
    topology: Topology, scores: Sequence[Floats], examples: Sequence[Example]
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
