"""Configuration: priority of the sources, rejected values, and error messages."""

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
from kouxing.shared.config import ServiceConfig, Setting, Settings
from kouxing.shared.errors import UserError
from tests.documents import code_blocks

pytestmark = pytest.mark.unit
ROOT = Path(__file__).parents[2]
TYPES = {kind.name: kind.config_type for kind in KINDS.values()}
ANYWHERE = "0.0.0.0"  # noqa: S104


def settings(
    file: Path | None = None, environment: dict[str, str] | None = None, **assigned: str
) -> Settings:
    assignments = {name.replace("__", "."): text for name, text in assigned.items()}
    return Settings(TYPES, file=file, environment=environment or {}, assignments=assignments)


def write(folder: Path, text: str) -> Path:
    path = folder / "kouxing.toml"
    path.write_text(text, encoding="utf-8")
    return path


def setting(given: Settings, config_type: type[ServiceConfig], name: str) -> Setting:
    return next(item for item in given.describe(config_type) if item.key == name)


@pytest.mark.parametrize("config_type", [ServiceConfig, *TYPES.values()])
def test_every_default_is_allowed_and_every_key_is_described(
    config_type: type[ServiceConfig],
) -> None:
    described = settings().describe(config_type)
    texts = {item.key: item.text for item in described}
    assert settings().load(config_type, texts) == settings().load(config_type) == config_type()
    assert all(item.meaning.endswith(".") and item.allowed for item in described)


def test_sources_override_each_other_in_order(tmp_path: Path) -> None:
    file = write(tmp_path, "[recognizer]\nnum_stable_frames = 2\nlog_level = 'debug'\n")
    environment = {"KOUXING_RECOGNIZER_NUM_STABLE_FRAMES": "4"}
    assert settings(file).load(RecognizerConfig).num_stable_frames == 2
    assert settings(file, environment).load(RecognizerConfig).num_stable_frames == 4
    given = settings(file, environment, recognizer__num_stable_frames="5")
    assert given.load(RecognizerConfig).num_stable_frames == 5
    given_last = given.load(RecognizerConfig, {"num_stable_frames": "6"})
    assert (given_last.num_stable_frames, given_last.log_level) == (6, "debug")


def test_one_service_overrides_all_services(tmp_path: Path) -> None:
    file = write(tmp_path, "[recognizer]\nlog_level = 'debug'\n[common]\nlog_level = 'error'\n")
    environment = {"KOUXING_RECOGNIZER_LOG_LEVEL": "DEBUG", "KOUXING_LOG_LEVEL": "error"}
    for given in (settings(file), settings(environment=environment)):
        assert given.load(RecognizerConfig).log_level == "debug"
        assert given.load(ControlConfig).log_level == "error"


def test_a_list_is_a_list_in_a_file_and_a_text_elsewhere(tmp_path: Path) -> None:
    senders = ("vmc://", "vts://?delay=120")
    file = write(tmp_path, '[gateway]\nsenders = ["vmc://", "vts://?delay=120"]\n')
    environment = {"KOUXING_GATEWAY_SENDERS": "vmc:// vts://?delay=120"}
    for given in (settings(file), settings(environment=environment)):
        assert given.load(GatewayConfig).senders == senders


def test_every_value_has_its_origin(tmp_path: Path) -> None:
    file = write(tmp_path, "[driver]\ncamera = 'mouth'\nwidth_px = 640\nvirtual_camera = true\n")
    environment = {"KOUXING_DRIVER_WIDTH_PX": "320", "KOUXING_LOG_LEVEL": "error"}
    described = settings(file, environment).describe(DriverConfig, {"out": "films"})
    given = {item.key: (item.value, item.origin) for item in described if not item.is_default}
    assert given == {
        "camera": (Framing.MOUTH, str(file)),
        "virtual_camera": (True, str(file)),
        "width_px": (320, "$KOUXING_DRIVER_WIDTH_PX"),
        "log_level": ("error", "$KOUXING_LOG_LEVEL"),
        "out": ("films", "--set"),
    }


