"""Forced alignment: the times of the phones of a known text.

The best path of the recognizer's own model through the text's phones, with optional pauses at
syllable boundaries (Li et al. 2011, section 3.2, scheme 1, used HTK for this).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic.acoustic_model import AcousticModel
from services.recognizer.front_end.features import HOP_S
from services.recognizer.front_end.resample import to_16_khz
from services.recognizer.search.forced_path import segments_of_path, utterance_graph, viterbi_path
from services.recognizer.speech_scores import frame_time_s
from shared.errors import UserError
from shared.phones.events import Phone
from shared.phones.inventory import PhoneInventory, Syllable


def align_text(
    model: AcousticModel, samples: NDArray[np.float32], sample_rate_hz: int, text: str
) -> list[Phone]:
    """Find the onset and duration of each phone of a text.

    Parameters
    ----------
    model
        The acoustic model.
    samples
        Shape (n,) or (n, channels), in [-1, 1].
    sample_rate_hz
        Their rate, 8000 to 48000.
    text
        What is spoken, in a spelling that the model's language reads.

    Returns
    -------
    list of Phone
        All phones and the pauses (silence) in order, from the beginning to the end.

    Raises
    ------
    UserError
        If the text is empty or cannot be read, or the recording is too short for it.
    """
    syllables = model.inventory.pronounce(text)
    if not syllables:
        raise UserError("the text is empty; give the words that are spoken")
    return align_phones(model, samples, sample_rate_hz, syllables)


def align_phones(
    model: AcousticModel,
    samples: NDArray[np.float32],
    sample_rate_hz: int,
    syllables: Sequence[Syllable],
) -> list[Phone]:
    """Like :func:`align_text`, for the phones of known syllables."""
    inventory, topology = model.inventory, model.topology
    stream = model.stream()
    frames = model.front_end().accept_waveform(to_16_khz(samples, sample_rate_hz))
    scores = np.concatenate([stream.accept(frames), stream.finish()])
    graph = utterance_graph(
        [inventory.index[symbol] for syllable in syllables for symbol in syllable],
        [len(syllable) for syllable in syllables],
        topology.first_state,
        silence=inventory.index[inventory.silence],
    )
    path = np.empty(0, dtype=np.int64)
    if len(scores):
        on_graph = scores[:, graph.states]
        path, _ = viterbi_path(on_graph, graph, topology.log_stay, topology.log_leave)
    if len(path) == 0:
        raise UserError(
            f"{len(frames) * HOP_S:.2f} s of sound are too short for "
            f"{sum(map(len, syllables))} phones; check that text and recording belong together"
        )
    best_of_phones = np.maximum.reduceat(scores, topology.first_state[:-1], axis=1)
    phones: list[Phone] = []
    for segment in segments_of_path(path, graph):
        onset_s = frame_time_s(segment.start)
        # posterior of the phone, had any one phone filled these frames
        evidence = best_of_phones[segment.start : segment.end].sum(axis=0, dtype=np.float64)
        likelihood = np.exp(evidence - evidence.max())
        phones.append(
            Phone(
                index=len(phones),
                symbol=inventory.phones[segment.phone],
                onset_s=onset_s,
                duration_s=frame_time_s(segment.end) - onset_s,
                confidence=float(likelihood[segment.phone] / likelihood.sum()),
                final=True,
            )
        )
    return phones


def spoken(phones: Sequence[Phone], inventory: PhoneInventory) -> list[Phone]:
    """Return the phones without the pauses."""
    return [phone for phone in phones if phone.symbol != inventory.silence]
