"""Log lines name their session; log files are private, limited and free of tokens."""

import json
import logging
import os
import resource
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from kouxing.services.cli.launch.log_file import LogFile
from kouxing.services.process import run_service
from kouxing.shared.monitoring.logs import LOG, configure


class Crashing:
    current_session = "second"

    def startup(self) -> None:
        pass

    def run(self) -> None:
        LOG.warning("dropped", extra={"session": "first"})
        raise ZeroDivisionError


@pytest.fixture(autouse=True)
def restore_log() -> Iterator[None]:
    handlers, level, propagate = LOG.handlers[:], LOG.level, LOG.propagate
    yield
    LOG.handlers[:], LOG.propagate = handlers, propagate
    LOG.setLevel(level or logging.NOTSET)


def test_warnings_and_a_crash_name_the_session(capsys: pytest.CaptureFixture[str]) -> None:
    make: Any = Crashing
    assert run_service(make, "failing", "info") == 1
    first, second = map(json.loads, capsys.readouterr().err.splitlines())
    assert (first["level"], first["session"], first["message"]) == ("warning", "first", "dropped")
    assert (second["level"], second["session"]) == ("critical", "second")
    assert "ZeroDivisionError" in second["traceback"]
    assert first["service"] == second["service"] == "failing"
    configure("quiet", "warning")
    LOG.info("ready")
    assert capsys.readouterr().err == ""


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


def test_a_full_disk_is_reported_once_and_drops_only_whole_lines(tmp_path: Path) -> None:
    path, warnings = tmp_path / "driver.log", list[str]()
    log = LogFile(path, warnings.append)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20, before[1]))
    try:
        for _ in range(3):
            log.write(b"fifteen letters\n")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    log.write(b"kept\n")
    log.close()
    assert path.read_text() == "fifteen letters\nkept\n"
    assert warnings == [
        f"cannot write {path}: the disk is full; free some space",
        f"{path}: 2 lines were dropped",
    ]


@pytest.mark.parametrize("make", [os.mkfifo, Path.mkdir, lambda path: path.symlink_to("x")])
def test_only_a_regular_file_is_a_log(tmp_path: Path, make: Callable[[Path], None]) -> None:
    make(tmp_path / "driver.log")
    warnings: list[str] = []
    log = LogFile(tmp_path / "driver.log", warnings.append)
    log.write(b"lost\n")
    assert "it is not a regular file" in warnings[0]
    with pytest.raises(OSError, match="it is not a regular file"):
        log.check()


def test_a_deleted_log_is_created_again_and_an_unreplaceable_one_stops(tmp_path: Path) -> None:
    path, warnings = tmp_path / "driver.log", list[str]()
    log = LogFile(path, warnings.append, max_bytes=10)
    log.write(b"one two three\n")
    path.unlink()
    log.write(b"four five six\n")
    (tmp_path / "driver.log.1").mkdir()
    for _ in range(3):
        log.write(b"seven\n")
    assert path.read_text() == "four five six\n"
    assert len(warnings) == 1
