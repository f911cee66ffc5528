"""Reads recordings of speech that name an emotion.

A folder has a ``manifest.tsv`` with the columns ``path``, ``speaker``, ``license``, ``seconds`` and
``note``. The note of such a recording contains ``emotion NAME``, for example *emotion anger*. The
optional column ``phones_path`` names a table with the columns ``start_s`` and ``marks``. The marks
1, 2 and 3 denote stressed vowels.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kouxing.corpora.speech_corpus import may_distribute
from kouxing.corpora.tables import read_rows
from kouxing.shared.errors import UserError

# Arousal and valence, placed by hand on the circumplex of Russell 1980
FEELINGS = {
    "anger": (0.6, -0.5),
    "fear": (0.6, -0.6),
    "happiness": (0.5, 0.8),
    "disgust": (0.3, -0.6),
    "neutral": (0.0, 0.0),
    "sadness": (-0.3, -0.6),
    "boredom": (-0.6, -0.4),
}
_COLUMNS = ("path", "speaker", "license", "seconds", "note")
_EMOTION = re.compile(r"emotion (\w+)")
_STRESS_MARKS = {"1", "2", "3"}


@dataclass(frozen=True, slots=True)
class EmotionRecording:
    """A recording and its emotion, if the manifest names one."""

    path: Path
    speaker: str
    license: str
    minutes: float
    emotion: str | None
    stressed_s: tuple[float, ...] = ()  # starts of stressed vowels, if phone times are given


def read_emotions(folder: Path, *, any_license: bool = True) -> list[EmotionRecording]:
    """Read the list of a folder; raises ``UserError`` if it is missing or names no known emotion.

    Without ``any_license``, recordings whose license does not allow distributing a model are
    skipped.
    """
    manifest = folder / "manifest.tsv"
    recordings = []
    try:
        for row in read_rows(manifest, _COLUMNS):
            if not (any_license or may_distribute(row["license"])):
                continue
            match = _EMOTION.search(row["note"])
            if match and match[1] not in FEELINGS:
                raise UserError(
                    f"{manifest}: the emotion {match[1]!r} is unknown; use {', '.join(FEELINGS)}"
                )
            recording = EmotionRecording(
                folder / row["path"],
                row["speaker"],
                row["license"],
                float(row["seconds"]) / 60,
                match[1] if match else None,
                _stressed(folder / row["phones_path"]) if row.get("phones_path") else (),
            )
            recordings.append(recording)
    except ValueError as error:
        raise UserError(f"{manifest}: {error}; write the seconds as a number") from error
    if not any(recording.emotion for recording in recordings):
        raise UserError(f"{manifest} names no emotion; add notes such as 'emotion anger'")
    return recordings


def _stressed(path: Path) -> tuple[float, ...]:
    try:
        return tuple(
            float(row["start_s"])
            for row in read_rows(path, ("start_s", "marks"))
            if _STRESS_MARKS & set(row["marks"].split(","))
        )
    except ValueError as error:
        raise UserError(f"{path}: {error}; write the times as numbers") from error


def speakers_of(recordings: Sequence[EmotionRecording]) -> list[str]:
    """Return the speakers in alphabetical order."""
    return sorted({recording.speaker for recording in recordings})
