"""Speech to text with sherpa-onnx and tiny models in its formats."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.recognizer.transcriber import SherpaTranscriber
from kouxing.shared.errors import UserError
from tests.sherpa_models import paraformer, sense_voice, transducer

pytestmark = pytest.mark.unit

SOUND = 0.1 * np.random.default_rng(0).standard_normal(16_000).astype(np.float32)


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("zipformer", transducer),
        ("sherpa-onnx-paraformer-zh", paraformer),
        ("sherpa-onnx-sense-voice-zh", sense_voice),
    ],
)
def test_runs_every_kind_of_model(tmp_path: Path, name: str, write: Callable[[Path], Path]) -> None:
    transcriber = SherpaTranscriber(write(tmp_path / name))
    assert transcriber.transcribe(SOUND) == "你好"
    assert transcriber.transcribe(SOUND[:8000]) == "你好"


def test_uses_the_smallest_file(tmp_path: Path) -> None:
    folder = paraformer(tmp_path / "paraformer")
    (folder / "model.onnx").rename(folder / "model.int8.onnx")
    (folder / "model.onnx").write_bytes(bytes(100_000))  # cannot be loaded
    assert SherpaTranscriber(folder).transcribe(SOUND) == "你好"


def test_rejects_a_folder_without_a_model(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"contains no tokens\.txt"):
        SherpaTranscriber(tmp_path)
    with pytest.raises(UserError, match="no model of a known kind"):
        SherpaTranscriber(paraformer(tmp_path / "other"))
    damaged = paraformer(tmp_path / "paraformer")
    (damaged / "tokens.txt").write_text("你 0\n", encoding="utf-8")
    with pytest.raises(UserError, match=r"paraformer: sherpa-onnx cannot load the model"):
        SherpaTranscriber(damaged)


def test_reports_which_package_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sherpa_onnx", None)
    with pytest.raises(UserError, match=r"pip install 'kouxing\[speech-to-text\]'"):
        SherpaTranscriber(tmp_path)
