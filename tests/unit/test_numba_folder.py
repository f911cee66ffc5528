"""Compiled functions need a folder, also where nothing can be written."""

import os
from pathlib import Path

import pytest

import kouxing


def test_compiled_functions_go_to_a_temporary_folder_if_no_other_can_be_written(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    kouxing._choose_numba_folder()
    assert "NUMBA_CACHE_DIR" not in os.environ, "numba chooses the folder"
    monkeypatch.setattr(os, "access", lambda *_: False)
    kouxing._choose_numba_folder()
    folder = Path(os.environ["NUMBA_CACHE_DIR"])
    assert folder.stat().st_mode & 0o777 == 0o700
