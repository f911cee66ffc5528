from pathlib import Path

import numpy as np
import pytest

from services.recognizer.load import load_model
from services.recognizer.model_file import (
    read_archive,
    topology_arrays,
    topology_from,
    write_archive,
)
from shared.phones import UNIT_INDEX
from training.unit_trigram import unit_trigram

pytestmark = pytest.mark.unit

SIL, T, Y, A, SH, U, B = (UNIT_INDEX[unit] for unit in ("sil", "t", "i", "a", "sh", "u", "b"))


def test_what_follows_two_units_is_what_followed_them_most() -> None:
    likely = np.exp(unit_trigram([[T, Y, SH, U], [T, A, B, A], [B, Y, T, A]] * 20))
    np.testing.assert_allclose(likely.sum(axis=2), 1, atol=0.02)
    assert likely[T, Y, SH] > 0.7
    assert likely[B, Y, SH] < 0.1  # though it comes after i, too
    assert likely[SH, Y, T] == pytest.approx(likely[U, Y, T], rel=0.02)  # never seen: as after i
    assert likely[SIL, SIL, T] == pytest.approx(2 / 3, abs=0.05)


def test_pauses_come_after_finals_and_begin_anew() -> None:
    likely = np.exp(unit_trigram([[T, Y, SH, U]] * 20, pause_share=0.1))
    assert likely[T, Y, SIL] == pytest.approx(0.1, abs=0.02)
    assert likely[Y, SH, SIL] < 0.01
    np.testing.assert_array_equal(likely[Y, SIL], likely[SIL, SIL])


def test_a_model_file_keeps_it(tmp_path: Path) -> None:
    arrays = topology_arrays(load_model().topology)
    arrays["log_bigram"] = unit_trigram([[T, Y, SH, U]])
    write_archive(tmp_path / "model.npz", arrays)
    found = topology_from(read_archive(tmp_path / "model.npz")).log_bigram
    np.testing.assert_array_equal(found, arrays["log_bigram"])
    arrays["log_bigram"] = arrays["log_bigram"][:1]
    write_archive(tmp_path / "model.npz", arrays)
    with pytest.raises(ValueError, match="log_bigram has shape"):
        topology_from(read_archive(tmp_path / "model.npz"))
