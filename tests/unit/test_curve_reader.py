"""Tables of curves are read as they were written; unclear ones are rejected with their fault."""

import csv
from pathlib import Path

import numpy as np
import pytest
import soundfile

from kouxing.services.cli.options import CurveFormat, ExportOptions
from kouxing.services.cli.recordings.animation import read_motion
from kouxing.services.cli.recordings.curve_exporters import CURVE_EXPORTERS, FrameStream
from kouxing.services.cli.recordings.curve_reader import read_table
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.shapes import ARKIT
from tests.lips import phone

RATE_HZ = 50.0
HUGE = 10**400  # not a float
JAW = FAP_NUMBER["open_jaw"] - 1
HEAD_YAW = FAP_NUMBER["head_yaw"] - 1


def face_curves() -> FrameStream:
    faps = np.zeros((60, NUM_FAPS), np.float32)
    for row, jaw_open in zip(faps, np.linspace(0.0, 0.5, 60), strict=True):
        row[:] = ARKIT.faps(np.where(np.array(ARKIT.names) == "jawOpen", jaw_open, 0.0))
        row[HEAD_YAW] = 5000.0
    rows = [(number / RATE_HZ, number, row) for number, row in enumerate(faps)]
    return FrameStream(rows, RATE_HZ, [phone(0, "a", 0.1, 0.195)])


@pytest.mark.parametrize(
    ("name", "form", "has_head"),
    [
        ("face.csv", CurveFormat.FAPS, True),
        ("face.jsonl", CurveFormat.FAPS, True),
        ("face.csv", CurveFormat.ARKIT, False),
        ("face.jsonl", CurveFormat.ARKIT, False),
        ("face.csv", CurveFormat.LIVELINK, True),
    ],
)
def test_reads_what_it_wrote(tmp_path: Path, name: str, form: CurveFormat, has_head: bool) -> None:
    path, curves = tmp_path / name, face_curves()
    write(path, curves, form)
    animation = read_table(path)
    assert animation.frame_rate_hz == pytest.approx(RATE_HZ)
    faps = np.array([row for _, _, row in curves.rows])
    np.testing.assert_allclose(animation.faps[:, JAW], faps[:, JAW], atol=5.0)
    np.testing.assert_allclose(animation.faps[:, HEAD_YAW], 5000.0 * has_head, atol=1.0)


def write(path: Path, curves: FrameStream, form: CurveFormat = CurveFormat.FAPS) -> None:
    CURVE_EXPORTERS[path.suffix](path, ExportOptions(curve_format=form)).write(curves)


def slow_curves(frame_rate_hz: float) -> FrameStream:
    """Return curves with the first frame at 0.99 of a step after a full second."""
    faps = np.zeros(NUM_FAPS, np.float32)
    rows = [((number + 0.99) / frame_rate_hz, number, faps) for number in range(20)]
    return FrameStream(rows, frame_rate_hz)


