"""The Python and JavaScript code, and the Blender add-on, read and reject the same recordings."""

import importlib.util
import json
import subprocess
import sys
from base64 import b64encode
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import pytest

from kouxing.services.cli.recordings.curve_reader import read_table
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.shapes import ARKIT
from tests.system import NODE, ROOT

JAW = FAP_NUMBER["open_jaw"] - 1
JAW_PER_WEIGHT = float(ARKIT.basis[ARKIT.names.index("jawOpen"), JAW])
FAPS = json.dumps([0.0] * JAW + [0.5 * JAW_PER_WEIGHT] + [0.0] * (NUM_FAPS - JAW - 1))
TAKE = "Timecode,BlendShapeCount,JawOpen,HeadYaw\n"
TABS = "time_s\tjawOpen\r\n0\t0\r\n0,02\t0,5\r\n\t\r\n"
FIRST_LINE = '{"time_s": 0, "arkit": {"jawOpen": 0}}\n'
RECORDINGS: dict[str, str | bytes] = {
    "shapes": "time_s,jawOpen\n0,0\n0.02,0.5\n",
    "a column of text": "time_s,jawOpen,scene\n0,0,inside\n0.02,0.5,a bus\n",
    "case of the titles": "Time_S,jawOpen,Phone\n0,0,a\n0.02,0.5,a\n",
    "empty lines": "time_s,jawOpen\r\n\r\n0,0\r\n0.02,0.5\r\n,\r\n",
    "old line ends": "time_s,jawOpen\r0,0\r0.02,0.5\r",
    "an empty column": "time_s,jawOpen,\n0,0,\n0.02,0.5,\n",
    "numbers of the frames": "sequence,time_s,jawOpen\n,0,0\n,0.02,0.5\n",
    "a late start": "time_s,jawOpen\n10.6,0\n10.62,0.5\n",
    "semicolons, from Excel": "sep=;\ntime_s;jawOpen\n0;0\n0,02;0,5\n;\n",
    "quotes": '"time_s","jawOpen"\n"0","0"\n"0.02","0.5"\n',
    "quotes and decimal commas": '"time_s","jawOpen"\n"0","0"\n"0,02","0,5"\n',
    "tabs": TABS,
    "UTF-16": TABS.encode("utf-16"),
    "UTF-16, big-endian": ("\ufeff" + TABS).encode("utf-16-be"),
    "json with old line ends": FIRST_LINE.replace("\n", "\r")
    + '{"time_s": 0.02, "arkit": {"jawOpen": 0.5}}',
    "json": FIRST_LINE + '\n{"time_s": 0.02, "arkit": {"jawOpen": 0.5}}\n',
    "json of FAPs": f'{{"time_s": 0, "faps": {FAPS}}}\n{{"time_s": 0.02, "faps": {FAPS}}}\n',
    "take": TAKE + "13:13:04:59.5,61,0,0\n13:13:05:00.7,61,0.5,0\n",
    "take, from Excel": "\ufeffsep=;\nTimecode;JawOpen\n1:0:0:00,000;0,0\n1:0:0:02,500;0,5\n",
    "take with dropped frames": TAKE + "13:13:04;59.5,61,0,0\n13:13:05;00.7,61,0.5,0\n",
    "take within a second": TAKE + "13:13:04:31.0,61,0,0\n13:13:04:33.0,61,0.5,0\n",
    "take over midnight": TAKE + "23:59:59:59.0,61,0,0\n00:00:00:00.0,61,0.5,0\n",
    "take that loses the face": TAKE + "1:0:0:00.0,61,0,0\n1:0:0:01.0,0,,\n1:0:0:02.0,61,0.5,0\n",
}
REJECTED: dict[str, str | bytes] = {
    "an empty file": "",
    "no times": "frame,jawOpen\n0,0.5\n",
    "no frames": "time_s,jawOpen\n",
    "no frames with a face": TAKE + "1:0:0:00.0,0,,\n",
    "a missing value": "time_s,jawOpen\n0,\n",
    "a missing cell": "time_s,jawOpen\n0,0.1\n0.02\n",
    "no number": "time_s,jawOpen\n0,nan\n",
    "no time": "time_s,jawOpen\nnow,0\n",
    "no time code": TAKE + "00:01,61,0,0\n",
    "times that fall": "time_s,jawOpen\n0.1,0\n0,0\n",
    "json with null": '{"time_s": 0, "arkit": {"jawOpen": null}}\n',
    "json without times": '{"faps": [0]}\n',
    "json without values": '{"time_s": 0}\n',
    "json with other values": FIRST_LINE + '{"time_s": 1, "vrm": {"aa": 0}}\n',
    "percentages": "time_s,jawOpen\n0,0\n0.02,50\n",
    "no json": '{"time_s"\n',
}

