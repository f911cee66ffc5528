"""Log-mel features of corpora, kept on disk so that a second training run starts at once.

One file of 16-bit floats per corpus and way of computing, in the user's cache folder
(``$XDG_CACHE_HOME/kouxing`` or ``~/.cache/kouxing``). Deleting it is always safe.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Sequence
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
    out: list[NDArray[np.float16] | None] = []
    blocks = cached_blocks(utterances, "", 1, lambda _, samples: [_log_mel(samples)])
    for utterance, block in zip(utterances, blocks, strict=True):
        if len(block) == 0:
            errors.add(utterance.utterance_id, f"no audio in {utterance.path}")
        out.append(block if len(block) else None)
    return out


def _log_mel(samples: NDArray[np.float32]) -> NDArray[np.float32]:
    return LogMel().accept_waveform(samples)


def cached_blocks(
    utterances: Sequence[Utterance],
    way: str,
    num_blocks: int,
    blocks_of: Callable[[Utterance, NDArray[np.float32]], list[NDArray[np.float32]]],
) -> list[NDArray[np.float16]]:
    """Blocks of log-mel frames of every utterance, from the cache or computed.

    Parameters
    ----------
    utterances
        Recordings; the cache knows them by path, size and time.
    way
        How the blocks are computed, in words: another way, another file.
    num_blocks
        Blocks of each recording.
    blocks_of
        Computes them from the utterance and its samples at 16 kHz, shape (n,).

    Returns
    -------
    list
        Shape (frames, 41) each, ``num_blocks`` per utterance in order; empty blocks where the
        audio cannot be read.
    """
    if not utterances:
        return []
    key = hashlib.sha256((_FORMAT + way).encode())
    for utterance in utterances:
        state = utterance.path.stat()
        key.update(f"{utterance.path}|{state.st_size}|{state.st_mtime_ns}\n".encode())
    stem = cache_folder() / f"log_mel_{key.hexdigest()[:20]}"
    rows, bounds = stem.with_suffix(".npy"), stem.with_suffix(".bounds.npy")
    if not (rows.is_file() and bounds.is_file()):
        blocks = [
            block
            for u in track(utterances, description="features")
            for block in _computed(u, num_blocks, blocks_of)
        ]
        np.save(rows, np.concatenate(blocks))
        np.save(bounds, np.cumsum([len(block) for block in blocks], dtype=np.int64))
    ends = np.load(bounds, allow_pickle=False)
    log_mel = np.load(rows, mmap_mode="r", allow_pickle=False)
    starts = np.concatenate([[0], ends[:-1]])
    return [log_mel[start:end] for start, end in zip(starts, ends, strict=True)]


def _computed(
    utterance: Utterance,
    num_blocks: int,
    blocks_of: Callable[[Utterance, NDArray[np.float32]], list[NDArray[np.float32]]],
) -> Iterator[NDArray[np.float16]]:
    try:
        samples = read_audio(utterance.path)
    except ValueError:
        yield from [np.empty((0, 41), dtype=np.float16)] * num_blocks
        return
    for block in blocks_of(utterance, samples):
        yield block.astype(np.float16)
