"""``kouxing config``: what it prints is a file that gives the same configuration."""

from __future__ import annotations

from pathlib import Path

import pytest

from kouxing.services.cli.configuration import TABLES, config, markdown_page
from kouxing.services.kinds import read_settings
from kouxing.shared.errors import UserError

pytestmark = pytest.mark.unit

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


def test_the_page_in_the_docs_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == markdown_page(), (
        "run: kouxing config --markdown > docs/configuration.md"
    )


def test_the_output_is_a_file_that_gives_the_same_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KOUXING_DRIVER_VIRTUAL_CAMERA", "true")
    monkeypatch.setenv("KOUXING_RECOGNIZER_LOG_LEVEL", "debug")
    file = tmp_path / "first.toml"
    file.write_text("[driver]\nout = 'a \"b\" 口'\n[gateway]\nport = 0\n", encoding="utf-8")
    wanted = [read_settings(file).load(config_type) for config_type in TABLES.values()]
    config(config=file)
    printed = capsys.readouterr().out
    assert f"port = 0  # {file}" in printed
    assert "virtual_camera = true  # $KOUXING_DRIVER_VIRTUAL_CAMERA" in printed
    assert "default 8080." in printed
    monkeypatch.undo()
    file.write_text(printed, encoding="utf-8")
    assert [read_settings(file).load(each) for each in TABLES.values()] == wanted


def test_one_service_is_printed_with_what_the_command_line_sets(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config("recognizer", assignments=["min_confidence=0.5"])
    printed = capsys.readouterr().out
    assert "min_confidence = 0.5  # --set" in printed
    assert 'log_level = "info"  # default' in printed
    assert "[driver]" not in printed


def test_what_cannot_be_printed_is_named() -> None:
    with pytest.raises(UserError, match="one of common, control"):
        config("listener")
    with pytest.raises(UserError, match=r"--set port: .* nearest is gateway.port"):
        config(assignments=["port=1"])


def test_all_services_are_printed_with_what_the_command_line_sets(
    capsys: pytest.CaptureFixture[str],
) -> None:
    config(assignments=["gateway.port=1"])
    assert "port = 1  # --set" in capsys.readouterr().out
