"""Output formats: chosen by suffix, checked before long work, and written as documented."""

import csv
import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.progress import Progress

from kouxing.services.cli.options import CurveFormat, ExportOptions, ListenFormat
from kouxing.services.cli.recordings.animation import FaceMotion
from kouxing.services.cli.recordings.curve_exporters import (
    CURVE_EXPORTERS,
    FapExporter,
    FrameRow,
    FrameStream,
    GlbExporter,
)
from kouxing.services.cli.recordings.exporters import open_exporter
from kouxing.services.cli.system.follow import follow
from kouxing.services.driver.config import Framing
from kouxing.services.driver.head.glb_file import GlbFile
from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import read_fap
from kouxing.shared.face.faps import NUM_FAPS
from kouxing.shared.face.shapes import ARKIT

RATE_HZ = 40.0


def rows(number: int = 5) -> list[FrameRow]:
    faps = np.zeros((number, NUM_FAPS), np.float32)
    faps[:, 2] = np.linspace(0, 400, number)  # open_jaw
    return [(index / RATE_HZ, index, faps[index]) for index in range(number)]


def export(output: Path, curve_format: CurveFormat = CurveFormat.FAPS) -> None:
    frames = [(time_s, faps) for time_s, _, faps in rows()]
    motion = FaceMotion(frames, RATE_HZ, 25.0, samples=None)
    exporter = open_exporter(output, ExportOptions(curve_format=curve_format))
    assert exporter.export(motion, Progress(disable=True)) == len(frames)


@pytest.mark.parametrize("name", ["face.CSV", "face.csv"])
def test_csv_has_a_column_per_value(tmp_path: Path, name: str) -> None:
    export(tmp_path / name, CurveFormat.ARKIT)
    with (tmp_path / name).open(encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    assert tuple(table[0]) == ("time_s", *ARKIT.names)
    assert [row["time_s"] for row in table] == ["0.000", "0.025", "0.050", "0.075", "0.100"]
    assert float(table[-1]["jawOpen"]) > 0.2 > float(table[0]["jawOpen"])


def test_json_lines_have_an_object_per_frame(tmp_path: Path) -> None:
    path = tmp_path / "face.jsonl"
    export(path)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["sequence"] for line in lines] == [0, 1, 2, 3, 4]
    assert [line["faps"][2] for line in lines] == [0, 100, 200, 300, 400]
    export(path, CurveFormat.ARKIT)
    assert tuple(json.loads(path.read_text().splitlines()[0])["arkit"]) == ARKIT.names


def test_fap_has_the_frame_rate_of_the_motion_or_of_the_times(tmp_path: Path) -> None:
    export(tmp_path / "face.fap")
    exporter = CURVE_EXPORTERS[".fap"](tmp_path / "live.fap", ExportOptions())
    assert exporter.write(FrameStream(rows())) == 5
    for name in ("face.fap", "live.fap"):
        animation = read_fap(tmp_path / name)
        assert animation.frame_rate_hz == pytest.approx(RATE_HZ)
        np.testing.assert_allclose(animation.faps[:, 2], [0, 100, 200, 300, 400], atol=0.01)


def test_fap_stays_in_time_if_frames_are_missing(tmp_path: Path) -> None:
    path = tmp_path / "live.fap"
    exporter = CURVE_EXPORTERS[".fap"](path, ExportOptions())
    first, second, _, _, last = rows()
    exporter.write(FrameStream([first, second, last], RATE_HZ, is_live=True))
    np.testing.assert_allclose(read_fap(path).faps[:, 2], [0, 100, 100, 100, 400], atol=0.01)


def test_a_format_is_rejected_if_its_suffix_is_unknown(tmp_path: Path) -> None:
    for name in ("face.yaml", "face.txt", "face.avi"):
        output = tmp_path / name
        with pytest.raises(UserError, match=r"unknown format; .*\.mp4, .*\.png, .*\.csv"):
            open_exporter(output, ExportOptions())
        with pytest.raises(UserError, match=r"unknown format; .*\.fap, \.csv, \.jsonl"):
            follow("", output, ListenFormat.FAPS, control=nullcontext(""))
        assert not output.exists()


@pytest.mark.parametrize(
    ("output", "options", "message"),
    [
        ("a.fap", {"curve_format": CurveFormat.ARKIT}, "a.fap cannot contain arkit; use .* .csv"),
        ("a.glb", {"curve_format": CurveFormat.OCULUS}, "a.glb cannot contain oculus; use"),
        ("a.csv", {"lips": ["dynamic-visemes", "learned"]}, "a curve file holds one face"),
        ("no/a.csv", {}, "cannot write"),
        ("no/a.mp4", {}, "cannot write"),
        ("a.jsonl", {"curve_format": CurveFormat.LIVELINK}, "cannot contain livelink; use .* .csv"),
        ("a.csv", {"curve_format": CurveFormat.RHUBARB}, "rhubarb; use .* .tsv, .xml, .json"),
        ("a.tsv", {"curve_format": CurveFormat.ARKIT}, "a.tsv cannot contain arkit; use"),
        ("a.mp4", {"curve_format": CurveFormat.ARKIT}, "--as does not apply .* .fap, .csv"),
        ("a.csv", {"size": "640x360"}, "--size does not apply .* .mp4"),
        ("a.fap", {"rate_hz": 30.0}, "--rate does not apply .* .mp4"),
        ("a.png", {"rate_hz": 30.0}, "--rate does not apply"),
        ("a.glb", {"camera": Framing.SIDE}, "--camera does not apply"),
        ("a.csv", {"sound": Path("a.wav")}, "--sound does not apply"),
        ("a.mp4", {"background": "transparent"}, "MP4 has no transparency"),
        ("a.mp4", {"background": "mud"}, "write studio, transparent"),
        ("a.mp4", {"at_s": 0.1}, "--at does not apply to this format; it applies to .png"),
        ("a.mp4", {"size": "huge"}, "WIDTHxHEIGHT"),
        ("a.mp4", {"size": "161x120"}, "even for a video"),
        ("a.mp4", {"size": "99999x2"}, "7680"),
        ("a.png", {"head": "nobody"}, "unknown head 'nobody'"),
    ],
)
def test_options_are_checked_before_the_work(
    tmp_path: Path, output: str, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        open_exporter(tmp_path / output, ExportOptions(**options))


def test_the_times_of_a_live_animation_start_at_0_and_increase(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frame = np.zeros(NUM_FAPS, np.float32)
    times_s = (60.0, 60.02, 60.02, 60.02, 60.04)  # media time stops while no audio arrives
    live = FrameStream([(time_s, n, frame) for n, time_s in enumerate(times_s)], is_live=True)
    output = tmp_path / "face.glb"
    assert GlbExporter(output, ExportOptions()).write(live) == 3
    assert f"{output} starts at 60.000 s of the session" in capsys.readouterr().err
    curves = tmp_path / "face.fap"
    FapExporter(curves, ExportOptions()).write(live)
    assert f"{curves} starts at 60.000 s of the session" in capsys.readouterr().err
    glb = GlbFile(output)
    times = glb.accessor(glb.json["animations"][0]["samplers"][0]["input"])
    np.testing.assert_allclose(times.ravel(), [0.0, 0.02, 0.04], atol=1e-6)
