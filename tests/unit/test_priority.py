"""A service requests a higher priority, and continues without it."""

import os
from pathlib import Path

import pytest

from kouxing.shared import priority


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
