"""Log-mel features and samples of corpora, cached on disk.

There is one file per corpus and kind, with 16-bit floats or integers, in the user's cache folder
(``$XDG_CACHE_HOME/kouxing`` or ``~/.cache/kouxing``). It is memory-mapped, so it may exceed the
memory. Deleting it is always safe.
"""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rich.progress import track

from kouxing.corpora.parallel import process_in_order
from kouxing.corpora.speech_corpus import RowErrors, Utterance
from kouxing.services.recognizer.front_end.features import NUM_BANDS, LogMel
from kouxing.services.recognizer.front_end.resample import to_16_khz
from kouxing.shared.arrays import Float16, Floats, Int16
from kouxing.shared.audio import audio_file
from kouxing.shared.audio.pcm import as_integers
from kouxing.shared.errors import UserError

_FORMAT = "4"  # increase it when the front end's log-mel stage changes


def cache_folder() -> Path:
    """Return the cache folder; everything in it can be computed again."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    folder = Path(base) / "kouxing"
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def load_or_compute(
    path: Path, compute: Callable[[], Mapping[str, ArrayLike]]
) -> dict[str, NDArray[Any]]:
    """Return the arrays in a file (.npz). If it does not exist, compute and write it first."""
    if not path.exists():
        unfinished = path.with_suffix(".part.npz")
        np.savez(unfinished, allow_pickle=False, **compute())
        unfinished.replace(path)
    with np.load(path, allow_pickle=False) as file:
        return dict(file)


def read_audio(path: Path) -> Floats:
    """Read a recording as 16 kHz mono; UserError if it cannot be read."""
    return to_16_khz(*audio_file.read_audio(path))


def log_mel_of(utterances: Sequence[Utterance], errors: RowErrors) -> list[Float16 | None]:
    """Return the log-mel features of every utterance, (frames, 41), cached or computed.

    None for audio that cannot be read, which is reported in ``errors``.
    """
    empty = np.empty((0, 1 + NUM_BANDS), dtype=np.float16)
    blocks = _cached(
        utterances,
        "log_mel",
        empty,
        lambda samples: LogMel().accept_waveform(samples).astype(np.float16),
    )
    for utterance, block in zip(utterances, blocks, strict=True):
        if len(block) == 0:
            errors.add(utterance.utterance_id, f"no audio in {utterance.path}")
    return [block if len(block) else None for block in blocks]


def samples_of(utterances: Sequence[Utterance]) -> list[Int16]:
    """Return the samples of every utterance, 16 kHz; empty if the audio cannot be read."""
    return _cached(utterances, "samples", np.empty(0, dtype=np.int16), as_integers)


def _cached(
    utterances: Sequence[Utterance],
    kind: str,
    empty: NDArray[Any],
    compute_block: Callable[[Floats], NDArray[Any]],
) -> list[NDArray[Any]]:
    """Return a memory-mapped block of every utterance, from the cache or computed.

    ``kind`` names the file. ``compute_block`` computes a block from samples at 16 kHz, (n,).
    ``empty`` is the block of audio that cannot be read. Utterances are identified
    by path, size and time.
    """
    if not utterances:
        return []
    key = hashlib.sha256(_FORMAT.encode())
    for utterance in utterances:
        state = utterance.path.stat()
        key.update(f"{utterance.path}|{state.st_size}|{state.st_mtime_ns}\n".encode())
    stem = cache_folder() / f"{kind}_{key.hexdigest()[:20]}"
    rows, bounds = stem.with_suffix(".rows"), stem.with_suffix(".bounds.npy")
    if not (rows.is_file() and bounds.is_file()):
        num_rows = []

        def compute(utterance: Utterance) -> NDArray[Any]:
            with suppress(UserError):
                return compute_block(read_audio(utterance.path))
            return empty

        with rows.open("wb") as file:
            blocks = process_in_order(compute, utterances)
            for block in track(blocks, total=len(utterances), description=kind):
                file.write(np.ascontiguousarray(block).tobytes())
                num_rows.append(len(block))
        np.save(bounds, np.cumsum(num_rows))
    ends = np.load(bounds, allow_pickle=False)
    if not ends[-1]:
        return [empty] * len(ends)
    content = np.memmap(rows, empty.dtype, "r").reshape(-1, *empty.shape[1:])
    return np.split(content, ends[:-1])
