"""Commands find the running system of their user."""

import errno
import fcntl
import os
from contextlib import ExitStack
from pathlib import Path

import pytest
from kouxing_client import NotConnected
from kouxing_client.connection_check import NO_LISTENER

from kouxing.services.cli.system.running_system import (
    announce_system,
    lock_output_folder,
    lock_startup,
    newest_control_endpoint,
    open_control_address,
)
from kouxing.shared.errors import UserError
from kouxing.shared.settings.keys import load_user_key


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("KOUXING_CONTROL", raising=False)


def test_finds_the_newest_running_system_even_if_others_were_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert newest_control_endpoint() == ""
    with ExitStack() as stack:
        for number in (1, 2):
            monkeypatch.setattr(os, "getpid", lambda number=number: number)
            stack.enter_context(announce_system(f"tcp://127.0.0.1:{number}"))
            (folder,) = tmp_path.iterdir()
            os.utime(folder / str(number), (number, number))
        assert newest_control_endpoint() == "tcp://127.0.0.1:2"
        killed = folder / "3"  # nobody holds its lock
        killed.write_text("tcp://127.0.0.1:3", encoding="utf-8")
        assert newest_control_endpoint() == "tcp://127.0.0.1:2"
        assert not killed.exists()
    assert newest_control_endpoint() == ""


def test_a_system_that_ends_during_the_search_is_not_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with announce_system("tcp://127.0.0.1:1"):
        (folder,) = tmp_path.iterdir()
        paths = [*folder.iterdir(), folder / "2"]  # the second one has just been removed
        monkeypatch.setattr(Path, "iterdir", lambda _: iter(paths))
        assert newest_control_endpoint() == "tcp://127.0.0.1:1"


def test_a_search_does_not_hide_a_system_that_is_starting(monkeypatch: pytest.MonkeyPatch) -> None:
    lock = fcntl.flock

    def search_before_lock(file: int, operation: int) -> None:
        if operation == fcntl.LOCK_EX:
            newest_control_endpoint()
        lock(file, operation)

    monkeypatch.setattr(fcntl, "flock", search_before_lock)
    with announce_system("tcp://127.0.0.1:1"):
        assert newest_control_endpoint() == "tcp://127.0.0.1:1"


def control_address(address: str) -> str:
    with open_control_address(address) as endpoint:
        return endpoint


def test_finds_no_system_with_other_keys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own_state = os.environ["XDG_STATE_HOME"]
    others = tmp_path / "others"
    with announce_system("tcp://127.0.0.1:1 own"), ExitStack() as stack:
        monkeypatch.setenv("XDG_STATE_HOME", str(others))
        monkeypatch.setattr(os, "getpid", lambda: 1)
        stack.enter_context(announce_system("tcp://127.0.0.1:5550 other"))
        assert control_address("") == "tcp://127.0.0.1:5550 other"
        monkeypatch.setenv("XDG_STATE_HOME", own_state)
        assert control_address("") == "tcp://127.0.0.1:1 own"
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "third"))
        text = (
            "kouxing is not running on this machine for this user; start it with 'kouxing run'. A"
            rf" system with other keys runs at .*tcp://127.0.0.1:5550 \(keys: {others}/kouxing\)"
            ".*XDG_STATE_HOME.*--control or KOUXING_CONTROL"
        )
        with pytest.raises(UserError, match=text):
            control_address("")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("", r"kouxing is not running .*, or set --control .*\. Tried: no answer"),
        ("tcp://127.0.0.1:5550", "^no answer"),
    ],
)
def test_says_that_no_system_runs_unless_the_user_gave_its_address(
    address: str, message: str
) -> None:
    with pytest.raises(UserError, match=message), open_control_address(address):
        raise UserError("no answer") from NotConnected("no answer")


def test_says_only_once_how_to_start_a_system() -> None:
    with (
        pytest.raises(UserError, match=r"Tried: tcp://127\.0\.0\.1:5550$"),
        open_control_address(""),
    ):
        raise UserError(f"no answer: {NO_LISTENER}") from NotConnected("no answer")


def test_a_given_address_overrides_the_running_system(monkeypatch: pytest.MonkeyPatch) -> None:
    with announce_system("tcp://127.0.0.1:1"):
        assert control_address("") == "tcp://127.0.0.1:1"
        key = load_user_key().control
        assert control_address("tcp://127.0.0.1:4") == f"tcp://127.0.0.1:4 {key}"
        monkeypatch.setenv("KOUXING_CONTROL", "tcp://127.0.0.1:5")
        assert control_address("") == f"tcp://127.0.0.1:5 {key}"
        monkeypatch.setenv("KOUXING_INSECURE", "true")
        assert control_address("") == "tcp://127.0.0.1:5"
    with pytest.raises(UserError, match="--control: 'localhost' is not an endpoint"):
        control_address("localhost")


def test_ignores_a_folder_that_others_can_write_to(tmp_path: Path) -> None:
    with announce_system("tcp://127.0.0.1:1"):
        (folder,) = tmp_path.iterdir()
        folder.chmod(0o777)
        assert newest_control_endpoint() == ""


def test_a_second_start_waits_for_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    operations: list[int] = []

    def flock(_descriptor: int, operation: int) -> None:
        operations.append(operation)
        if operation & fcntl.LOCK_NB:
            raise BlockingIOError

    monkeypatch.setattr(fcntl, "flock", flock)
    waits: list[str] = []
    with lock_startup(lambda: waits.append("waits")):
        assert operations == [fcntl.LOCK_EX | fcntl.LOCK_NB, fcntl.LOCK_EX]
    assert waits == ["waits"]


def test_a_system_that_cannot_be_announced_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as full_disk:
        full_disk.setattr(Path, "open", fail)
        with announce_system("tcp://127.0.0.1:1"):
            pass
    assert newest_control_endpoint() == ""


def test_two_systems_do_not_share_a_folder(tmp_path: Path) -> None:
    folder = tmp_path / "my" / "out"
    with lock_output_folder(folder):
        with lock_output_folder(tmp_path / "other"):
            pass
        with (
            pytest.raises(UserError, match=r"my/out: another kouxing writes .* driver.out=FOLDER"),
            lock_output_folder(folder),
        ):
            pass
    with lock_output_folder(folder):
        pass