JAVASCRIPT = """
import { readFileSync } from "node:fs";
import { readRecording } from "./recording.js";
const read = (base64) => {
  try {
    return readRecording(Buffer.from(base64, "base64"));
  } catch ({ name, message }) {
    return { error: `${name}: ${message}` };
  }
};
const recordings = JSON.parse(readFileSync(0, "utf8"));
const toArray = (_, value) => ArrayBuffer.isView(value) ? [...value] : value;
console.log(JSON.stringify(recordings.map(read), toArray));
"""


@pytest.fixture(scope="module")
def in_javascript() -> dict[str | bytes, Any]:
    """Return what JavaScript reads from all recordings, by their contents."""
    recordings = [*RECORDINGS.values(), *REJECTED.values()]
    result = subprocess.run(
        [NODE, "--input-type=module", "-e", JAVASCRIPT],
        input=json.dumps([b64encode(to_bytes(recording)).decode() for recording in recordings]),
        stdout=subprocess.PIPE,
        encoding="utf-8",
        cwd=ROOT / "clients" / "javascript",
        check=True,
    )
    return dict(zip(recordings, json.loads(result.stdout), strict=True))


def to_bytes(recording: str | bytes) -> bytes:
    return recording.encode() if isinstance(recording, str) else recording


def write(folder: Path, recording: str | bytes) -> Path:
    content = to_bytes(recording)
    path = folder / ("face.jsonl" if content.startswith(b"{") else "face.csv")
    path.write_bytes(content)
    return path


Recording = tuple[list[float], str, dict[str, list[float]]]


@pytest.fixture
def read_in_blender(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Recording]:
    """Return the function of the add-on. Fakes of Blender's modules are imported."""
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


@pytest.mark.parametrize("recording", RECORDINGS.values(), ids=RECORDINGS)
def test_python_and_javascript_read_the_same_frames(
    tmp_path: Path, in_javascript: dict[str | bytes, Any], recording: str | bytes
) -> None:
    animation = read_table(write(tmp_path, recording))
    read = in_javascript[recording]
    column, unit = (JAW, 1.0) if read["names"] is None else (0, JAW_PER_WEIGHT)
    (first_time, first), *_, (last_time, last) = read["frames"]
    assert read["names"] is None or read["names"][0] == "jawOpen"
    assert first_time / 16000 == animation.start_s
    duration_s = (len(animation.faps) - 1) / animation.frame_rate_hz
    assert (last_time - first_time) / 16000 == pytest.approx(duration_s)
    assert first[column] * unit == pytest.approx(animation.faps[0, JAW])
    assert last[column] * unit == pytest.approx(animation.faps[-1, JAW])
    assert last[column] * unit == pytest.approx(0.5 * JAW_PER_WEIGHT)


@pytest.mark.parametrize("recording", REJECTED.values(), ids=REJECTED)
def test_python_and_javascript_reject_an_unclear_recording(
    tmp_path: Path, in_javascript: dict[str | bytes, Any], recording: str | bytes
) -> None:
    with pytest.raises(UserError):
        read_table(write(tmp_path, recording))
    assert in_javascript[recording].get("error", "").startswith("Error: "), in_javascript[recording]


@pytest.mark.parametrize("recording", RECORDINGS.values(), ids=RECORDINGS)
def test_blender_reads_the_same_frames_or_names_the_shapes_that_it_needs(
    tmp_path: Path, read_in_blender: Callable[[str], Recording], recording: str | bytes
) -> None:
    path = write(tmp_path, recording)
    if isinstance(recording, str) and ("faps" in recording or "Timecode" in recording):
        with pytest.raises(ValueError, match=r"not the shapes of ARKit|has no column time_s"):
            read_in_blender(str(path))
        return
    animation = read_table(path)
    times_s, set_name, weights = read_in_blender(str(path))
    assert (set_name, weights) == ("arkit", {"jawOpen": [0.0, 0.5]})
    assert times_s == pytest.approx([animation.start_s, animation.start_s + 0.02])


@pytest.mark.parametrize("recording", REJECTED.values(), ids=REJECTED)
def test_blender_rejects_an_unclear_recording(
    tmp_path: Path, read_in_blender: Callable[[str], Recording], recording: str | bytes
) -> None:
    with pytest.raises((AttributeError, ValueError, TypeError)):
        read_in_blender(str(write(tmp_path, recording)))


def test_blender_averages_the_parts_of_a_shape_as_the_server_does(
    tmp_path: Path, read_in_blender: Callable[[str], Recording]
) -> None:
    path = tmp_path / "FACE.CSV"
    path.write_text("time_s,Jaw_Open,Cheek_Puff_L,Cheek_Puff_R\n0,0.5,0.2,0.4\n")
    _, _, weights = read_in_blender(str(path))
    assert weights == {"jawOpen": [0.5], "cheekPuff": pytest.approx([0.3])}
    puff = ARKIT.names.index("cheekPuff")
    expected = 0.5 * ARKIT.basis[ARKIT.names.index("jawOpen")] + 0.3 * ARKIT.basis[puff]
    assert read_table(path).faps[0] == pytest.approx(expected, abs=1e-3)
