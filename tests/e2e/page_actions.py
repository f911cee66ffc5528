"""Faces, sounds and clicks for tests of the page."""

from pathlib import Path

import numpy as np
import soundfile
from numpy.typing import NDArray

from kouxing.shared.face.faps import NUM_FAPS
from tests.browser import Browser

NOTICE = "document.getElementById('notice').textContent"
STATE = "window.kouxing.state"
# Rows 15 (a) and 13 (b) of the Mandarin viseme table: FAP number to value.
FAP_COLUMNS = [*range(3, 15), 16, 17, 44, 45, 46, 47, *range(51, 61)]
A_VALUES = [
    *(450, -280, -600, -40, -40, -220, -220, -520, -520, -70, -70, 0, 0, 70),
    *(-210, -100, -220, 120, -260, -510, -40, -40, -230, -230, -520, -520, -20, -20),
]
B_VALUES = [
    *(0, 0, 0, -50, -50, 0, 0, 0, 0, -20, -20, 0, 50, 50),
    *(-120, -50, -120, 0, 10, 80, -100, -100, 10, 10, 30, 30, -30, -30),
]


def face(values: list[int]) -> NDArray[np.float32]:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(FAP_COLUMNS) - 1] = values
    return faps


A_FACE, B_FACE = face(A_VALUES), face(B_VALUES)


def write_tone(path: Path) -> None:
    """Write three seconds of a pulsed 300 Hz tone, which no noise suppression removes."""
    time_s = np.arange(3 * 48000) / 48000
    tone = 0.4 * np.sin(2 * np.pi * 300 * time_s) * (np.sin(2 * np.pi * 2 * time_s) > 0)
    soundfile.write(path, tone, 48000)


def is_loud(samples: NDArray[np.int16]) -> bool:
    return bool(np.sqrt((samples.astype(float) ** 2).mean()) > 300)


def colorfulness(image: NDArray[np.uint8]) -> NDArray[np.int_]:
    """Return the colorfulness of each pixel, 0 to 255."""
    levels = image.astype(np.int_)
    spread: NDArray[np.int_] = levels.max(axis=2) - levels.min(axis=2)
    return spread


def choose(page: Browser, name: str, value: object) -> None:
    """Change a setting."""
    page.evaluate(
        f"(() => {{ const input = document.getElementById('{name}'); input.value = '{value}';"
        "input.dispatchEvent(new Event('input')); })()"
    )