def test_a_default_may_depend_on_another_key() -> None:
    found = setting(settings(recognizer__acoustic="neural"), RecognizerConfig, "num_stable_frames")
    assert (found.value, found.default) == (1, 2)
    assert found.origin == "default with acoustic = neural"
    assert found.meaning.endswith("Other defaults: 1 with acoustic = neural or gmm.")
    assert setting(settings(), RecognizerConfig, "num_stable_frames").origin == "default"
    given = settings(recognizer__acoustic="neural", recognizer__num_stable_frames="3")
    assert given.load(RecognizerConfig).num_stable_frames == 3
    delays_ms = {name: settings(synthesizer__lips=name) for name in ("learnt", "ferguson")}
    assert [g.load(SynthesizerConfig).delay_ms for g in delays_ms.values()] == [60.0, 160.0]


@pytest.mark.parametrize(
    ("config_type", "key", "text", "allowed"),
    [
        (RecognizerConfig, "num_stable_frames", "many", "a whole number from 1 to 20"),
        (RecognizerConfig, "num_stable_frames", "0", "a whole number from 1 to 20"),
        (RecognizerConfig, "num_stable_frames", "2.9", "a whole number from 1 to 20"),
        (RecognizerConfig, "advertise", "tcp://here", "a host name or address"),
        (RecognizerConfig, "audio", "tcp://127.0.0.1:99999", "an endpoint, tcp://HOST:PORT"),
        (RecognizerConfig, "control", "here", "an endpoint, tcp://HOST:PORT"),
        (RecognizerConfig, "insecure", "yes", "true or false"),
        (SynthesizerConfig, "frame_rate_hz", "nan", "a number from 10 to 240"),
        (DriverConfig, "view", "hologram", "one of auto, window, none"),
        (DriverConfig, "camera", "foot", "one of face, head, mouth"),
        (DriverConfig, "width_px", "641", "a multiple of 2 from 16 to 7680"),
        (GatewayConfig, "port", "65536", "a whole number from 0 to 65535"),
        (GatewayConfig, "allowed_origins", "here", "a list of origins such as https://example.org"),
    ],
)
def test_an_error_names_key_value_origin_and_what_is_allowed(
    config_type: type[ServiceConfig], key: str, text: str, allowed: str
) -> None:
    section = config_type.__name__.removesuffix("Config").lower()
    with pytest.raises(UserError) as error:
        settings().load(config_type, {key: text})
    assert str(error.value) == f"{section}.{key}: {text!r} (from --set) is not {allowed}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("num_stable_frames =", "Invalid value"),
        ("[recogniser]\n", r"unknown table \[recogniser\]; the nearest is recognizer"),
        ("common = 1\n", r"unknown table \[common\]"),
        ("[recognizer]\nspeed = 1\n", "unknown key recognizer.speed; the nearest is recognizer."),
        ("[common]\nmin_confidence = 1\n", "the nearest is recognizer.min_confidence"),
        ("[driver]\nout = ['a']\n", "driver.out: .* is not text"),
        ("[driver]\nwidth_px = true\n", "driver.width_px: 'true'"),
        ("[gateway]\nsenders = 'vmc://'\n", "gateway.senders: .* is not a list"),
        ("[recognizer]\naudio = 5560\n", r"audio: '5560' \(from .*kouxing.toml"),
    ],
)
def test_an_error_in_a_file_is_located(tmp_path: Path, text: str, message: str) -> None:
    file = write(tmp_path, text)
    with pytest.raises(UserError, match=message) as error:
        settings(file).load(DriverConfig if "driver" in text else RecognizerConfig)
    assert "kouxing.toml" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere"):
        settings(tmp_path / "nowhere.toml")


@pytest.mark.parametrize(
    ("name", "nearest"),
    [
        ("KOUXING_LOOK_AHEAD_MS", "KOUXING_RECOGNIZER_LOOK_AHEAD_MS"),
        ("KOUXING_HEAD", "KOUXING_DRIVER_HEAD"),
        ("KOUXING_CONTROLL", "KOUXING_CONTROL"),
    ],
)
def test_an_unknown_variable_is_an_error_with_the_nearest_name(name: str, nearest: str) -> None:
    with pytest.raises(UserError, match=rf"\${name}: .* the nearest is {nearest};"):
        settings(environment={name: "1"})


