"""Figures of a face's motion."""

from pathlib import Path

import numpy as np
import pytest
import soundfile

from kouxing.corpora.emotions import read_emotions
from kouxing.evaluation import face_motion
from kouxing.evaluation.face_motion import measure_face
from kouxing.services.recognizer.acoustic.load import load_model
from kouxing.shared.errors import UserError
from tests.corpora import write_manifest
from tests.system import VOWELS_FILE

COLUMNS = "path speaker license seconds note phones_path"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with one speaker's calm vowels, and louder and higher ones."""
    samples, rate_hz = soundfile.read(VOWELS_FILE, dtype="float32")
    rows = []
    for name, gain, pitch, emotion in (
        ("calm", 0.1, 1.0, "boredom"),
        ("loud", 0.9, 1.4, "anger"),
        ("x", 0.3, 1.0, ""),
    ):
        vowels = gain * samples[: int(pitch * 40_000)]
        soundfile.write(tmp_path / f"{name}.wav", vowels, int(pitch * rate_hz))
        note = emotion and f"emotion {emotion}"
        rows.append(f"{name}.wav\tann\tCC0\t2.5\t{note}\tphones.tsv")
    write_manifest(tmp_path, COLUMNS, rows)
    (tmp_path / "phones.tsv").write_text(
        "start_s\tmarks\n0.5\t2\n0.9\t+sth\n1.5\t+sth,3\n", encoding="utf-8"
    )
    return tmp_path


@pytest.mark.slow
def test_a_moving_face_has_all_figures(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(face_motion, "_REST_S", 4.0)
    figures = measure_face(load_model("light"), read_emotions(folder))
    assert set(figures.correlations) > {"arousal", "valence"}
    assert figures.still_at_rest < 0.5
    assert figures.longest_still_s < 2.0
    assert 0.0 < (figures.chance or 0.0) < 0.5


def test_movements_match_the_stressed_vowels_that_they_follow() -> None:
    faps = np.zeros((200, 68), np.float32)
    session = face_motion._Session(faps, [(0.0, 2.0)], [(0.0, 0.0)], np.array([0.5, 1.5]))
    nods = face_motion._movement_stats(
        [np.array([0.2, 0.7, 1.4, 1.75, 2.4])], [session], minutes=0.5
    )
    assert (nods.per_minute, nods.matched) == (10.0, 0.5)
    assert nods.at_end == pytest.approx(0.2)
    silent = face_motion._Session(faps, [(0.0, 2.0)], [(0.0, 0.0)], np.array([]))
    assert face_motion._movement_stats([np.array([1.0])], [silent], minutes=1.0).matched is None


def test_reads_emotions_and_rejects_a_folder_without(folder: Path) -> None:
    calm, loud, other = read_emotions(folder, any_license=False)
    assert (calm.emotion, loud.emotion, other.emotion) == ("boredom", "anger", None)
    assert calm.stressed_s == (0.5, 1.5)
    (folder / "bad.tsv").write_text("start_s\tmarks\n0,5\t1\n")
    for columns, row, problem in (
        (COLUMNS, "calm.wav\tann\tCC0\t2.5\tcalm\t", "names no emotion"),
        ("path speaker", "calm.wav\tann", "lacks the columns license, seconds, note; it has "),
        (COLUMNS, "calm.wav\tann\tCC0\tlong\temotion fear\t", "write the seconds as a number"),
        (COLUMNS, "calm.wav\tann\tCC0\t2.5\temotion joy\t", "'joy' is unknown; use anger"),
        (COLUMNS, "calm.wav\tann\tCC0\t2.5\temotion fear\tbad.tsv", "bad.tsv: could not convert"),
    ):
        write_manifest(folder, columns, [row])
        with pytest.raises(UserError, match=problem):
            read_emotions(folder)
