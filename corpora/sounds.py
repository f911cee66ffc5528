"""Sounds without speech: music, noise, babble, laughter, breath.

A folder of sounds has a ``manifest.tsv`` with the columns ``path``, ``kind`` and ``license``. About
a quarter of the music and noise files are held out, by the CRC-32 of their names. The other kinds
have few files, so the second half of each file is held out.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from kouxing.corpora.feature_cache import read_audio
from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.speech_corpus import may_distribute
from kouxing.corpora.tables import read_rows
from kouxing.shared.arrays import Int16
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import UserError

_HELD_OUT_BY_FILE = ("music", "noise")
_BACKGROUNDS = ("music", "noise", "babble")


@dataclass(frozen=True, slots=True)
class Sound:
    """A sound, or one half of a sound."""

    name: str
    kind: str
    samples: Int16  # 16 kHz
    is_held_out: bool


def read_sounds(folders: Sequence[Path], *, any_license: bool) -> list[Sound]:
    """Read folders; UserError if a file is missing or cannot be read.

    Without ``any_license``, sounds whose license does not allow distributing a model are skipped.
    """
    sounds = []
    for folder in folders:
        manifest = folder / "manifest.tsv"
        rows = read_rows(manifest, ("path", "kind", "license"))
        if not rows:
            raise UserError(f"{manifest} has no rows; list one sound per row")
        files = [
            (row["kind"], folder / row["path"])
            for row in rows
            if any_license or may_distribute(row["license"])
        ]
        for parts in process_in_order(_split_sound, files):
            sounds += parts
    return sounds


def held_out(sounds: Sequence[Sound], kind: str) -> list[Sound]:
    """Return the held-out sounds of a kind."""
    return [sound for sound in sounds if sound.kind == kind and sound.is_held_out]


def training_backgrounds(sounds: Sequence[Sound]) -> list[Int16]:
    """Return the music, noise and babble that may be mixed with speech in training."""
    return [
        sound.samples for sound in sounds if sound.kind in _BACKGROUNDS and not sound.is_held_out
    ]


def _split_sound(file: tuple[str, Path]) -> list[Sound]:
    kind, path = file
    samples = as_integers(read_audio(path))
    if kind in _HELD_OUT_BY_FILE:
        return [Sound(path.name, kind, samples, zlib.crc32(path.name.encode()) % 4 == 2)]
    middle = len(samples) // 2
    halves = ((samples[:middle], False), (samples[middle:], True))
    return [Sound(path.name, kind, half, is_held_out) for half, is_held_out in halves]
