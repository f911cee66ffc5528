"""Small corpora on disk, and training on them."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import soundfile
from numpy.typing import NDArray

RATE_HZ = 16_000


def write_manifest(folder: Path, columns: str, rows: Iterable[str] = ()) -> Path:
    """Write the table of a corpus; spaces separate the columns, and tabs the cells of a row."""
    folder.mkdir(exist_ok=True)
    path = folder / "manifest.tsv"
    lines = [columns.replace(" ", "\t"), *rows]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def write_speech(folder: Path, recordings: Mapping[str, NDArray[Any]]) -> Path:
    """Write recordings of one text; those whose name begins with d are for dev."""
    pinyin = "ni3 hao3 huan1 ying2 lai2 dao4"
    splits = {name: "dev" if name.startswith("d") else "train" for name in recordings}
    rows = [f"{n}\t{n}.wav\tS\tCC0-1.0\t{split}\t1.5\t{pinyin}" for n, split in splits.items()]
    write_manifest(folder, "utt_id path speaker license split seconds pinyin", rows)
    for name, samples in recordings.items():
        soundfile.write(folder / f"{name}.wav", samples, RATE_HZ)
    return folder


def write_noises(folder: Path) -> Path:
    """Write noise as babble and as laughter, 2 s of each."""
    kinds = ("babble", "laughter")
    write_manifest(folder, "path kind license", [f"{kind}.wav\t{kind}\tCC0" for kind in kinds])
    rng = np.random.default_rng(0)
    for kind in kinds:
        soundfile.write(folder / f"{kind}.wav", rng.normal(0, 0.1, 32_000), RATE_HZ)
    return folder


def interrupt(recipe: ModuleType, writer: str, train: Callable[[], object]) -> None:
    """Interrupt training when its recipe calls the function that writes the model."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recipe, writer, Mock(side_effect=KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            train()
