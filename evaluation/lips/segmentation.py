"""How well energy and zero crossings find syllables, against forced alignment.

Source: Zhang et al. 2021, section 2.2. The boundaries are the beginnings of syllables. Those of the
pieces are paired with those of the alignment, one to one and in order, such that the most pairs
with the least errors result; a pair is at most 0.1 s apart. The same is measured without the zero
crossings, and in noise. With the text known, every syllable has a beginning (``time_text``), beside
one that cuts the speech by the syllables' usual lengths alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.figures import new_figure
from kouxing.corpora.speech_corpus import RowErrors, Utterance, read_corpus, syllables_of
from kouxing.evaluation.recognizer.disturbances import SPEECH_CONDITIONS
from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.services.recognizer.alignment import align_phones, spoken
from kouxing.services.recognizer.front_end.pcm import progress_of
from kouxing.services.synthesizer.lips.ferguson.endpoints import Piece, pieces_of
from kouxing.services.synthesizer.lips.ferguson.table import PhoneTable, load_table
from kouxing.services.synthesizer.lips.ferguson.timing import time_text
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.phones.events import Phone, Progress
from kouxing.shared.phones.inventory import Syllable

Array = NDArray[np.float64]

PAIRING_S = 0.1
TOLERANCE_S = 0.05
_NOISES = ("noise 20 dB below", "noise 10 dB below", "noise 5 dB below")


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentedRecording:
    """A recording, its pieces, and where its syllables are."""

    name: str
    samples: NDArray[np.float32]  # 16 kHz mono
    slices: list[Progress]
    pieces: list[Piece]
    syllables: list[Syllable]
    aligned: list[Phone]  # without silence

    @property
    def onsets_s(self) -> Array:
        """When each syllable begins by the alignment, (num_syllables,)."""
        return _syllable_onsets(self.aligned, self.syllables)


@dataclass(frozen=True, slots=True, kw_only=True)
class PieceScore:
    """Pieces against the syllables; times in milliseconds."""

    num_pieces: int
    mean_count_error: float  # of a recording, relative to its syllables
    recall: float  # of boundaries, within 50 ms
    precision: float
    mean_boundary_error_ms: float  # of the pairs
    p95_boundary_error_ms: float


@dataclass(frozen=True, slots=True, kw_only=True)
class SegmentationScore:
    """Figures over recordings."""

    num_recordings: int
    num_syllables: int
    pieces: dict[str, PieceScore]  # by the condition
    by_text: OnsetScore
    by_lengths: OnsetScore


@dataclass(frozen=True, slots=True, kw_only=True)
class OnsetScore:
    """Errors of the beginnings of all syllables, and of all vowels."""

    mean_ms: float
    median_ms: float
    p95_ms: float
    within_50_ms: float  # share
    vowel_mean_ms: float


def _without_crossings(one: SegmentedRecording) -> list[Progress]:
    return [replace(each, zero_crossing_rate=0.0) for each in one.slices]


def _in_noise(name: str) -> Callable[[SegmentedRecording], list[Progress]]:
    return lambda one: progress_of(SPEECH_CONDITIONS[name](one.samples))


CONDITIONS: dict[str, Callable[[SegmentedRecording], list[Progress]]] = {
    "as recorded": lambda one: one.slices,
    "without zero crossings": _without_crossings,
    **{name: _in_noise(name) for name in _NOISES},
}


def score_segmentation(
    manifest: Path, split: str, audio: Path | None
) -> tuple[SegmentationScore, list[SegmentedRecording]]:
    """Cut and align the recordings of a split.

    Raises
    ------
    UserError
        If none can be used.
    """
    model, errors = load_model(), RowErrors()
    rows = read_corpus(manifest, errors, model.inventory, split=split, audio=audio)
    recordings = [one for row in rows if (one := _segment(model, row, errors)) is not None]
    if not recordings:
        raise errors.nothing_left(f"of split {split!r} in {manifest}")
    return score(recordings, load_table(model.inventory)), recordings


def score(recordings: Sequence[SegmentedRecording], table: PhoneTable) -> SegmentationScore:
    """Compare pieces, and the timing of the text, with the alignment."""
    return SegmentationScore(
        num_recordings=len(recordings),
        num_syllables=sum(len(one.syllables) for one in recordings),
        pieces={
            name: _piece_score([(one.onsets_s, pieces_of(slices(one))) for one in recordings])
            for name, slices in CONDITIONS.items()
        },
        by_text=_onset_score(
            [(one, time_text(one.slices, one.syllables, table)) for one in spoken_in(recordings)]
        ),
        by_lengths=_onset_score([(one, _by_lengths(one, table)) for one in spoken_in(recordings)]),
    )


def _piece_score(found: Sequence[tuple[Array, Sequence[Piece]]]) -> PieceScore:
    """Compare the pieces of recordings with when their syllables begin."""
    errors_s: list[float] = []
    for onsets_s, pieces in found:
        starts_s = np.array([piece.start_s for piece in pieces])
        errors_s += [abs(starts_s[b] - onsets_s[a]) for a, b in pair(onsets_s, starts_s)]
    num_near = sum(error_s <= TOLERANCE_S for error_s in errors_s)
    num_pieces = sum(len(pieces) for _, pieces in found)
    return PieceScore(
        num_pieces=num_pieces,
        mean_count_error=float(
            np.mean(
                [abs(len(pieces) - len(onsets_s)) / len(onsets_s) for onsets_s, pieces in found]
            )
        ),
        recall=num_near / sum(len(onsets_s) for onsets_s, _ in found),
        precision=num_near / max(num_pieces, 1),
        mean_boundary_error_ms=1e3 * float(np.mean(errors_s or [0.0])),
        p95_boundary_error_ms=1e3 * float(np.percentile(errors_s or [0.0], 95)),
    )


def spoken_in(recordings: Sequence[SegmentedRecording]) -> list[SegmentedRecording]:
    """Leave out recordings in which no speech was found."""
    return [one for one in recordings if one.pieces]


def pair(real_s: Array, found_s: Array) -> list[tuple[int, int]]:
    """Pair two rising series of times, one to one and in order.

    Returns
    -------
    list of (int, int)
        Indices into both. Leaving a time alone costs half of ``PAIRING_S``, a pair its distance.
    """
    alone = 0.5 * PAIRING_S
    cost = alone * np.add.outer(np.arange(len(real_s) + 1), np.arange(len(found_s) + 1))
    is_pair = np.zeros(cost.shape, dtype=bool)
    for row, real in enumerate(real_s, start=1):
        for column, found in enumerate(found_s, start=1):
            paired = cost[row - 1, column - 1] + abs(real - found)
            left = alone + min(cost[row - 1, column], cost[row, column - 1])
            is_pair[row, column] = paired < left
            cost[row, column] = min(paired, left)
    pairs = []
    row, column = len(real_s), len(found_s)
    while row and column:
        if is_pair[row, column]:
            row, column = row - 1, column - 1
            pairs.append((row, column))
        elif cost[row - 1, column] < cost[row, column - 1]:
            row -= 1
        else:
            column -= 1
    return pairs[::-1]


def print_score(score: SegmentationScore, console: Console) -> None:
    """Print the figures as tables."""
    table = Table(
        title=f"Pieces against {score.num_syllables} syllables of {score.num_recordings} recordings"
    )
    table.add_column("condition")
    for head in ("pieces", "count error", "recall", "precision", "error", "p95"):
        table.add_column(head, justify="right")
    for name, found in score.pieces.items():
        table.add_row(
            name,
            str(found.num_pieces),
            f"{100 * found.mean_count_error:.0f} %",
            f"{100 * found.recall:.0f} %",
            f"{100 * found.precision:.0f} %",
            f"{found.mean_boundary_error_ms:.0f} ms",
            f"{found.p95_boundary_error_ms:.0f} ms",
        )
    console.print(table)
    table = Table(title="Beginnings of syllables, the text known")
    for head in ("by", "error", "median", "p95", "within 50 ms", "error of vowels"):
        table.add_column(head, justify="right")
    for name, one in (("pieces", score.by_text), ("usual lengths alone", score.by_lengths)):
        table.add_row(
            name,
            f"{one.mean_ms:.0f} ms",
            f"{one.median_ms:.0f} ms",
            f"{one.p95_ms:.0f} ms",
            f"{100 * one.within_50_ms:.0f} %",
            f"{one.vowel_mean_ms:.0f} ms",
        )
    console.print(table)


def figure(recording: SegmentedRecording) -> Any:
    """Draw the pieces over the waveform, with the alignment, level and zero crossings."""
    drawn = new_figure(11.0, 5.0)
    wave, level = drawn.subplots(2, 1, sharex=True)
    time_s = np.arange(len(recording.samples)) / MEDIA_RATE_HZ
    wave.plot(time_s, recording.samples, color="0.6", linewidth=0.4)
    for number, piece in enumerate(recording.pieces):
        wave.axvspan(
            piece.start_s, piece.end_s, color=("tab:blue", "tab:cyan")[number % 2], alpha=0.3
        )
    for syllable, onset_s in zip(recording.syllables, recording.onsets_s, strict=True):
        wave.axvline(onset_s, color="black", linewidth=0.8)
        wave.text(
            onset_s, 0.97, " " + "".join(syllable), transform=wave.get_xaxis_transform(), va="top"
        )
    wave.set_title(f"{recording.name}: pieces (coloured), syllables by forced alignment (lines)")
    slices_s = [one.time_s - 0.01 for one in recording.slices]
    level.plot(slices_s, [one.level_db for one in recording.slices], color="tab:red")
    level.set_ylabel("level, dB")
    level.set_xlabel("s")
    crossings = level.twinx()
    crossings.plot(
        slices_s, [one.zero_crossing_rate for one in recording.slices], color="tab:green"
    )
    crossings.set_ylabel("zero crossings a sample")
    crossings.set_ylim(0.0, 1.0)
    return drawn


def _segment(model: AcousticModel, row: Utterance, errors: RowErrors) -> SegmentedRecording | None:
    syllables = syllables_of(row, model.inventory)
    try:
        samples = read_audio(row.path)
        aligned = align_phones(model, samples, MEDIA_RATE_HZ, syllables)
    except (UserError, ValueError) as error:
        errors.add(row.utterance_id, str(error))
        return None
    slices = progress_of(samples)
    return SegmentedRecording(
        name=row.utterance_id,
        samples=samples,
        slices=slices,
        pieces=pieces_of(slices),
        syllables=syllables,
        aligned=spoken(aligned, model.inventory),
    )


def _by_lengths(one: SegmentedRecording, table: PhoneTable) -> list[Phone]:
    """Time the text by usual lengths alone, from the first piece to the last."""
    start_s, end_s = one.pieces[0].start_s, one.pieces[-1].end_s
    usual_s = np.array([table.duration_s[phone.symbol] for phone in one.aligned])
    edges_s = (
        start_s + (end_s - start_s) * np.concatenate([[0.0], np.cumsum(usual_s)]) / usual_s.sum()
    )
    return [
        Phone(
            index=index,
            symbol=phone.symbol,
            onset_s=float(edges_s[index]),
            duration_s=float(edges_s[index + 1] - edges_s[index]),
            confidence=1.0,
            final=True,
        )
        for index, phone in enumerate(one.aligned)
    ]


def _onset_score(timed: Sequence[tuple[SegmentedRecording, list[Phone]]]) -> OnsetScore:
    if not timed:
        raise UserError("no speech was found in any recording; give others")
    syllables_s = np.abs(
        np.concatenate(
            [_syllable_onsets(phones, one.syllables) - one.onsets_s for one, phones in timed]
        )
    )
    vowels_s = [
        abs(phone.onset_s - real.onset_s)
        for one, phones in timed
        for place, (phone, real) in enumerate(zip(phones, one.aligned, strict=True))
        if place and place not in _first_phones(one.syllables)
    ]
    return OnsetScore(
        mean_ms=1e3 * float(syllables_s.mean()),
        median_ms=1e3 * float(np.median(syllables_s)),
        p95_ms=1e3 * float(np.percentile(syllables_s, 95)),
        within_50_ms=float((syllables_s <= TOLERANCE_S).mean()),
        vowel_mean_ms=1e3 * float(np.mean(vowels_s or [0.0])),
    )


def _syllable_onsets(phones: Sequence[Phone], syllables: Sequence[Syllable]) -> Array:
    return np.array([phones[first].onset_s for first in _first_phones(syllables)])


def _first_phones(syllables: Sequence[Syllable]) -> list[int]:
    return [0, *np.cumsum([len(syllable) for syllable in syllables]).tolist()][:-1]
