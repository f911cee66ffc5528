"""Runs other lip-sync programs on clips, and writes tables for ``evaluate lips --from-csv``.

HeadAudio, wLipSync and live2d-motionsync run in Node as in a browser's audio thread, at 48 kHz in
blocks of 128 samples. wawa-lipsync reads an analyser node 60 times a second. pylipsync (uLipSync in
Python), OpenFaceFX and Rhubarb (if it is on the path) process whole recordings. All programs have
their default settings. ``make report`` installs them, except Rhubarb.

wLipSync needs a profile, which its users make from their own voice. Here it is the mean cepstrum of
each viseme in a quarter of the training clips. Loudness is the level of the last 20 ms, from 40 dB
below the loudest frames of the recording (0) to these (1).
"""

import json
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.progress import track
from scipy.signal import resample_poly

from kouxing.corpora.lip_clips import LipClip, label_clip
from kouxing.evaluation.lips.curve_tables import read_table
from kouxing.evaluation.lips.references import read_parts
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.shared.arrays import Doubles
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import create_folder

FOLDER = Path(__file__).parent
NODE_PROGRAMS = ("headaudio", "wlipsync", "wawa", "live2d")
PYTHON_PROGRAMS = ("pylipsync", "openfacefx", *(["rhubarb"] if shutil.which("rhubarb") else []))
LOUDNESS = "loudness"
PROGRAMS = (*NODE_PROGRAMS, *PYTHON_PROGRAMS, LOUDNESS)

_RATE_HZ = 48_000
_STEP_S = 0.01
_LOUDNESS_RANGE_DB = 40.0
_VOWELS = {"a": "A", "e": "E", "i": "I", "o": "O", "u": "U"}  # names in wLipSync, by viseme
_NUM_CEPSTRA = 12
_PROFILE_EVERY = 4  # training clips, because means need few
_WINDOW = 1024  # samples at 16 kHz
_PROFILE = {
    "targetSampleRate": MEDIA_RATE_HZ,
    "sampleCount": _WINDOW,
    "melFilterBankChannels": 30,
    "compareMethod": 1,  # Euclidean
    "mfccNum": _NUM_CEPSTRA,
    "mfccDataCount": 1,
    "useStandardization": False,
    "means": [0.0] * _NUM_CEPSTRA,
    "stdDevs": [1.0] * _NUM_CEPSTRA,
}


def write_tables(folder: Path, output: Path, programs: Sequence[str]) -> None:
    """Write ``output/PROGRAM/CLIP.csv`` for the held-out and the training clips of a folder.

    Existing tables are kept. Raises ``UserError`` if a program is unknown, not installed, or fails.
    """
    unknown = {*programs} - {*PROGRAMS}
    if unknown:
        raise UserError(f"unknown program: {min(unknown)}; choose from {', '.join(PROGRAMS)}")
    held_out, training = read_parts(folder)
    clips = [*held_out, *training]
    for program in track(programs, description="programs", transient=True):
        tables = output / program
        create_folder(tables)
        missing = [clip for clip in clips if not (tables / f"{clip.name}.csv").exists()]
        if program == LOUDNESS:
            for clip in missing:
                _write_loudness(clip, tables / f"{clip.name}.csv")
        elif missing:
            is_profiled = program == "wlipsync"
            profile = _wlipsync_profile(training[::_PROFILE_EVERY]) if is_profiled else None
            _run(program, missing, tables, profile)


def _run(program: str, clips: Sequence[LipClip], tables: Path, profile: Any = None) -> None:
    with tempfile.TemporaryDirectory() as name:
        sounds, settings = Path(name) / "sounds", Path(name) / "profile.json"
        sounds.mkdir()
        settings.write_text(json.dumps(profile), encoding="utf-8")
        for clip in clips:
            sound = resample_poly(clip.samples, _RATE_HZ // MEDIA_RATE_HZ, 1)
            sound.astype("<f4").tofile(sounds / f"{clip.name}.f32")
        arguments = [program, str(sounds), str(tables.resolve())]
        if program in NODE_PROGRAMS:
            find_installed("node_modules")
            command = [find_node(), "run.js", *arguments, *([str(settings)] if profile else [])]
        else:
            command = [str(find_installed(".venv/bin/python")), "run.py", *arguments]
        done = subprocess.run(command, cwd=FOLDER, capture_output=True, text=True, check=False)  # noqa: S603
        if done.returncode:
            raise UserError(f"{program} failed: {done.stderr[-500:]}")


def find_installed(name: str) -> Path:
    """Return an installed file or folder of the programs. Raises ``UserError`` if it is missing."""
    if not (FOLDER / name).exists():
        raise UserError("this program is not installed; run 'make report' to install it")
    return FOLDER / name


def find_node() -> str:
    """Return the Node next to Python, or else on the path; raises ``UserError`` if missing."""
    node = shutil.which("node", path=str(Path(sys.executable).parent)) or shutil.which("node")
    if node is None:
        raise UserError("Node is missing; install it with: pip install 'kouxing[page]'")
    return node


def _wlipsync_profile(clips: Sequence[LipClip]) -> dict[str, Any]:
    """Return a profile with the mean cepstrum of each viseme, in the middles of its phones."""
    model = load_model()
    # wLipSync computes N coefficients for a profile with N phonemes
    blank = _profile({str(k): np.zeros(_NUM_CEPSTRA) for k in range(_NUM_CEPSTRA)})
    windows: dict[str, list[Doubles]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        _run("wlipsync", clips, Path(name), blank)
        for clip in track(clips, description="profile of wLipSync", transient=True):
            table = read_table(Path(name) / f"{clip.name}.csv")
            middle_s = table.time_s - _WINDOW / MEDIA_RATE_HZ / 2.0
            for phone in label_clip(model, clip):
                (viseme, weight), *_ = model.inventory.visemes[phone.symbol]
                distance_s = np.abs(middle_s - phone.onset_s - phone.duration_s / 2.0)
                if weight == 1.0:
                    near = distance_s <= phone.duration_s / 4.0
                    windows[_VOWELS.get(viseme, viseme)].append(table.values[near, -_NUM_CEPSTRA:])
    joined = {viseme: np.concatenate(found) for viseme, found in sorted(windows.items())}
    return _profile({name: found.mean(axis=0) for name, found in joined.items() if len(found)})


def _profile(cepstra: dict[str, Doubles]) -> dict[str, Any]:
    phonemes = [{"name": name, "values": values.tolist()} for name, values in cepstra.items()]
    return {**_PROFILE, "mfccs": phonemes}


def _write_loudness(clip: LipClip, path: Path) -> None:
    hop = round(_STEP_S * MEDIA_RATE_HZ)
    energy = np.append(0.0, np.cumsum(np.square(clip.samples, dtype=float)))
    ends = np.arange(0, len(energy), hop)
    power = (energy[ends] - energy[np.maximum(ends - 2 * hop, 0)]) / (2 * hop)
    level_db = 10.0 * np.log10(power + 1e-10)
    loudness = (level_db - np.percentile(level_db, 95)) / _LOUDNESS_RANGE_DB + 1.0
    rows = zip(ends / MEDIA_RATE_HZ, np.clip(loudness, 0.0, 1.0), strict=True)
    lines = ["t,opening", *(f"{time_s:.4f},{value:.4f}" for time_s, value in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
