"""Small clips of filmed lips on disk."""

import json
from pathlib import Path

import numpy as np
import soundfile

from kouxing.corpora.lip_clips import split_of
from kouxing.shared.clock import MEDIA_RATE_HZ
from tests.system import DEMO, VOWELS_FILE, samples_of_file

FRAME_S = 0.04


def write_held_out_clip(folder: Path) -> None:
    """Write a held-out clip whose tracked mouth opens and closes four times a second."""
    samples, rate_hz = soundfile.read(DEMO / "hello-female.wav", frames=16_000)
    soundfile.write(folder / "cam_1.flac", samples, rate_hz)
    rows = [f"{t:.2f},0,{-150 + 150 * np.cos(8 * np.pi * t):.0f}" for t in np.arange(25) / 25]
    (folder / "cam_1.csv").write_text("\n".join(["t,F4_lower_t_midlip,F5_raise_b_midlip", *rows]))
    (folder / "cam_1.json").write_text('{"speaker": "ann", "language": "zh"}')
    (folder / "held.txt").write_text("ann")


def write_training_clip(folder: Path, name: str, speaker: str, license_name: str) -> None:
    """Write a clip of 2 s in which all tracked points move."""
    samples = samples_of_file(VOWELS_FILE)[: 2 * MEDIA_RATE_HZ]
    soundfile.write(folder / f"{name}.flac", samples, MEDIA_RATE_HZ)
    about = {"speaker": speaker, "licence": license_name, "language": "en"}
    (folder / f"{name}.json").write_text(json.dumps(about))
    rows = [
        f"{k * FRAME_S},{100 + 50 * np.sin(k)},0,{-200 - 100 * np.sin(k)},{5 * np.cos(k)},0"
        for k in range(50)
    ]
    head = "t,F3_open_jaw,F4_upper,F5_lower,F6_left,F7_right"
    (folder / f"{name}.csv").write_text("\n".join([head, *rows]) + "\n")


def clip_name_for(split: str) -> str:
    """Return a name that the rule puts into this split."""
    return next(name for k in range(100) if split_of(name := f"clip_{k}", may_train=True) == split)
