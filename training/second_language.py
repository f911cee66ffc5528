"""Speech in another language, whose frames the recurrent network learns as a second task.

English phones are numbered like units, in the order of ``NEAREST_UNIT``, with the same silence; so
the second task has as many states as the first. For the first alignment each phone is taken for the
unit that sounds most like it.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from shared.errors import UserError
from shared.phones import UNIT_INDEX
from training.corpus import RowErrors, Utterance
from training.examples import Example, speech_span
from training.feature_cache import log_mel_of

NEAREST_UNIT = {
    "AA": "a", "AE": "a", "AH": "e", "AO": "o", "AW": "ao", "AY": "ai", "B": "b", "CH": "ch",
    "D": "d", "DH": "z", "EH": "ei", "ER": "er", "EY": "ei", "F": "f", "G": "g", "HH": "h",
    "IH": "i", "IY": "i", "JH": "zh", "K": "k", "L": "l", "M": "m", "N": "n", "NG": "eng",
    "OW": "ou", "OY": "o", "P": "p", "R": "r", "S": "s", "SH": "sh", "T": "t", "TH": "s",
    "UH": "u", "UW": "u", "V": "f", "W": "u", "Y": "i", "Z": "z", "ZH": "r",
}  # fmt: skip
_NUMBER = {phone: number for number, phone in enumerate(NEAREST_UNIT)}
_NEAREST = [UNIT_INDEX[unit] for unit in NEAREST_UNIT.values()]
_LEAST_FRAMES = 3  # a phone; a recording with fewer is left out


def load_second_language(folder: Path, errors: RowErrors) -> list[Example]:
    """Read recordings in English; the units of the examples are numbers of phones.

    Parameters
    ----------
    folder
        Holds ``manifest.tsv`` with ``utt_id``, ``path``, ``seconds`` and ``arpabet``, phones of the
        CMU dictionary without stress, separated by spaces.
    errors
        Receives a message for every row that cannot be used.

    Raises
    ------
    UserError
        If the manifest has other columns or phones, or nothing is left.
    """
    manifest = folder / "manifest.tsv"
    try:
        with manifest.open(encoding="utf-8", newline="") as lines:
            rows = list(csv.DictReader(lines, delimiter="\t", quoting=csv.QUOTE_NONE))
        strings = [tuple(_NUMBER[phone] for phone in row["arpabet"].split()) for row in rows]
        utterances = [_utterance(folder, row) for row in rows]
    except (OSError, KeyError, ValueError) as error:
        raise UserError(
            f"{manifest} is no list of utt_id, path, seconds and arpabet ({error!r})"
        ) from error
    examples = []
    for string, log_mel in zip(strings, log_mel_of(utterances, errors), strict=True):
        if log_mel is None:
            continue
        trimmed = log_mel[speech_span(log_mel)]
        if len(trimmed) > _LEAST_FRAMES * len(string) > 0:
            pauses = (1,) * len(string)  # may stand anywhere: where words end is not known
            examples.append(Example(log_mel=trimmed, units=string, syllables=pauses, weight=1.0))
    if not examples:
        raise UserError(f"{manifest} lists no recording that is long enough for its phones")
    return examples


def as_nearest_units(examples: Sequence[Example]) -> list[Example]:
    """Take every phone for the unit of Mandarin that sounds most like it."""
    return [
        replace(example, units=tuple(_NEAREST[phone] for phone in example.units))
        for example in examples
    ]


def _utterance(folder: Path, row: dict[str, str]) -> Utterance:
    return Utterance(
        utterance_id=row["utt_id"],
        path=folder / row["path"],
        speaker="",
        source="",
        licence="",
        split="train",
        seconds=float(row["seconds"]),
        units=(),
        syllables=(),
    )
