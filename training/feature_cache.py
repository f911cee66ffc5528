"""Log-mel features of corpora, kept on disk so that a second training run starts at once.

One file of 16-bit floats per corpus and front end, in the user's cache folder
(``$XDG_CACHE_HOME/kouxing`` or ``~/.cache/kouxing``). Deleting it is always safe.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray
from rich.progress import track

from services.recognizer.features import LogMel
from services.recognizer.resample import to_16_khz
from training.corpus import RowErrors, Utterance

_FORMAT = "3"  # raise when the front end's log-mel stage changes


def cache_folder() -> Path:
    """Folder for everything that can be computed again."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "kouxing"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def read_audio(path: Path) -> NDArray[np.float32]:
    """Read a recording as 16 kHz mono.

    Raises
    ------
    ValueError
        If the file is no audio that libsndfile reads.
    """
    try:
        samples, rate_hz = soundfile.read(path, dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, OSError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    return to_16_khz(samples, rate_hz)


def log_mel_of(
    utterances: Sequence[Utterance], errors: RowErrors
) -> list[NDArray[np.float16] | None]:
    """Log-mel features of every utterance, from the cache or computed.

    Returns
    -------
    list
        Shape (frames, 41) each; None where the audio cannot be read (noted in ``errors``).
    """
    if not utterances:
        return []
    key = hashlib.sha256(_FORMAT.encode())
    for utterance in utterances:
        state = utterance.path.stat()
        key.update(f"{utterance.path}|{state.st_size}|{state.st_mtime_ns}\n".encode())
    stem = cache_folder() / f"log_mel_{key.hexdigest()[:20]}"
    rows, bounds = stem.with_suffix(".npy"), stem.with_suffix(".bounds.npy")
    if not (rows.is_file() and bounds.is_file()):
        _compute(utterances, rows, bounds)
    ends = np.load(bounds, allow_pickle=False)
    log_mel = np.load(rows, mmap_mode="r", allow_pickle=False)
    starts = np.concatenate([[0], ends[:-1]])
    out: list[NDArray[np.float16] | None] = []
    for utterance, start, end in zip(utterances, starts, ends, strict=True):
        if start == end:
            errors.add(utterance.utterance_id, f"no audio in {utterance.path}")
        out.append(log_mel[start:end] if end > start else None)
    return out


def _compute(utterances: Sequence[Utterance], rows: Path, bounds: Path) -> None:
    blocks, lengths = [], []
    for utterance in track(utterances, description="features"):
        try:
            block = LogMel().accept_waveform(read_audio(utterance.path)).astype(np.float16)
        except ValueError:
            block = np.empty((0, 41), dtype=np.float16)
        blocks.append(block)
        lengths.append(len(block))
    np.save(rows, np.concatenate(blocks))
    np.save(bounds, np.cumsum(lengths, dtype=np.int64))
