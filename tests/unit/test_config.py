"""Configuration: which source counts, what is refused, and what an error says."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from kouxing.services.control.config import ControlConfig
from kouxing.services.driver.config import DriverConfig, Framing
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.kinds import KINDS, free_addresses
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.config import ServiceConfig, Settings
from kouxing.shared.errors import UserError
from tests.documents import code_blocks

pytestmark = pytest.mark.unit


def settings(file: Path | None = None, environment: dict[str, str] | None = None) -> Settings:
    types = {kind.name: kind.config_type for kind in KINDS.values()}
    return Settings(types, file=file, environment=environment or {})


def written(folder: Path, text: str) -> Path:
    path = folder / "kouxing.toml"
    path.write_text(text, encoding="utf-8")
    return path


CONFIG_TYPES = [ServiceConfig, *(kind.config_type for kind in KINDS.values())]


@pytest.mark.parametrize("config_type", CONFIG_TYPES)
def test_defaults_are_allowed(config_type: type[ServiceConfig]) -> None:
    defaults = settings().load(config_type)
    texts = {key: str(value) for key, value in defaults}
    assert settings().load(config_type, texts) == defaults


@pytest.mark.parametrize("config_type", CONFIG_TYPES)
def test_every_key_says_what_it_means_and_takes(config_type: type[ServiceConfig]) -> None:
    for each in settings().describe(config_type):
        assert each.meaning.endswith("."), each.key
        assert each.allowed, each.key


def test_file_is_weaker_than_environment_is_weaker_than_command_line(tmp_path: Path) -> None:
    file = written(tmp_path, "[recognizer]\nnum_stable_frames = 2\n[common]\nlog_level = 'debug'\n")
    from_file = settings(file).load(RecognizerConfig)
    assert (from_file.num_stable_frames, from_file.log_level) == (2, "debug")
    environment = {
        "KOUXING_RECOGNIZER_NUM_STABLE_FRAMES": "4",
        "KOUXING_CONTROL": "tcp://10.0.0.1:5550",
    }
    both = settings(file, environment).load(RecognizerConfig)
    assert (both.num_stable_frames, both.control) == (4, "tcp://10.0.0.1:5550")
    all_three = settings(file, environment).load(RecognizerConfig, {"num_stable_frames": "5"})
    assert all_three.num_stable_frames == 5


def test_a_list_in_a_file_is_its_items_separated_by_spaces(tmp_path: Path) -> None:
    file = written(tmp_path, '[gateway]\nsenders = ["vmc://", "vts://?delay=120"]\n')
    assert settings(file).load(GatewayConfig).senders == "vmc:// vts://?delay=120"


def test_assignments_are_stronger_than_the_environment() -> None:
    types = {kind.name: kind.config_type for kind in KINDS.values()}
    environment = {"KOUXING_RECOGNIZER_NUM_STABLE_FRAMES": "4", "KOUXING_GATEWAY_PORT": "1"}
    given = {"recognizer.num_stable_frames": "5", "common.log_level": "error"}
    both = Settings(types, environment=environment, assignments=given)
    assert both.load(RecognizerConfig).num_stable_frames == 5
    assert (both.load(GatewayConfig).port, both.load(GatewayConfig).log_level) == (1, "error")
    with pytest.raises(UserError, match=r"--set recognizer.acustic: .* recognizer.acoustic;"):
        Settings(types, environment={}, assignments={"recognizer.acustic": "gmm"})


def test_one_service_is_stronger_than_all_services(tmp_path: Path) -> None:
    file = written(tmp_path, "[recognizer]\nlog_level = 'debug'\n[common]\nlog_level = 'error'\n")
    assert settings(file).load(RecognizerConfig).log_level == "debug"
    assert settings(file).load(ControlConfig).log_level == "error"
    environment = {"KOUXING_RECOGNIZER_LOG_LEVEL": "DEBUG", "KOUXING_LOG_LEVEL": "error"}
    assert settings(environment=environment).load(RecognizerConfig).log_level == "debug"
    assert settings(environment=environment).load(ControlConfig).log_level == "error"


def test_every_value_tells_where_it_came_from(tmp_path: Path) -> None:
    file = written(tmp_path, "[driver]\ncamera = 'mouth'\nwidth_px = 640\nvirtual_camera = true\n")
    environment = {"KOUXING_DRIVER_WIDTH_PX": "320", "KOUXING_LOG_LEVEL": "error"}
    found = settings(file, environment).describe(DriverConfig, {"out": "films"})
    given = {each.key: (each.value, each.origin) for each in found if each.origin != "default"}
    assert given == {
        "camera": (Framing.MOUTH, str(file)),
        "virtual_camera": (True, str(file)),
        "width_px": (320, "$KOUXING_DRIVER_WIDTH_PX"),
        "log_level": ("error", "$KOUXING_LOG_LEVEL"),
        "out": ("films", "--set"),
    }


@pytest.mark.parametrize(
    ("config_type", "key", "text", "said"),
    [
        (RecognizerConfig, "num_stable_frames", "many", "a whole number from 1 to 20"),
        (RecognizerConfig, "num_stable_frames", "0", "a whole number from 1 to 20"),
        (RecognizerConfig, "num_stable_frames", "2.9", "a whole number from 1 to 20"),
        (RecognizerConfig, "advertise", "tcp://here", "a host name or address"),
        (RecognizerConfig, "audio", "5560", "an endpoint, tcp://HOST:PORT"),
        (RecognizerConfig, "audio", "tcp://127.0.0.1:99999", "an endpoint, tcp://HOST:PORT"),
        (RecognizerConfig, "control", "here", "an endpoint, tcp://HOST:PORT"),
        (RecognizerConfig, "insecure", "perhaps", "true or false"),
        (RecognizerConfig, "insecure", "yes", "true or false"),
        (SynthesizerConfig, "delay_ms", "900", "a number from 0 to 300"),
        (SynthesizerConfig, "frame_rate_hz", "nan", "a number from 10 to 240"),
        (DriverConfig, "view", "hologram", "one of auto, window, none"),
        (
            DriverConfig,
            "session",
            "a/b",
            "newest, or the name of a session (up to 64 letters, digits, '-' and '_')",
        ),
        (DriverConfig, "camera", "foot", "one of face, head, mouth"),
        (DriverConfig, "width_px", "641", "a multiple of 2 from 16 to 7680"),
        (GatewayConfig, "port", "65536", "a whole number from 0 to 65535"),
        (ControlConfig, "log_level", "loud", "one of debug, info, warning, error"),
    ],
)
def test_an_error_names_key_value_origin_and_what_is_allowed(
    config_type: type[ServiceConfig], key: str, text: str, said: str
) -> None:
    section = config_type.__name__.removesuffix("Config").lower()
    with pytest.raises(UserError) as error:
        settings().load(config_type, {key: text})
    assert str(error.value) == f"{section}.{key}: {text!r} (from --set) is not {said}"


@pytest.mark.parametrize(
    ("config_type", "key", "text", "named"),
    [
        (GatewayConfig, "host", "0.0.0.0", "gateway.host: 0.0.0.0"),  # noqa: S104
        (RecognizerConfig, "min_confidenc", "1", "the nearest is min_confidence"),
    ],
)
def test_addresses_and_names_are_checked(
    config_type: type[ServiceConfig], key: str, text: str, named: str
) -> None:
    with pytest.raises(UserError, match=named):
        settings().load(config_type, {key: text})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("num_stable_frames =", "Invalid value"),
        ("[recogniser]\n", r"unknown table \[recogniser\]; the nearest is recognizer"),
        ("common = 1\n", r"unknown table \[common\]"),
        ("[recognizer]\nspeed = 1\n", "unknown key recognizer.speed; the nearest is recognizer."),
        ("[common]\nmin_confidence = 1\n", "the nearest is recognizer.min_confidence"),
        ("[synthesizer]\nlook_ahead_ms = 60\n", "the nearest is synthesizer.delay_ms"),
        ("[client]\n", "unknown table"),
        ("[driver]\nout = ['a']\n", "driver.out: .* is not text"),
        ("[driver]\nwidth_px = true\n", "driver.width_px: 'true'"),
        (
            "[recognizer]\nnum_stable_frames = 2.9\n",
            r"num_stable_frames: '2.9' \(from .*kouxing.toml",
        ),
    ],
)
def test_what_a_file_gets_wrong_is_named(tmp_path: Path, text: str, said: str) -> None:
    file = written(tmp_path, text)
    config_type = DriverConfig if "driver" in text else RecognizerConfig
    with pytest.raises(UserError, match=said) as error:
        settings(file).load(config_type)
    assert "kouxing.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere"):
        settings(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("KOUXING_LOOK_AHEAD_MS", "KOUXING_RECOGNIZER_LOOK_AHEAD_MS"),
        ("KOUXING_PHONES", "KOUXING_RECOGNIZER_PHONES"),
        ("KOUXING_HEAD", "KOUXING_DRIVER_HEAD"),
        ("KOUXING_CONTROLL", "KOUXING_CONTROL"),
        ("KOUXING_SYNTHESIZER_DELAY", "KOUXING_SYNTHESIZER_DELAY_MS"),
    ],
)
def test_an_unknown_variable_is_an_error_that_names_the_nearest(name: str, nearest: str) -> None:
    with pytest.raises(UserError, match=rf"\${name}: .* the nearest is {nearest};"):
        settings(environment={name: "1"})


@pytest.mark.parametrize("name", ["docker-compose.yml", "docs/hosts.md"])
def test_the_variables_in_documents_are_known(name: str) -> None:
    text = (Path(__file__).parents[2] / name).read_text(encoding="utf-8")
    names = re.findall(r"KOUXING_\w+", text)
    assert names
    settings(environment=dict.fromkeys(names, ""))


def test_the_one_file_for_all_hosts_is_understood(tmp_path: Path) -> None:
    (text,) = code_blocks(Path(__file__).parents[2] / "docs" / "hosts.md", "toml")
    given = settings(written(tmp_path, text))
    control = given.load(ControlConfig)
    assert control.reachable(control.commands) == given.load(RecognizerConfig).control


def test_no_variable_sets_two_keys_of_a_service_kind() -> None:
    names = [
        f"{kind.name}_{key}".upper()
        for kind in KINDS.values()
        for key in kind.config_type.model_fields
    ]
    common = [key.upper() for key in ServiceConfig.model_fields]
    assert len({*names, *common}) == len(names) + len(common)


def test_a_proxy_may_encrypt_the_page() -> None:
    wildcard = "0.0.0.0"  # noqa: S104
    given = {"host": wildcard, "plain_http": "true"}
    assert settings().load(GatewayConfig, given).host == wildcard


def test_what_is_bound_to_every_address_is_told_by_the_advertised_one() -> None:
    environment = {"KOUXING_ADVERTISE": "face-host"}
    config = settings(environment=environment).load(
        SynthesizerConfig, {"faps": "tcp://0.0.0.0:5571"}
    )
    assert config.reachable(config.faps) == "tcp://face-host:5571"


@pytest.mark.parametrize(
    ("advertise", "bound", "told"),
    [
        ("203.0.113.7", "tcp://10.0.0.2:5571", "tcp://203.0.113.7:5571"),  # behind NAT
        ("fd00::7", "tcp://0.0.0.0:5571", "tcp://[fd00::7]:5571"),
        ("", "tcp://10.0.0.2:5571", "tcp://10.0.0.2:5571"),
    ],
)
def test_the_advertised_address_is_known_or_told(advertise: str, bound: str, told: str) -> None:
    synthesizer = SynthesizerConfig(advertise=advertise, control="tcp://127.0.0.9:5550")
    assert synthesizer.reachable(bound) == told


def test_control_is_found_where_everybody_looks_for_it() -> None:
    environment = {"KOUXING_CONTROL": "tcp://face.example:5550"}
    control = settings(environment=environment).load(ControlConfig)
    assert control.reachable("tcp://0.0.0.0:5551") == "tcp://face.example:5551"
    assert control.reachable("tcp://10.0.0.1:5551") == "tcp://10.0.0.1:5551"


def test_free_addresses_cover_every_key_that_binds() -> None:
    addresses = free_addresses(hosts={"synthesizer": "127.0.0.3"})
    assert addresses["KOUXING_CONTROL"] == addresses["KOUXING_CONTROL_COMMANDS"]
    loaded = settings(environment=addresses)
    synthesizer, gateway = loaded.load(SynthesizerConfig), loaded.load(GatewayConfig)
    assert synthesizer.phone_input.startswith("tcp://127.0.0.3:")
    assert gateway.port != GatewayConfig().port
    assert len(set(addresses.values())) == len(addresses) - 1
