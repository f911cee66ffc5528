"""``python run.py PROGRAM SOUNDS TABLES``: the curves of Python packages, like ``run.js``."""

import csv
import sys
import tempfile
import wave
from collections import defaultdict
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Samples = NDArray[np.float32]
Row = tuple[float, dict[str, float]]  # audio so far, seconds, and curves

RATE_HZ, FRAMES_PER_S = 48_000, 60
_OPENFACEFX_CURVES = ("sil", "aa", "E", "O")  # without text


def pylipsync_rows(samples: Samples) -> Iterator[Row]:
    """Yield the vowels of pylipsync, whose window of 64 ms is centered at its frame."""
    from pylipsync import PhonemeAnalyzer  # type: ignore[import-not-found] # noqa: PLC0415

    visemes = {"aa": "aa", "ee": "E", "ih": "ih", "oh": "oh", "ou": "ou", "silence": "sil"}
    half_window_s = 0.032
    for segment in PhonemeAnalyzer().extract_phoneme_segments(
        samples, RATE_HZ, fps=FRAMES_PER_S, return_seconds=True
    ):
        weights = {visemes[p.name]: p.target for p in segment.phonemes}
        yield (segment.start + segment.end) / 2.0 + half_window_s, weights


def openfacefx_rows(samples: Samples) -> Iterator[Row]:
    """Yield the visemes of ``openfacefx energy``, its mode without text. It works offline."""
    from openfacefx.cli import main as openfacefx  # type: ignore[import-not-found] # noqa: PLC0415

    with tempfile.TemporaryDirectory() as folder:
        sound, table = str(Path(folder) / "sound.wav"), str(Path(folder) / "curves.csv")
        with wave.open(sound, "wb") as file:
            file.setparams((1, 2, RATE_HZ, 0, "NONE", ""))
            file.writeframes((np.clip(samples, -1.0, 1.0) * 32767.0).astype("<i2").tobytes())
        openfacefx(["energy", "--wav", sound, "-o", table, "--fps", str(FRAMES_PER_S)])
        with Path(table).open(encoding="utf-8", newline="") as lines:
            keyframes = list(csv.DictReader(lines))
    channels: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in keyframes:
        channels[row["channel"]].append((float(row["time"]), float(row["value"])))
    curves = {name: np.array(channels.get(name, [(0.0, 0.0)])).T for name in _OPENFACEFX_CURVES}
    for time_s in np.arange(0.0, len(samples) / RATE_HZ, 1.0 / FRAMES_PER_S):
        weights = {name: float(np.interp(time_s, *c)) for name, c in curves.items()}
        yield float(time_s), weights


PROGRAMS: dict[str, Callable[[Samples], Iterator[Row]]] = {
    "pylipsync": pylipsync_rows,
    "openfacefx": openfacefx_rows,
}


def main(program: str, sounds: Path, tables: Path) -> None:
    """Write a table for each recording."""
    for path in sorted(sounds.iterdir()):
        rows = list(PROGRAMS[program](np.fromfile(path, "<f4")))
        lines = [",".join(["t", *rows[0][1]])]
        lines += [",".join(f"{value:.4f}" for value in (t, *row.values())) for t, row in rows]
        (tables / f"{path.stem}.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
