"""Forced alignment: the times of the phones of a known text.

The alignment is the acoustic model's best path through the text's phones, with optional pauses at
syllable boundaries. Li et al. 2011, section 3.2, scheme 1, used HTK for this.

Any text has a best path. Its *fit* shows whether the text was spoken: one minus the path's loss,
relative to the loss of an average phone. The loss is the score difference to the best phone of
each frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel, Topology
from kouxing.services.recognizer.front_end.features import (
    HOP_S,
    SAMPLE_RATE_HZ,
    count_frames,
    frame_time_s,
)
from kouxing.services.recognizer.offline.offline_recognition import WithProgress
from kouxing.services.recognizer.search.forced_path import (
    UtteranceGraph,
    build_utterance_graph,
    segments_of_path,
    viterbi_path,
)
from kouxing.shared.arrays import Floats, Integers
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.inventory import PhoneInventory, Syllable
from kouxing.shared.phones.transcript import TimedSyllable, Transcript

# Calibrated with the block model on dev sentences and conversation; see docs/recognition.md.
MIN_FIT = 0.85
_FIT_FRAMES = 10_000  # frames compared at once, to limit memory


@dataclass(frozen=True, slots=True)
class Alignment:
    """The phones of a text, aligned with a recording."""

    phones: list[Phone]  # all phones and pauses in order, from start to end
    fit: float  # 1: every phone is the best one; 0: an average phone fits equally well

    @property
    def fits(self) -> bool:
        """Whether the text was probably spoken."""
        return self.fit >= MIN_FIT


def align_text(model: AcousticModel, samples: Floats, text: str) -> list[Phone]:
    """Find the onset and duration of each phone and pause of a text.

    ``samples`` are 16 kHz mono, (n,). The text is in a spelling that the model's language can read.

    Raises ``UserError`` if the text is empty or unreadable, or the recording is too short for the
    text.
    """
    syllables = model.inventory.pronounce(text)
    if not syllables:
        raise UserError("the text is empty; enter the spoken words")
    return align_syllables(model, samples, syllables).phones


def align_syllables(
    model: AcousticModel,
    samples: Floats,
    syllables: Sequence[Syllable],
    with_progress: WithProgress = iter,
) -> Alignment:
    """Align known syllables like :func:`align_text`, and compute the fit.

    ``with_progress`` wraps the loop to show progress.
    """
    inventory, topology = model.inventory, model.topology
    silence = inventory.index[inventory.silence]
    graph = build_utterance_graph(
        [inventory.index[symbol] for syllable in syllables for symbol in syllable],
        [len(syllable) for syllable in syllables],
        topology.first_state,
        silence=silence,
    )
    num_frames = count_frames(len(samples))
    if num_frames < graph.num_needed[0]:
        raise UserError(
            f"{num_frames * HOP_S:.2f} s of audio is too short for the phones of the text,"
            f" {sum(map(len, syllables))}; check that the text matches the recording"
        )
    scores = _score_recording(model, samples, num_frames, with_progress)
    path, _ = viterbi_path(scores, graph.states, graph, topology.log_stay, topology.log_leave)
    phones: list[Phone] = []
    for segment in segments_of_path(path, graph):
        onset_s = frame_time_s(segment.start)
        # posterior of the phone, if one phone fills these frames
        best_scores = _best_phone_scores(scores[segment.start : segment.end], topology)
        evidence = best_scores.sum(axis=0, dtype=np.float64)
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
    return Alignment(phones, _fit(graph, path, scores, topology, silence))


def _score_recording(
    model: AcousticModel, samples: Floats, num_frames: int, with_progress: WithProgress
) -> Floats:
    """Score a recording second by second; return the scores of all frames, (frames, states)."""
    front_end, stream = model.create_front_end(), model.create_stream()
    scores = np.empty((num_frames, model.topology.num_states), np.float32)
    num_scored = 0

    def append(rows: Floats) -> None:
        nonlocal num_scored
        scores[num_scored : num_scored + len(rows)] = rows
        num_scored += len(rows)

    for start in with_progress(range(0, len(samples), SAMPLE_RATE_HZ)):
        piece = samples[start : start + SAMPLE_RATE_HZ]
        append(stream.score(front_end.accept_waveform(piece)))
    append(stream.score(None))
    return scores[:num_scored]


def _best_phone_scores(scores: Floats, topology: Topology) -> Floats:
    """Return the score of each phone's best state, (frames, phones)."""
    return np.maximum.reduceat(scores, topology.first_state[:-1], axis=1)


def _fit(
    graph: UtteranceGraph, path: Integers, scores: Floats, topology: Topology, silence: int
) -> float:
    """Compare a path's states with the best phone of each frame.

    Pauses do not count: frames that are silent in the path and in the audio are excluded.
    """
    losses = []
    for first in range(0, len(path), _FIT_FRAMES):
        rows, nodes = scores[first : first + _FIT_FRAMES], path[first : first + _FIT_FRAMES]
        best_scores = _best_phone_scores(rows, topology)
        best = best_scores.max(axis=1)
        lost = best - rows[np.arange(len(nodes)), graph.states[nodes]]
        lost_on_average = best - best_scores.mean(axis=1)
        is_silent = (graph.phones[graph.phone_number[nodes]] == silence) & (
            best_scores.argmax(axis=1) == silence
        )
        losses.append(np.stack([lost, lost_on_average])[:, ~is_silent])
    lost, lost_on_average = np.concatenate(losses, axis=1)
    return 1.0 - float(lost.sum() / lost_on_average.sum()) if len(lost) else 0.0


def drop_pauses(phones: Sequence[Phone], inventory: PhoneInventory) -> list[Phone]:
    """Return the phones without pauses."""
    return [phone for phone in phones if phone.symbol != inventory.silence]


def find_syllable_times(
    phones: Sequence[Phone], transcript: Transcript, inventory: PhoneInventory
) -> list[TimedSyllable]:
    """Return the syllables of a text with the times of its aligned phones."""
    rest = iter(drop_pauses(phones, inventory))
    timed = []
    for syllable in transcript.syllables:
        aligned = list(islice(rest, len(syllable.phones)))
        onset_s, end_s = aligned[0].onset_s, aligned[-1].end_s
        timed.append(TimedSyllable(syllable.text, syllable.spelling, onset_s, end_s - onset_s))
    return timed
