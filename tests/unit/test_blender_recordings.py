"""The Blender add-on reads recordings without Blender: fakes of its modules are imported."""

import importlib.util
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from unittest.mock import MagicMock

import pytest

from kouxing.shared.face.shapes import ARKIT
from tests.system import ROOT

Recording = tuple[list[float], str, dict[str, list[float]]]
HEADER = f"time_s,{','.join(ARKIT.names)}\n"
ROW = ",0.5" * len(ARKIT.names) + "\n"


@pytest.fixture
def read_recording(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Recording]:
    """Return the function of the add-on."""
    bpy, helpers = MagicMock(), ModuleType("bpy_extras.io_utils")
    bpy.types.Operator, bpy.types.Panel = type("Operator", (), {}), type("Panel", (), {})
    helpers.ImportHelper = type("ImportHelper", (), {})  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    monkeypatch.setitem(sys.modules, "bpy_extras", MagicMock())
    monkeypatch.setitem(sys.modules, "bpy_extras.io_utils", helpers)
    path = ROOT / "examples" / "blender" / "kouxing_face.py"
    spec = importlib.util.spec_from_file_location("kouxing_face", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    function: Callable[[str], Recording] = module.read_recording
    return function


def test_reads_tables_of_spreadsheets(
    tmp_path: Path, read_recording: Callable[[str], Recording]
) -> None:
    path = tmp_path / "FACE.CSV"
    path.write_text(f"{HEADER}0{ROW}0.02{ROW}", encoding="utf-8-sig")
    times_s, set_name, weights = read_recording(str(path))
    assert (times_s, set_name) == ([0.0, 0.02], "arkit")
    assert weights["jawOpen"] == [0.5, 0.5]


@pytest.mark.parametrize(
    ("name", "text"), [("face.jsonl", '{"time_s": 0, "faps": [0]}\n'), ("face.csv", "")]
)
def test_a_recording_without_shapes_is_an_error(
    tmp_path: Path, read_recording: Callable[[str], Recording], name: str, text: str
) -> None:
    path = tmp_path / name
    path.write_text(text)
    with pytest.raises(ValueError, match="its columns are not the shapes of ARKit, Oculus or VRM"):
        read_recording(str(path))
