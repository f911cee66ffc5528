from __future__ import annotations

from pathlib import Path

import pytest

from shared.config import ControlConfig, RecognizerConfig, SynthesizerConfig, load, reachable
from shared.errors import UserError

pytestmark = pytest.mark.unit


def written(folder: Path, text: str) -> Path:
    path = folder / "kouxing.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_defaults_are_loopback() -> None:
    config = load("control", environment={})
    assert isinstance(config, ControlConfig)
    assert config.commands == "tcp://127.0.0.1:5550"


def test_file_is_weaker_than_environment_is_weaker_than_command_line(tmp_path: Path) -> None:
    file = written(tmp_path, "[recognizer]\nagreement = 2\n[common]\nlog_level = 'debug'\n")
    from_file = load("recognizer", file=file, environment={})
    assert isinstance(from_file, RecognizerConfig)
    assert (from_file.agreement, from_file.log_level) == (2, "debug")
    environment = {"KOUXING_RECOGNIZER_AGREEMENT": "4", "KOUXING_CONTROL": "tcp://10.0.0.1:5550"}
    both = load("recognizer", file=file, environment=environment)
    assert isinstance(both, RecognizerConfig)
    assert (both.agreement, both.control) == (4, "tcp://10.0.0.1:5550")
    all_three = load("recognizer", file=file, environment=environment, overrides={"agreement": "5"})
    assert isinstance(all_three, RecognizerConfig)
    assert all_three.agreement == 5


@pytest.mark.parametrize(
    ("section", "overrides", "named"),
    [
        ("recognizer", {"agreement": "many"}, "recognizer.agreement"),
        ("recognizer", {"agreement": "0"}, "recognizer.agreement"),
        ("recognizer", {"speed": "1"}, "speed"),
        ("recognizer", {"audio": "5560"}, "recognizer.audio"),
        ("recognizer", {"audio": "tcp://127.0.0.1:99999"}, "recognizer.audio"),
        ("recognizer", {"audio": "tcp://192.168.1.5:5560"}, "recognizer.audio"),
        ("recognizer", {"audio": "tcp://0.0.0.0:5560"}, "recognizer.advertise"),
        ("recognizer", {"insecure": "perhaps"}, "recognizer.insecure"),
        ("synthesizer", {"look_ahead_ms": "900"}, "synthesizer.look_ahead_ms"),
        ("synthesizer", {"frame_rate_hz": "nan"}, "synthesizer.frame_rate_hz"),
        ("driver", {"view": "hologram"}, "driver.view"),
        ("gateway", {"host": "0.0.0.0"}, "gateway.host"),  # noqa: S104
        ("control", {"log_level": "loud"}, "control.log_level"),
    ],
)
def test_an_error_names_the_key(section: str, overrides: dict[str, str], named: str) -> None:
    with pytest.raises(UserError, match=named):
        load(section, overrides=overrides, environment={})


@pytest.mark.parametrize("text", ["[recogniser]\n", "[recognizer]\nspeed = 1\n", "agreement ="])
def test_an_unknown_key_or_bad_file_is_an_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(UserError, match=r"kouxing\.toml"):
        load("recognizer", file=written(tmp_path, text), environment={})


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere"):
        load("recognizer", file=tmp_path / "nowhere.toml", environment={})


def test_other_addresses_need_consent() -> None:
    environment = {"KOUXING_INSECURE": "true", "KOUXING_ADVERTISE": "face-host"}
    config = load(
        "synthesizer",
        environment=environment,
        overrides={"faps": "tcp://0.0.0.0:5571"},
    )
    assert isinstance(config, SynthesizerConfig)
    assert reachable(config.faps, config.advertise, "faps") == "tcp://face-host:5571"