def test_a_live_link_take_keeps_its_rate(tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    write(path, slow_curves(6.0), CurveFormat.LIVELINK)
    animation = read_table(path)
    assert animation.frame_rate_hz == pytest.approx(6.0, abs=0.01)
    assert len(animation.faps) == 20
    path.unlink()
    with pytest.raises(UserError, match=r"take\.csv: .*at least 6 frames .* has 5; use --as arkit"):
        write(path, slow_curves(5.0), CurveFormat.LIVELINK)
    assert not path.exists()


@pytest.mark.parametrize("rate_hz", [24.0, 30.0, 60.0, 120.0])
def test_a_table_with_times_in_milliseconds_keeps_its_rate(tmp_path: Path, rate_hz: float) -> None:
    path, faps = tmp_path / "face.csv", np.zeros(NUM_FAPS, np.float32)
    write(path, FrameStream([(number / rate_hz, number, faps) for number in range(240)]))
    animation = read_table(path)
    assert animation.frame_rate_hz == pytest.approx(rate_hz, rel=1e-3)
    assert len(animation.faps) == 240


def test_the_rate_of_a_table_with_two_different_steps_is_that_of_one_of_them(
    tmp_path: Path,
) -> None:
    path = tmp_path / "face.csv"
    path.write_text("time_s,jawOpen\n0,0\n0.01,0.1\n0.06,0.2\n")
    assert read_table(path).frame_rate_hz == pytest.approx(100.0)


def test_a_table_may_have_a_long_gap(tmp_path: Path) -> None:
    path = tmp_path / "face.csv"
    path.write_text("time_s,jawOpen\n0,0\n0.02,1\n0.04,0\n300,0\n300.02,1\n300.04,0\n")
    animation = read_table(path)
    assert animation.frame_rate_hz == pytest.approx(50.0)
    assert len(animation.faps) == 15_003


def test_the_times_of_a_table_are_those_of_its_sound(tmp_path: Path) -> None:
    table, sound, faps = tmp_path / "face.csv", tmp_path / "s.wav", np.zeros(NUM_FAPS, np.float32)
    write(table, FrameStream([(12.0 + number / RATE_HZ, number, faps) for number in range(3)]))
    assert read_motion(table, None).frames[0][0] == 0.0
    for duration_s, start_s in ((13, 12.0), (11, 0.0)):
        soundfile.write(sound, np.zeros(16_000 * duration_s), 16_000)
        times_s = [time_s for time_s, _ in read_motion(table, sound).frames]
        assert times_s == pytest.approx([start_s, start_s + 0.02, start_s + 0.04])


def test_live_link_table_has_the_columns_of_the_app(tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    write(path, face_curves(), CurveFormat.LIVELINK)
    header, *rows = csv.reader(path.read_text().splitlines())
    assert header[:3] == ["Timecode", "BlendShapeCount", "EyeBlinkLeft"]
    assert header[16:20] == ["JawForward", "JawRight", "JawLeft", "JawOpen"]
    assert header[-9:-5] == ["HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw"]
    assert {len(row) for row in rows} == {63}
    assert [row[0] for row in rows[49:51]] == ["00:00:00:58.800", "00:00:01:00.000"]
    assert rows[0][1] == "61"


def test_tables_have_the_phone_of_each_frame(tmp_path: Path) -> None:
    path = tmp_path / "face.csv"
    write(path, face_curves())
    phones = [row["phone"] for row in csv.DictReader(path.read_text().splitlines())]
    assert phones[4:16] == ["", *["a"] * 10, ""]


@pytest.mark.parametrize(
    ("codes", "times_s"),
    [
        (["13:13:04:118", "13:13:04:119", "13:13:05:00"], [0, 1 / 120, 2 / 120]),
        (["10:00:00:28.0", "10:00:00:29.0", "10:00:01:00.0"], [0, 1 / 30, 2 / 30]),
    ],
)
def test_reads_time_codes_of_live_link_takes(
    tmp_path: Path, codes: list[str], times_s: list[float]
) -> None:
    path = tmp_path / "take.csv"
    rows = [f"{code},61,{number * 0.1}\n" for number, code in enumerate(codes)]
    path.write_text("Timecode,BlendShapeCount,JawOpen\n" + "".join(rows))
    animation = read_table(path)
    assert 1 / animation.frame_rate_hz == pytest.approx(times_s[1])
    assert len(animation.faps) == len(times_s)
    assert animation.faps[-1, JAW] == pytest.approx(
        ARKIT.basis[ARKIT.names.index("jawOpen"), JAW] * 0.1 * (len(codes) - 1)
    )


@pytest.mark.parametrize(
    ("columns", "shapes"),
    [
        ("jaw_open,Head.mouthSmile_L", ("jawOpen", "mouthSmileLeft")),
        ("JawOpen,Cheek_Puff_L", ("jawOpen", "cheekPuff")),
    ],
)
def test_reads_the_names_of_other_programs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], columns: str, shapes: tuple[str, str]
) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"TIME_S,{columns},nose,jawOpne\n0,0.5,0.25,1,1\n", encoding="utf-8")
    weights = np.zeros(len(ARKIT.names), np.float32)
    weights[[ARKIT.names.index(shape) for shape in shapes]] = 0.5, 0.25
    assert np.abs(read_table(path).faps[0] - ARKIT.faps(weights)).max() < 1e-3
    assert (
        capsys.readouterr().err
        == f"{path}: ignored unknown columns: nose, jawOpne (did you mean jawOpen?)\n"
    )


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        (
            "a.csv",
            "frame,jawOpen\n0,0.5\n",
            "time_s or Timecode; the columns are frame, jawOpen; rename",
        ),
        ("a.csv", "time_s,nose\n0,0.5\n", "no column is named after a FAP or a shape"),
        ("a.csv", "time_s,jawOpen,JawOpen\n0,0,1\n", "two columns have the name jawOpen"),
        ("a.csv", "time_s,jawOpen\n0,nan\n", "frame 1: a value is missing or not a number"),
        ("a.csv", "time_s,jawOpen\n0,0.1\n0.02\n", "frame 2: a value is missing"),
        ("a.csv", "time_s,jawOpen\n0.1,0\n0,0\n", "frame 2: its time is earlier"),
        ("a.csv", "time_s,jawOpen\nnow,0\n", "every line needs a time in seconds"),
        ("a.jsonl", '{"time_s": 0, "arkit": {"jawOpen": [0.1]}}', "frame 1: a value is missing"),
        ("a.jsonl", f'{{"time_s": 0, "arkit": {{"jawOpen": {HUGE}}}}}', "frame 1: a value is"),
        ("a.jsonl", f'{{"time_s": {HUGE}, "arkit": {{"jawOpen": 0}}}}', "a time in seconds"),
        ("a.csv", "time_s,jawOpen\n0,0\n40,0\n", "1 to 1000 frames per second"),
        (
            "a.csv",
            "time_s,jawOpen\n0,0\n0.02,0\n0.04,0\n30000,0\n",
            "the times span 30000 s, more than 1000000 frames at 50 per second; split",
        ),
        ("a.csv", "Timecode,JawOpen\n00:01,0\n", "every line needs a time code"),
        ("a.csv", "", "the file is empty"),
        ("a.csv", "\n,,\n", "the file is empty"),
        ("a.csv", "time_s,jawOpen\n", "no frames with a face"),
        ("a.csv", "time_s,jawOpen\n0,0.2\n0.02,50\n", "frame 2: .* divide percentages by 100"),
        ("a.csv", f"time_s,jawOpen\n0,{'1' * 140_000}\n", "not a table"),
        ("a.csv", "t\0", "not a text file"),
        ("a.jsonl", '{"time_s": 0}\n', "line 1: expected an object with time_s"),
        ("a.jsonl", '{"faps": [0]}\n', "line 1: expected an object with time_s"),
        (
            "a.jsonl",
            '{"time_s": 0, "arkit": {"jawOpen": 0}}\n'
            '{"time_s": 1, "arkit": {"jawOpen": 0, "mouthClose": 1}}\n',
            "line 2: .* all lines need the same values",
        ),
        ("a.jsonl", "[" * 5000, "line 1: expected an object"),
    ],
)
def test_rejects_an_unclear_table(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=message):
        read_table(tmp_path / name)
