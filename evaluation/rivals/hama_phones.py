"""``python hama_phones.py SOUNDS``: prints the IPA of recordings, by the package hama.

``SOUNDS`` is a folder of 16 kHz samples, 32-bit floats. Each recording is a line of the output.
"""

import sys
from pathlib import Path

import numpy as np
from hama.asr import ASRModel  # type: ignore[import-not-found]

RATE_HZ = 16_000


def main(sounds: Path) -> None:
    """Print the phones of each file, in the order of their names."""
    model = ASRModel()
    for path in sorted(sounds.iterdir()):
        result = model.transcribe_waveform(np.fromfile(path, "<f4"), RATE_HZ)
        print("".join(result.phonemes))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
