"""Drawn mouths: their letters, cues over time, and the files of Rhubarb Lip Sync."""

import io
import json
import os
import sys
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import soundfile

from kouxing.services.cli import rhubarb
from kouxing.services.cli.recordings.animation import FaceMotion
from kouxing.services.cli.recordings.cue_files import format_cues
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.dynamic_visemes.visemes import VISEME_INDEX
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS
from kouxing.shared.face.high_level_faps import VISEMES as MPEG4_VISEMES
from kouxing.shared.face.mouth_shapes import Cue, mouth_cues, mouth_shape, oculus_cues
from kouxing.shared.face.shapes import OCULUS
from tests.system import VOWELS_FILE, samples_of_file

REST, OPEN, WIDE = np.zeros((3, NUM_FAPS), np.float32)
OPEN[4], WIDE[4] = -400.0, -600.0  # the lower lip
HI = [(0.0, "X"), (0.05, "D"), (0.27, "C"), (0.31, "B"), (0.43, "X")]  # example in Rhubarb's README
CLOSING = [(0.0, "C"), (0.1, "A"), (0.3, "X")]


@pytest.mark.parametrize(
    ("viseme", "letter"),
    [
        *[("b", "A"), ("z", "B"), ("zh", "B"), ("i", "B"), ("ei", "C"), ("er", "C"), ("a", "D")],
        *[("ai", "D"), ("o", "E"), ("u", "F"), ("v", "F"), ("f", "G"), ("rest", "A")],
    ],
)
def test_visemes_have_the_letters_of_their_sounds(viseme: str, letter: str) -> None:
    faps = np.zeros(NUM_FAPS, np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = load_parameters().target[VISEME_INDEX[viseme]]
    assert mouth_shape(faps) == letter


def test_a_raised_tongue_is_seen_in_an_open_mouth() -> None:
    faps = OPEN.copy()
    faps[43] = 420.0
    assert mouth_shape(faps) == "H"


FACES = {"o": OPEN, "w": WIDE, "-": REST}


@pytest.mark.parametrize(
    ("faces", "cues"),
    [
        ("ooooowwwwwwwwwwooooo", "0 C, 5 D, 15 C"),  # a cue starts when the mouth changes
        ("ooooo-----ooooo", "0 C, 5 A, 10 C"),
        ("ooooo---------------", "0 C, 5 A, 15 X"),  # closed lips are at rest after a while
        ("----------", "0 X"),
        ("oowo-oo", "0 C, 4 A, 5 C"),  # one frame is too short except for a closure
        ("oow-ww", "0 C, 3 A, 4 D"),  # between equal mouths
    ],
)
def test_the_cues_of_faces(faces: str, cues: str) -> None:
    shown = mouth_cues((number / 50, FACES[face]) for number, face in enumerate(faces))
    assert ", ".join(f"{50 * start_s:.0f} {letter}" for start_s, letter in shown) == cues


def test_oculus_visemes_are_found_again() -> None:
    names = [name for _, name in oculus_cues(enumerate(np.repeat(MPEG4_VISEMES, 2, axis=0)))]
    assert names == list(OCULUS.names)


@pytest.mark.parametrize(
    ("shown", "end_s", "lines"),
    [
        (HI, 0.479, "0.00 X, 0.05 D, 0.27 C, 0.31 B, 0.43 X, 0.47 X"),
        (HI, 0.3, "0.00 X, 0.05 D, 0.27 C, 0.30 X"),
        (CLOSING, 0.5, "0.00 C, 0.10 X, 0.50 X"),
        (CLOSING, 0.2, "0.00 C, 0.10 X, 0.20 X"),
        ([], 0.2, "0.00 X, 0.20 X"),
    ],
    ids=["README", "no cue after the end", "lips that close for a rest", "an early end", "no cues"],
)
def test_the_tsv_output_has_a_line_per_cue(shown: list[Cue], end_s: float, lines: str) -> None:
    text = format_cues(".tsv", shown, "X", end_s, None)
    assert text == lines.replace(" ", "\t").replace(",\t", "\n") + "\n"


def test_json_and_xml_have_the_same_cues(tmp_path: Path) -> None:
    source = tmp_path / "<hi> & bye.wav"
    content = json.loads(format_cues(".json", HI, "X", 0.47, source))
    assert content["metadata"] == {"soundFile": str(source), "duration": 0.47}
    assert content["mouthCues"][1] == {"start": 0.05, "end": 0.27, "value": "D"}
    root = ET.fromstring(format_cues(".xml", HI, "X", 0.47, source))  # noqa: S314 - our own
    assert root.findtext("metadata/soundFile") == str(source)
    assert [
        {"start": float(cue.attrib["start"]), "end": float(cue.attrib["end"]), "value": cue.text}
        for cue in root.iterfind("mouthCues/mouthCue")
    ] == content["mouthCues"]


def test_any_file_name_gives_valid_files() -> None:
    source = Path(os.fsdecode(b"/\xff\x01.wav"))
    content = json.loads(format_cues(".json", HI, "X", 0.47, source).encode())
    assert content["metadata"]["soundFile"] == "/\ufffd\x01.wav"
    root = ET.fromstring(format_cues(".xml", HI, "X", 0.47, source).encode())  # noqa: S314 - our own
    assert root.findtext("metadata/soundFile") == "/\ufffd\ufffd.wav"


def test_no_switch_of_moho_follows_the_end_of_the_recording(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    faces = [REST, OPEN, WIDE]
    frames = [(number / 50, faces[number // 5]) for number in range(5 * len(faces))]
    motion = FaceMotion(frames, 50.0, 25.0, samples=np.zeros(int(0.18 * MEDIA_RATE_HZ), np.float32))
    monkeypatch.setattr(rhubarb, "_animate", lambda _: motion)
    rhubarb.main(["-q", "-f", "dat", "--datFrameRate", "50", "said.wav"])
    assert capsys.readouterr().out == "MohoSwitch1\n1 X\n6 C\n10 X\n"


def test_a_switch_of_moho_at_the_start_of_a_frame_belongs_to_this_frame(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = [(number / 50, OPEN if number >= 58 else REST) for number in range(100)]
    motion = FaceMotion(frames, 50.0, 25.0, samples=np.zeros(2 * MEDIA_RATE_HZ, np.float32))
    monkeypatch.setattr(rhubarb, "_animate", lambda _: motion)
    rhubarb.main(["-q", "-f", "dat", "--datFrameRate", "25", "said.wav"])
    assert capsys.readouterr().out == "MohoSwitch1\n1 X\n30 C\n51 X\n"


@pytest.mark.slow
def test_the_command_line_equals_rhubarbs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "out.json"
    output.write_text("an older file")
    shapes = ["--extendedShapes", "GX", "--machineReadable"]
    rhubarb.main(["-f", "json", "-r", "phonetic", *shapes, "-o", str(output), str(VOWELS_FILE)])
    letters = {cue["value"] for cue in json.loads(output.read_text())["mouthCues"]}
    assert {"C", "X"} < letters <= set("ABCDEFGX")
    events = [json.loads(line) for line in capsys.readouterr().err.splitlines()]
    assert [event["type"] for event in events] == ["start", "progress", "success"]
    rhubarb.main(["-q", "-f", "dat", "--datUsePrestonBlair", str(VOWELS_FILE)])
    switches = capsys.readouterr().out.splitlines()
    assert switches[:2] == ["MohoSwitch1", "1 rest"]
    assert switches[-1].endswith(" rest")
    rhubarb.main([str(VOWELS_FILE)])
    assert capsys.readouterr().err.splitlines()[1:] == ["progress: 100 %", "finished"]


def test_errors_equal_rhubarbs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log, missing = tmp_path / "log.txt", str(tmp_path / "no.wav")
    with pytest.raises(SystemExit, match="1"):
        rhubarb.main(["--machineReadable", "--logFile", str(log), missing])
    assert log.read_text().startswith("[Fatal] ")
    failure = json.loads(capsys.readouterr().err.splitlines()[-1])
    assert failure["type"] == "failure"
    assert "no such file" in failure["reason"]


@pytest.mark.parametrize(
    ("options", "problems"),
    [
        (["-f", "dat", "--datFrameRate", "5"], ["--datFrameRate 5: choose 10 to 100"]),
        (["--logFile", "no/log.txt"], ["no/log.txt", "no such file"]),
        (["-o", "no/mouths.tsv"], ["cannot write no/mouths.tsv: the folder does not exist"]),
    ],
    ids=[
        "a wrong frame rate, before the recording is read",
        "a log that cannot be written",
        "an output that cannot be written, before the recording is read",
    ],
)
def test_each_problem_is_reported(
    capsys: pytest.CaptureFixture[str], options: list[str], problems: list[str]
) -> None:
    with pytest.raises(SystemExit, match="1"):
        rhubarb.main([*options, "no.wav"])
    printed = capsys.readouterr().err
    assert all(problem in printed for problem in problems)


class StatusStream(io.StringIO):
    """Standard error that notes the size of a file whenever a status is printed."""

    def __init__(self, result: Path) -> None:
        super().__init__()
        self._result = result
        self.sizes: list[int] = []

    def write(self, text: str) -> int:
        self.sizes.append(self._result.stat().st_size)
        return super().write(text)


def test_the_result_is_complete_when_the_success_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = tmp_path / "result.json"
    status = StatusStream(result)
    with result.open("w") as output:
        monkeypatch.setattr(sys, "stdout", output)
        monkeypatch.setattr(sys, "stderr", status)
        rhubarb.main(["-f", "json", "--machineReadable", str(VOWELS_FILE)])
        monkeypatch.undo()
    assert json.loads(status.getvalue().splitlines()[-1])["type"] == "success"
    assert status.sizes[-1] == result.stat().st_size > 0


def test_a_text_that_does_not_fit_is_ignored(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    dialog, vowels = tmp_path / "dialog.txt", tmp_path / "vowels.wav"
    soundfile.write(vowels, samples_of_file(VOWELS_FILE)[:16_000], 16_000)
    rhubarb.main(["--machineReadable", str(vowels)])
    without_text, _ = capsys.readouterr()
    for text in ("مرحبا", "bibidi bobidi bu"):
        dialog.write_text(text)
        rhubarb.main(["--machineReadable", "-d", str(dialog), str(vowels)])
        with_text, status = capsys.readouterr()
        assert with_text == without_text
        events = [json.loads(line) for line in status.splitlines()]
        assert [event["type"] for event in events] == ["start", "log", "progress", "success"]
