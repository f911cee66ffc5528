"""What the console of ``kouxing run`` shows of a service's log."""

import io
import json
from pathlib import Path

import pytest
from rich.console import Console

from kouxing.services.cli.launch.supervisor import Supervisor, _console_text, _Service


@pytest.mark.parametrize(
    ("entry", "text"),
    [
        ({"level": "info", "message": "opened", "session": "s1"}, ""),
        ({"level": "warning", "message": "slow"}, "slow"),
        ({"level": "warning", "message": "slow", "session": "s1"}, "session 's1': slow"),
        ({"level": "warning", "message": "'s1' is slow", "session": "s1"}, "'s1' is slow"),
    ],
)
def test_a_warning_names_its_session(entry: dict[str, str], text: str) -> None:
    assert _console_text(json.dumps(entry).encode()) == text


def test_other_text_is_shown_as_it_is() -> None:
    assert _console_text(b"Segmentation fault\n") == "Segmentation fault"


def test_a_long_warning_is_one_line(tmp_path: Path) -> None:
    output = io.StringIO()
    supervisor = Supervisor([], tmp_path, Console(file=output, width=40), services=())
    supervisor._warn("turn the receiver on, " * 5)
    assert len(output.getvalue().splitlines()) == 1


def test_the_log_is_shown_and_an_error_in_the_configuration_is_kept(tmp_path: Path) -> None:
    output = io.StringIO()
    supervisor = Supervisor([], tmp_path, Console(file=output), services=())
    service = _Service("gateway", tmp_path / "gateway.log", {})
    expired = json.dumps({"level": "warning", "message": "gateway.https: k.pem is expired"})
    supervisor._copy_log(service, io.BytesIO(expired.encode() + b"\n"))
    assert output.getvalue() == "gateway.https: k.pem is expired\n"
    assert service.error == ""
    supervisor._copy_log(service, io.BytesIO(b"gateway.port: 0 is too small\n"))
    assert output.getvalue().count("\n") == 1
    assert service.error == "gateway.port: 0 is too small"
