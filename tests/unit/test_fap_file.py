"""Reading and writing .fap files and their variants."""

import os
from pathlib import Path

import numpy as np
import pytest

from kouxing.shared.errors import UserError
from kouxing.shared.face.fap_file import FapAnimation, read_fap, write_fap


def mask(*faps: int, digits: int = 68) -> str:
    return " ".join("1" if number in faps else "0" for number in range(1, digits + 1))


def write(tmp_path: Path, *lines: str, end: str = "\n") -> Path:
    path = tmp_path / "some.fap"
    path.write_bytes(end.join(lines).encode("utf-8"))
    return path


def test_reads_an_xface_frame(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "# made by hand",
        "2.1 C:\\some where\\file 25 2",
        mask(1, 2, 3, 51),
        "0 5 0 63 0 2 40 0 0 0 0 120 -7",
        "",
        mask(3),
        "1 1.5e2  ",
        end="\r\n",
    )
    got = read_fap(path)
    assert got.name == "C:\\some where\\file"
    assert got.frame_rate_hz == 25.0
    assert got.faps[0, [0, 1, 2, 50]].tolist() == [5.0, 2.0, 120.0, -7.0]
    assert got.visemes is not None and got.expressions is not None  # noqa: PT018
    assert got.visemes.tolist() == [[5, 0, 63, 0], [0, 0, 0, 0]]
    assert got.expressions.tolist() == [[2, 40, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0]]
    assert got.faps[1, 2] == 150.0


def test_writes_visemes_and_expressions(tmp_path: Path) -> None:
    faps = np.zeros((2, 68), dtype=np.float32)
    faps[:, 0], faps[:, 1], faps[:, 2] = [4, 0], [1, 2], [7, 8]
    visemes = np.array([[4, 9, 31, 0], [0, 0, 0, 0]])
    expressions = np.array([[1, 63, 3, 20, 0, 0], [2, 5, 0, 0, 0, 0]])
    path = tmp_path / "some.fap"
    write_fap(path, FapAnimation("x", 25.0, faps, visemes, expressions))
    again = read_fap(path)
    np.testing.assert_array_equal(again.faps, faps)
    np.testing.assert_array_equal(again.visemes, visemes)
    np.testing.assert_array_equal(again.expressions, expressions)


def test_writes_a_name_that_is_not_utf_8(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"\xff.fap")
    write_fap(path, FapAnimation(path.stem, 25.0, np.zeros((1, 68), np.float32)))
    assert read_fap(path).name == "\ufffd"


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ([], "line 1: expected '2.1 NAME FPS NFRAMES', found nothing"),
        (["2.0 x 25 1"], "line 1: .* found version '2.0'"),
        (["2.1 x 25 many"], "line 1: 'many' is not a number of frames"),
        (["2.1 x fast 1"], "line 1: frame rate 'fast'"),
        (["2.1 x 0.0001 1"], "line 1: frame rate '0.0001' is not between 1 and 1000"),
        (["2.1 x 25 -1"], "number of frames is -1"),
        (["2.1 x 25 2", mask(3), "0 1"], "line 3: the file ends after 1 of 2 frames"),
        (["2.1 x 25 1", mask(1), "0 15 0 63 0"], "line 3: FAP 1 is 15; .* from 0 to 14"),
        (["2.1 x 25 1", mask(2), "0 1.5"], "line 3: FAP 2 is 1.5; .* from 0 to 6"),
        (["2.1 x 25 1", "0 1 0", "0"], "line 2: expected a mask of 68"),
        (["2.1 x 25 1", mask(69, digits=69), "0 1"], "line 2: the mask sets a 69th"),
        (["2.1 x 25 1", mask(3, 4), "0 1"], "line 3: found 1 values, but the mask sets 2"),
        (["2.1 x 25 1", mask(3), "0 one"], "line 3: a value is not a number"),
        (["2.1 x 25 1", mask(3), "x 1"], "line 3: 'x' is not a frame number"),
        (["2.1 x 25 2", mask(3), "0 1", mask(3), "5 1"], "line 5: found frame 5, expected frame 1"),
        (["2.1 x 25 1", mask(3), "0 1", mask(3)], "line 4: more frames than the header states: 1"),
    ],
)
def test_error_names_line_and_reason(tmp_path: Path, lines: list[str], complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        read_fap(write(tmp_path, *lines))


@pytest.mark.parametrize(
    ("bits", "values", "faps"),
    [
        (mask(1, 3, 48, digits=69), "12 0 80 -900", {1: 0, 3: 80, 48: -900}),  # Greta
        (mask(3, 5, 6, 7).replace(" ", ""), "0 inf nan -inf 1e60", {3: 0, 5: 0, 6: 0, 7: 0}),
        # The outer lips follow the inner ones if they are not set.
        (mask(4, 5, 57, 52), "0 -10 -20 -30 -40", {51: -10, 52: -30, 57: -40, 10: -40}),
    ],
)
def test_reads_variants(tmp_path: Path, bits: str, values: str, faps: dict[int, float]) -> None:
    animation = read_fap(write(tmp_path, "2.1 AU Interpolation_1111.fap 25 1", bits, values))
    assert animation.name == "AU Interpolation_1111.fap"
    row = animation.faps[0]
    assert {number: row[number - 1] for number in faps} == faps
