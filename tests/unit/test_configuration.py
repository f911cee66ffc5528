"""``kouxing config`` prints a file that gives the same configuration."""

from pathlib import Path

import pytest

from kouxing.services.cli.configuration import TABLES, config, markdown_page
from kouxing.services.kinds import read_settings
from kouxing.shared.errors import UserError

PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


def test_the_page_in_the_docs_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == markdown_page(), (
        "run: kouxing config --markdown > docs/configuration.md"
    )


def test_the_output_is_a_file_with_the_same_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KOUXING_DRIVER_VIRTUAL_CAMERA", "true")
    monkeypatch.setenv("KOUXING_RECOGNIZER_LOG_LEVEL", "debug")
    file = tmp_path / "first.toml"
    text = "[driver]\nout = 'a \"b\" 口'\n[gateway]\nport = 0\nsenders = ['vmc://']\n"
    file.write_text(text, encoding="utf-8")
    expected = [read_settings(file).load(config_type) for config_type in TABLES.values()]
    config("driver", config=file, assignments=["camera=mouth"])
    printed = capsys.readouterr().out
    assert "[gateway]" not in printed
    assert 'camera = "mouth"  # --set' in printed
    config(config=file)
    printed = capsys.readouterr().out
    assert f"port = 0  # {file}" in printed
    assert "virtual_camera = true  # $KOUXING_DRIVER_VIRTUAL_CAMERA" in printed
    assert "default 8080." in printed
    monkeypatch.undo()
    file.write_text(printed, encoding="utf-8")
    assert [read_settings(file).load(kind) for kind in TABLES.values()] == expected


def test_an_unknown_service_or_key_is_an_error() -> None:
    with pytest.raises(UserError, match="one of common, control"):
        config("listener")
    with pytest.raises(UserError, match=r"--set: .* key port; the nearest is gateway.port"):
        config(assignments=["port=1"])
