"""The setup of a process: its priority, and the folder of compiled functions."""

import os
from pathlib import Path

import pytest

import kouxing
from kouxing.shared.service import priority


@pytest.mark.parametrize("leads_session", [False, True])
def test_raises_the_session_only_if_the_process_leads_it(
    leads_session: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_arguments: int) -> None:
        raise PermissionError

    autogroup = tmp_path / "autogroup"
    monkeypatch.setattr(os, "setpriority", refuse)
    monkeypatch.setattr(os, "getsid", lambda _: os.getpid() if leads_session else 1)
    monkeypatch.setattr(priority, "AUTOGROUP", autogroup)
    priority.raise_priority()
    assert autogroup.exists() == leads_session
    monkeypatch.setattr(priority, "AUTOGROUP", tmp_path / "none" / "autogroup")
    priority.raise_priority()


def test_compiles_into_a_temporary_folder_if_no_other_is_writable(
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
