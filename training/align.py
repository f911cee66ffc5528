"""Forced alignment: when each unit of a known text is said.

The best path of the recognizer's own model through the text's units, with optional pauses at
syllable boundaries (Li et al. 2011, section 3.2, scheme 1, did this with HTK).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from services.recognizer.acoustic_model import AcousticModel
from services.recognizer.pipeline import frame_time_s
from services.recognizer.resample import to_16_khz
from shared.errors import UserError
from shared.phones import SILENCE, UNIT_INDEX, UNITS, Phone
from shared.pinyin import pinyin_of_text, units_of_syllable
from training.gmm import units_of_path, utterance_graph, viterbi_path


def align_text(
    model: AcousticModel, samples: NDArray[np.float32], sample_rate_hz: int, text: str
) -> list[Phone]:
    """Find when each unit of a text is said.

    Parameters
    ----------
    model
        The acoustic model.
    samples
        Shape (n,) or (n, channels), in [-1, 1].
    sample_rate_hz
        Their rate, 8000 to 48000.
    text
        Chinese characters, or pinyin syllables separated by spaces.

    Returns
    -------
    list of Phone
        All units and the pauses (``sil``) in order, from the beginning to the end.

    Raises
    ------
    UserError
        If the text is empty or cannot be read, or the recording is too short for it.
    """
    is_pinyin = text.isascii() or any(letter in text for letter in "üāáǎàēéěèīíǐìōóǒòūúǔùǖǘǚǜ")
    syllables = text.split() if is_pinyin else pinyin_of_text(text)
    if not syllables:
        raise UserError("the text is empty; give what is said in Chinese characters or pinyin")
    return align_units(
        model, samples, sample_rate_hz, [units_of_syllable(syllable) for syllable in syllables]
    )


def align_units(
    model: AcousticModel,
    samples: NDArray[np.float32],
    sample_rate_hz: int,
    syllables: list[tuple[str, ...]],
) -> list[Phone]:
    """Like :func:`align_text`, for units already known, one tuple per syllable."""
    stream = model.stream()
    frames = model.front_end().accept_waveform(to_16_khz(samples, sample_rate_hz))
    scores = np.concatenate([stream.accept(frames), stream.finish()])
    topology = model.topology
    graph = utterance_graph(
        [UNIT_INDEX[unit] for syllable in syllables for unit in syllable],
        [len(syllable) for syllable in syllables],
        topology.first_state,
    )
    path = np.empty(0, dtype=np.int64)
    if len(scores):
        on_graph = scores[:, graph.states]
        path, _ = viterbi_path(on_graph, graph, topology.log_stay, topology.log_leave)
    if len(path) == 0:
        num_units = sum(len(syllable) for syllable in syllables)
        raise UserError(
            f"{len(frames) * 0.01:.2f} s of sound are too short for {num_units} units; "
            "check that text and recording belong together"
        )
    best_of_units = np.maximum.reduceat(scores, topology.first_state[:-1], axis=1)
    phones: list[Phone] = []
    for aligned in units_of_path(path, graph):
        onset_s = frame_time_s(aligned.start)
        # share of the unit among all units, had one of them been said in these frames
        evidence = best_of_units[aligned.start : aligned.end].sum(axis=0, dtype=np.float64)
        share = np.exp(evidence - evidence.max())
        phones.append(
            Phone(
                index=len(phones),
                unit=UNITS[aligned.unit],
                onset_s=onset_s,
                duration_s=frame_time_s(aligned.end) - onset_s,
                confidence=float(share[aligned.unit] / share.sum()),
                final=True,
            )
        )
    return phones


def spoken(phones: list[Phone]) -> list[Phone]:
    """Units without the pauses."""
    return [phone for phone in phones if phone.unit != SILENCE]
