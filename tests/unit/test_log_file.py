"""Logs are private, limited, free of tokens, and never raise."""

from __future__ import annotations

import stat
from pathlib import Path

from kouxing.services.cli.log_file import LogFile


def test_a_log_is_private_and_has_no_token(tmp_path: Path) -> None:
    path = tmp_path / "gateway.log"
    path.touch(mode=0o644)
    log = LogFile(path, print)
    log.write(b'{"page": "http://127.0.0.1:8080/#token=secret"}\n')
    log.close()
    assert path.read_text() == '{"page": "http://127.0.0.1:8080/#token=..."}\n'
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_full_log_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "control.log"
    log = LogFile(path, print, max_bytes=10)
    for line in (b"one two three\n", b"four\n"):
        log.write(line)
    log.close()
    assert path.read_text() == "four\n"
    assert (tmp_path / "control.log.1").read_text() == "one two three\n"


def test_a_full_disk_is_reported_once_and_costs_only_lines(tmp_path: Path) -> None:
    path, warnings = tmp_path / "driver.log", list[str]()
    log = LogFile(path, warnings.append)
    path.mkdir()
    for _ in range(3):
        log.write(b"lost\n")
    path.rmdir()
    log.write(b"kept\n")
    log.close()
    assert path.read_text() == "kept\n"
    assert warnings == [
        f"{path}: cannot be written: Is a directory",
        f"{path}: 3 lines were dropped",
    ]