def test_an_unknown_assignment_is_an_error_with_the_nearest_name() -> None:
    with pytest.raises(UserError, match=r"--set: .* recognizer.acustic; .* recognizer.acoustic;"):
        settings(recognizer__acustic="gmm")
    with pytest.raises(UserError, match=r"the nearest is recognizer.min_confidence"):
        settings().load(RecognizerConfig, {"min_confidenc": "1"})


@pytest.mark.parametrize("name", ["docker-compose.yml", "docs/hosts.md"])
def test_the_variables_in_documents_are_known(name: str) -> None:
    names = re.findall(r"KOUXING_\w+", (ROOT / name).read_text(encoding="utf-8"))
    assert names
    settings(environment=dict.fromkeys(names, ""))


def test_no_variable_sets_two_keys() -> None:
    names = [f"{name}_{key}".upper() for name, kind in TYPES.items() for key in kind.model_fields]
    common = [key.upper() for key in ServiceConfig.model_fields]
    assert len({*names, *common}) == len(names) + len(common)


def test_a_host_that_others_can_reach_must_be_encrypted() -> None:
    with pytest.raises(UserError, match=r"gateway.host: other machines can reach 0\.0\.0\.0"):
        settings().load(GatewayConfig, {"host": ANYWHERE})
    for extra in ("plain_http", "insecure"):
        assert settings().load(GatewayConfig, {"host": ANYWHERE, extra: "true"}).host == ANYWHERE


@pytest.mark.parametrize(
    ("advertise", "bound", "reachable"),
    [
        ("face-host", "tcp://0.0.0.0:5571", "tcp://face-host:5571"),
        ("203.0.113.7", "tcp://10.0.0.2:5571", "tcp://203.0.113.7:5571"),  # behind NAT
        ("fd00::7", "tcp://0.0.0.0:5571", "tcp://[fd00::7]:5571"),
        ("", "tcp://10.0.0.2:5571", "tcp://10.0.0.2:5571"),
    ],
)
def test_others_get_the_advertised_address(advertise: str, bound: str, reachable: str) -> None:
    synthesizer = SynthesizerConfig(advertise=advertise, control="tcp://127.0.0.9:5550")
    assert synthesizer.reachable(bound) == reachable


@pytest.mark.parametrize(
    ("control", "bound", "events"),
    [
        ("tcp://face.example:5550", "tcp://0.0.0.0:5550", "tcp://face.example:5551"),
        ("tcp://10.0.0.1:5550", "tcp://10.0.0.1:5550", "tcp://10.0.0.1:5551"),
    ],
)
def test_control_binds_the_address_by_which_others_find_it(
    control: str, bound: str, events: str
) -> None:
    config = settings(environment={"KOUXING_CONTROL": control}).load(ControlConfig)
    assert config.bound_control == bound
    assert config.reachable(bound) == control
    assert config.reachable("tcp://0.0.0.0:5551") == events


def test_the_file_for_all_hosts_in_the_docs_is_valid(tmp_path: Path) -> None:
    (text,) = code_blocks(ROOT / "docs" / "hosts.md", "toml")
    given = settings(write(tmp_path, text))
    control = given.load(ControlConfig)
    assert control.reachable(control.bound_control) == given.load(RecognizerConfig).control


def test_free_addresses_cover_every_key_that_binds() -> None:
    addresses = free_addresses(hosts={"synthesizer": "127.0.0.3"})
    assert addresses["KOUXING_CONTROL"] == addresses["KOUXING_CONTROL_CONTROL"]
    loaded = settings(environment=addresses)
    assert loaded.load(SynthesizerConfig).phone_input.startswith("tcp://127.0.0.3:")
    assert loaded.load(GatewayConfig).port != GatewayConfig().port
    assert len(set(addresses.values())) == len(addresses) - 1
