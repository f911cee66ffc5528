"""Speech to text: which model a folder holds, and what a user is told who has none."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from services.recognizer.transcriber import SherpaTranscriber
from shared.errors import UserError

pytestmark = pytest.mark.unit


class OfflineRecognizer:
    """Stands for sherpa-onnx's: remembers how it was made, and tells how much it heard."""

    def __init__(self, kind: str, files: dict[str, Any]) -> None:
        self.kind, self.files = kind, files

    @classmethod
    def from_transducer(cls, encoder: str, decoder: str, joiner: str, **rest: Any) -> Any:
        return cls("transducer", {"encoder": encoder, "decoder": decoder, "joiner": joiner, **rest})

    @classmethod
    def from_paraformer(cls, paraformer: str, **rest: Any) -> Any:
        return cls("paraformer", {"model": paraformer, **rest})

    @classmethod
    def from_sense_voice(cls, model: str, language: str, **rest: Any) -> Any:
        return cls("sense-voice", {"model": model, "language": language, **rest})

    def create_stream(self) -> Any:
        stream = SimpleNamespace(heard=[])
        stream.accept_waveform = lambda rate_hz, samples: stream.heard.append(
            (rate_hz, len(samples))
        )
        return stream

    def decode_stream(self, stream: Any) -> None:
        stream.result = SimpleNamespace(text=f" {self.kind} {stream.heard[0]} ")


@pytest.fixture
def sherpa(monkeypatch: pytest.MonkeyPatch) -> None:
    module = ModuleType("sherpa_onnx")
    module.OfflineRecognizer = OfflineRecognizer  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "sherpa_onnx", module)


def folder_of(path: Path, **sizes: int) -> Path:
    path.mkdir()
    (path / "tokens.txt").touch()
    for name, size in sizes.items():
        (path / (name.replace("__", ".") + ".onnx")).write_bytes(bytes(size))
    return path


@pytest.mark.usefixtures("sherpa")
def test_the_files_tell_the_kind_of_model(tmp_path: Path) -> None:
    transducer = folder_of(tmp_path / "zipformer", encoder=9, encoder__int8=3, decoder=1, joiner=1)
    paraformer = folder_of(tmp_path / "sherpa-onnx-paraformer-zh", model__int8=1)
    sense_voice = folder_of(tmp_path / "sherpa-onnx-sense-voice-zh", model=1)
    sound = np.zeros(1600, np.float32)
    for folder in (transducer, paraformer, sense_voice):
        kind = SherpaTranscriber(folder).transcribe(sound)
        assert kind.split(" (")[0] in str(folder) or folder is transducer
        assert kind.endswith("(16000, 1600)")
    made = SherpaTranscriber(transducer)._recognizer
    assert Path(made.files["encoder"]).name == "encoder.int8.onnx"
    assert made.files["tokens"] == str(transducer / "tokens.txt")


@pytest.mark.usefixtures("sherpa")
def test_a_folder_without_a_model_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds no tokens\.txt"):
        SherpaTranscriber(tmp_path)
    with pytest.raises(UserError, match="no model of a known kind"):
        SherpaTranscriber(folder_of(tmp_path / "other", model=1))


def test_without_the_package_the_user_is_told_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "sherpa_onnx", None)
    with pytest.raises(UserError, match=r"pip install 'kouxing\[speech-to-text\]'"):
        SherpaTranscriber(tmp_path)
