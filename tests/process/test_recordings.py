"""The Python and JavaScript code reads the same recordings, and rejects the same ones."""

import json
import subprocess
from base64 import b64encode
from pathlib import Path
from typing import Any

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
    "case of the titles": "Time_S,jawOpen,Phone\n0,0,a\n0.02,0.5,a\n",
    "empty lines": "time_s,jawOpen\r\n\r\n0,0\r\n0.02,0.5\r\n,\r\n",
    "old line ends": "time_s,jawOpen\r0,0\r0.02,0.5\r",
    "an empty column": "time_s,jawOpen,\n0,0,\n0.02,0.5,\n",
    "numbers of the frames": "sequence,time_s,jawOpen\n,0,0\n,0.02,0.5\n",
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


@pytest.mark.parametrize("recording", RECORDINGS.values(), ids=RECORDINGS)
def test_both_read_the_same_frames(
    tmp_path: Path, in_javascript: dict[str | bytes, Any], recording: str | bytes
) -> None:
    animation = read_table(write(tmp_path, recording))
    read = in_javascript[recording]
    column, unit = (JAW, 1.0) if read["names"] is None else (0, JAW_PER_WEIGHT)
    first, *_, (last_time, last) = read["frames"]
    assert read["names"] is None or read["names"][0] == "jawOpen"
    assert first[0] == 0
    assert last_time / 16000 == pytest.approx((len(animation.faps) - 1) / animation.frame_rate_hz)
    assert first[1][column] * unit == pytest.approx(animation.faps[0, JAW])
    assert last[column] * unit == pytest.approx(animation.faps[-1, JAW])
    assert last[column] * unit == pytest.approx(0.5 * JAW_PER_WEIGHT)


@pytest.mark.parametrize("recording", REJECTED.values(), ids=REJECTED)
def test_both_reject_an_unclear_recording(
    tmp_path: Path, in_javascript: dict[str | bytes, Any], recording: str | bytes
) -> None:
    with pytest.raises(UserError):
        read_table(write(tmp_path, recording))
    assert in_javascript[recording].get("error", "").startswith("Error: "), in_javascript[recording]
