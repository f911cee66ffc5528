"""Curves of other programs are created and scored, and faults are reported."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.agreement import moments
from kouxing.evaluation.lips.closures import closures
from kouxing.evaluation.lips.curve_tables import fap_conversion, read_table, read_tables
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import Mouth, predicted_mouth, real_faps, real_mouth
from kouxing.evaluation.lips.other_programs import load_program_faps, load_programs
from kouxing.evaluation.rivals import tables
from kouxing.evaluation.rivals.tables import LOUDNESS, write_tables
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS
from tests.lip_clips import write_held_out_clip

TIME_S = np.arange(200) / 25.0
LATE_S = 0.1


def clip_named(name: str) -> LipClip:
    """Return a clip whose mouth opens by up to 300 FAP units, at no regular times."""
    opening = 150.0 * (1.0 - np.cos(2 * np.pi * (1.3 * TIME_S + 0.4 * np.sin(TIME_S))))
    faps = np.full((len(TIME_S), len(MOUTH_FAPS)), np.nan)
    faps[:, MOUTH_FAPS.index(4)], faps[:, MOUTH_FAPS.index(5)] = 0.0, -opening
    faps[:, MOUTH_FAPS.index(6)] = faps[:, MOUTH_FAPS.index(7)] = 0.1 * opening
    faps[:, MOUTH_FAPS.index(3)] = opening
    samples = np.zeros(round(TIME_S[-1] * 16_000), np.float32)
    return LipClip(name=name, speaker="ann", time_s=TIME_S, faps=faps, samples=samples)


HELD_OUT, TRAINING = clip_named("held_1"), clip_named("train_1")
REAL = real_mouth(HELD_OUT.time_s, real_faps(HELD_OUT))


def write_table(path: Path, columns: dict[str, NDArray[np.float64]]) -> None:
    rows = np.stack([*columns.values()], axis=1)
    lines = [",".join(columns), *(",".join(f"{cell:.5f}" for cell in row) for row in rows)]
    path.write_text("\n".join(lines))


def late_opening() -> dict[str, NDArray[np.float64]]:
    """Return the opening in a unit of its own, made 0.1 s after its audio."""
    known_s = np.arange(900) / 100.0
    return {"t": known_s, "opening": 0.02 * REAL.at("opening", known_s - LATE_S) + 0.5}


def correlation(mouth: Mouth) -> float:
    """Return the correlation of an opening with the real one."""
    return moments([(mouth, REAL)], "opening").correlation or 0.0


def test_an_opening_is_scored_at_its_own_delay(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for clip in (HELD_OUT, TRAINING):
        write_table(folder / f"{clip.name}.csv", late_opening())
    programs = load_programs([folder], [HELD_OUT], [TRAINING])
    shipped, fitted = programs
    assert shipped == "mine, 100 ms"
    assert fitted.startswith("mine, fitted, ")
    for mouth_of in programs.values():
        mouth = mouth_of(HELD_OUT)
        assert correlation(mouth) > 0.99
        assert closures(mouth, REAL).f1 == pytest.approx(1.0)


def test_the_faps_of_a_program_are_at_its_best_delay(tmp_path: Path) -> None:
    write_table(tmp_path / "held_1.csv", late_opening())
    faps_at = load_program_faps(tmp_path, [HELD_OUT])
    assert correlation(predicted_mouth(faps_at(HELD_OUT, np.arange(430) / FRAME_RATE_HZ))) > 0.99
    with pytest.raises(UserError, match=r"add train_1\.csv"):
        load_program_faps(tmp_path, [HELD_OUT, TRAINING])


def test_without_training_clips_the_curves_count_as_they_are(tmp_path: Path) -> None:
    write_table(tmp_path / "held_1.csv", late_opening())
    assert [*load_programs([tmp_path], [HELD_OUT], [TRAINING])] == [f"{tmp_path.name}, 0 ms"]


@pytest.mark.parametrize("jaw", ["jawOpen", "viseme_aa", "aa"])
def test_shapes_open_the_mouth(tmp_path: Path, jaw: str) -> None:
    write_table(tmp_path / "held_1.csv", {jaw: np.array([0.0, 1.0]), "t": np.array([0.0, 0.01])})
    table = read_tables(tmp_path, [HELD_OUT], [])["held_1"]
    faps = fap_conversion(tmp_path, [table]).faps(table.values)
    assert not faps[0].any()
    assert -faps[1, 3] - faps[1, 4] > 200.0


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("time,opening\n0,1", "name t"),
        ("t,opening,opening\n0,1,1", "every curve once"),
        ("t,opening\n0,x", "could not convert"),
        ("t,opening\n0,nan", "not finite"),
        ("t,opening\n", "no rows"),
        ("t,opening\n0,1,2", "too many or too few"),
        ("t,opening\n1,1\n1,2", "are not increasing"),
    ],
)
def test_a_damaged_table_is_an_error(tmp_path: Path, text: str, fault: str) -> None:
    path = tmp_path / "held_1.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=fault):
        read_table(path)


def test_missing_and_unusable_tables_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"1 of 1 held-out clips have no table; add held_1.csv"):
        read_tables(tmp_path, [HELD_OUT], [])
    write_table(tmp_path / "held_1.csv", late_opening())
    write_table(tmp_path / "train_1.csv", {"t": np.zeros(1), "jawOpen": np.zeros(1)})
    with pytest.raises(UserError, match=r"train_1.csv: its columns differ"):
        read_tables(tmp_path, [HELD_OUT], [TRAINING])
    write_table(tmp_path / "held_1.csv", {"t": np.zeros(1), "energy": np.zeros(1)})
    with pytest.raises(UserError, match="no column is a curve of a mouth"):
        load_programs([tmp_path], [HELD_OUT], [])


def test_loudness_rises_with_the_voice(tmp_path: Path) -> None:
    write_held_out_clip(tmp_path)
    write_tables(tmp_path, tmp_path / "out", [LOUDNESS])
    path = tmp_path / "out" / LOUDNESS / "cam_1.csv"
    table = read_table(path)
    assert table.names == ("opening",)
    assert np.diff(table.time_s) == pytest.approx(0.01)
    assert table.values.min() < 0.3
    assert table.values.max() == 1.0
    path.write_text("t,opening\n0,0.5\n")
    write_tables(tmp_path, tmp_path / "out", [LOUDNESS])
    assert len(read_table(path).values) == 1  # existing tables stay


def test_unknown_and_missing_programs_are_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(UserError, match="unknown program: wava; choose from headaudio, "):
        write_tables(tmp_path, tmp_path / "out", ["wava"])
    write_held_out_clip(tmp_path)
    monkeypatch.setattr(tables, "FOLDER", tmp_path)
    for program in ("headaudio", "pylipsync"):
        with pytest.raises(UserError, match="is not installed; run 'make report'"):
            write_tables(tmp_path, tmp_path / "out", [program])
