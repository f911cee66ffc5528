"""Speech to text with sherpa-onnx, for audio without a transcript."""

from pathlib import Path
from typing import Any

from kouxing.shared.arrays import Floats
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.errors import UserError, install_command


class Transcriber:
    """Transcribes Mandarin with a model that the user provides.

    ``folder`` contains a model as sherpa-onnx distributes it: ``tokens.txt``, and either encoder,
    decoder and joiner (a transducer), or one model. In the second case, the name of the folder
    contains ``paraformer`` or ``sense-voice``. Of several files, the smallest is used, which has
    8-bit weights.

    Raises ``UserError`` if sherpa-onnx is not installed, or the folder does not contain a valid
    model.
    """

    def __init__(self, folder: Path) -> None:
        try:
            self._recognizer = _recognizer_in(folder)
        except (IndexError, RuntimeError, ValueError) as error:
            raise UserError(
                f"{folder}: sherpa-onnx cannot load the model: {error}; copy it again"
            ) from None

    def transcribe(self, samples: Floats) -> str:
        """Return the text of audio, 16 kHz mono, shape (n,); empty without speech."""
        stream = self._recognizer.create_stream()
        stream.accept_waveform(MEDIA_RATE_HZ, samples)
        self._recognizer.decode_stream(stream)
        return str(stream.result.text).strip()


def _recognizer_in(folder: Path) -> Any:
    try:
        from sherpa_onnx import OfflineRecognizer  # noqa: PLC0415 (optional)
    except ImportError:
        raise UserError(
            f"speech to text needs sherpa-onnx: {install_command('kouxing[speech-to-text]')}"
        ) from None
    tokens = folder / "tokens.txt"
    parts = {name: _model_in(folder, name) for name in ("encoder", "decoder", "joiner", "model")}
    if not tokens.is_file():
        raise UserError(f"{folder} contains no tokens.txt; use the folder of a sherpa-onnx model")
    options = {"tokens": str(tokens), "num_threads": 1}
    if parts["encoder"] and parts["decoder"] and parts["joiner"]:
        names = ("encoder", "decoder", "joiner")
        return OfflineRecognizer.from_transducer(**options, **{name: parts[name] for name in names})
    if parts["model"] and "paraformer" in folder.name:
        return OfflineRecognizer.from_paraformer(**options, paraformer=parts["model"])
    if parts["model"] and "sense-voice" in folder.name:
        return OfflineRecognizer.from_sense_voice(**options, model=parts["model"], language="zh")
    raise UserError(
        f"{folder} contains no model of a known kind; use the folder of a sherpa-onnx transducer, "
        "or one whose name contains 'paraformer' or 'sense-voice'"
    )


def _model_in(folder: Path, name: str) -> str | None:
    """Return the smallest file whose name starts with a name."""
    files = filter(Path.is_file, folder.glob(f"{name}*.onnx"))
    paths = sorted(files, key=lambda path: path.stat().st_size)
    return str(paths[0]) if paths else None
