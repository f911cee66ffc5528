"""Curves of other programs: a table that is the real mouth scores 1, and a fault is named."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from kouxing.corpora.lip_clips import LipClip
from kouxing.evaluation.lips.agreement import moments
from kouxing.evaluation.lips.closures import closures
from kouxing.evaluation.lips.curve_tables import fap_conversion, read_table, read_tables
from kouxing.evaluation.lips.live_faces import FRAME_RATE_HZ
from kouxing.evaluation.lips.mouths import predicted_mouth, real_faps, real_mouth
from kouxing.evaluation.lips.other_programs import load_program_faps, load_programs
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import MOUTH_FAPS

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


def write_table(path: Path, columns: dict[str, NDArray[np.float64]]) -> None:
    rows = np.stack([*columns.values()], axis=1)
    lines = [",".join(columns), *(",".join(f"{cell:.5f}" for cell in row) for row in rows)]
    path.write_text("\n".join(lines))


def late_opening() -> dict[str, NDArray[np.float64]]:
    """Return the opening in a unit of its own, made 0.1 s after its audio."""
    known_s = np.arange(900) / 100.0
    mouth = real_mouth(HELD_OUT.time_s, real_faps(HELD_OUT))
    return {"t": known_s, "opening": 0.02 * mouth.at("opening", known_s - LATE_S) + 0.5}


def test_an_opening_is_scored_at_its_own_delay(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    folder.mkdir()
    for clip in (HELD_OUT, TRAINING):
        write_table(folder / f"{clip.name}.csv", late_opening())
    programs = load_programs([folder], [HELD_OUT], [TRAINING])
    shipped, fitted = programs
    assert shipped == "mine, 100 ms"
    assert fitted.startswith("mine, fitted, ")
    real = real_mouth(HELD_OUT.time_s, real_faps(HELD_OUT))
    for mouth_of in programs.values():
        mouth = mouth_of(HELD_OUT)
        correlation = moments([(mouth, real)], "opening").correlation
        assert correlation is not None
        assert correlation > 0.99
        assert closures(mouth, real).f1 == pytest.approx(1.0)


def test_the_faps_of_a_program_are_at_its_best_delay(tmp_path: Path) -> None:
    write_table(tmp_path / "held_1.csv", late_opening())
    real = real_mouth(HELD_OUT.time_s, real_faps(HELD_OUT))
    mouth = predicted_mouth(
        load_program_faps(tmp_path, [HELD_OUT])(HELD_OUT, np.arange(430) / FRAME_RATE_HZ)
    )
    correlation = moments([(mouth, real)], "opening").correlation
    assert correlation is not None
    assert correlation > 0.99
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
