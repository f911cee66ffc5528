"""``python run.py PROGRAM SOUNDS TABLES``: writes curves of Python packages, like ``run.js``."""

import csv
import subprocess
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
    """Yield the vowels of pylipsync, whose window of 64 ms is centered on its frame."""
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
        sound, table = Path(folder) / "sound.wav", Path(folder) / "curves.csv"
        write_wav(sound, samples)
        rate = ["--fps", str(FRAMES_PER_S)]
        openfacefx(["energy", "--wav", str(sound), "-o", str(table), *rate])
        with table.open(encoding="utf-8", newline="") as lines:
            keyframes = list(csv.DictReader(lines))
    channels: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for row in keyframes:
        channels[row["channel"]].append((float(row["time"]), float(row["value"])))
    curves = {name: np.array(channels.get(name, [(0.0, 0.0)])).T for name in _OPENFACEFX_CURVES}
    for time_s in np.arange(0.0, len(samples) / RATE_HZ, 1.0 / FRAMES_PER_S):
        weights = {name: float(np.interp(time_s, *c)) for name, c in curves.items()}
        yield float(time_s), weights


def rhubarb_rows(samples: Samples) -> Iterator[Row]:
    """Yield the mouths of Rhubarb Lip Sync, and their openings. It works offline."""
    openings = dict(zip("ABCDEFGHX", (0.0, 0.25, 0.6, 1.0, 0.5, 0.2, 0.1, 0.6, 0.0), strict=True))
    with tempfile.TemporaryDirectory() as folder:
        sound = Path(folder) / "sound.wav"
        write_wav(sound, samples)
        command = ["rhubarb", "-f", "tsv", "-r", "phonetic", str(sound)]
        done = subprocess.run(command, capture_output=True, text=True, check=True)  # noqa: S603
    cues = [line.split("\t") for line in done.stdout.splitlines()]
    starts_s, mouths = [float(start) for start, _ in cues], [mouth for _, mouth in cues]
    for time_s in np.arange(0.0, len(samples) / RATE_HZ, 1.0 / FRAMES_PER_S):
        mouth = mouths[max(int(np.searchsorted(starts_s, time_s, side="right")) - 1, 0)]
        shown = {f"mouth_{name}": float(name == mouth) for name in openings}
        yield float(time_s), {"opening": openings[mouth], **shown}


def write_wav(path: Path, samples: Samples) -> None:
    """Write 16-bit mono samples."""
    with wave.open(str(path), "wb") as file:
        file.setparams((1, 2, RATE_HZ, 0, "NONE", ""))
        file.writeframes((np.clip(samples, -1.0, 1.0) * 32767.0).astype("<i2").tobytes())


PROGRAMS: dict[str, Callable[[Samples], Iterator[Row]]] = {
    "pylipsync": pylipsync_rows,
    "openfacefx": openfacefx_rows,
    "rhubarb": rhubarb_rows,
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
