"""Configuration: sources, rejected values, error messages, and the command that prints it."""

import re
from pathlib import Path

import pytest

from kouxing.services.cli.configuration import config, markdown_page
from kouxing.services.control.config import ControlConfig
from kouxing.services.driver.config import DriverConfig
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.lip_models import lip_model_names
from kouxing.services.recognizer.config import RecognizerConfig
from kouxing.services.recognizer.search.output_rule import MODEL_RULES
from kouxing.services.service_kinds import CONFIG_TYPES, read_settings
from kouxing.services.synthesizer.config import SynthesizerConfig
from kouxing.shared.errors import UserError
from kouxing.shared.settings.config import KnownNames, ServiceConfig, Settings, parse_assignments
from tests.documents import code_blocks
from tests.system import ROOT

ANYWHERE = "0.0.0.0"  # noqa: S104


def settings(
    file: Path | None = None, environment: dict[str, str] | None = None, **assigned: str
) -> Settings:
    assignments = {name.replace("__", "."): text for name, text in assigned.items()}
    return Settings(CONFIG_TYPES, file=file, environment=environment or {}, assignments=assignments)


def assign(assignments: dict[str, str]) -> Settings:
    return Settings(CONFIG_TYPES, environment={}, assignments=assignments)


def write(folder: Path, text: str) -> Path:
    path = folder / "kouxing.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("config_type", [ServiceConfig, *CONFIG_TYPES.values()])
def test_every_default_is_allowed_and_every_key_is_described(
    config_type: type[ServiceConfig],
) -> None:
    described = settings().describe(config_type)
    table = next((name for name, known in CONFIG_TYPES.items() if known is config_type), "common")
    given = assign({f"{table}.{item.key}": item.text for item in described})
    assert given.load(config_type) == settings().load(config_type) == config_type()
    assert all(item.meaning.endswith(".") and item.allowed for item in described)


def test_sources_override_each_other_in_order(tmp_path: Path) -> None:
    text = (
        "[recognizer]\nnum_stable_frames = 2\nlog_level = 'debug'\n[common]\nlog_level = 'error'\n"
    )
    file = write(tmp_path, text)
    environment = {"KOUXING_RECOGNIZER_NUM_STABLE_FRAMES": "4"}
    assert settings(file).load(RecognizerConfig).num_stable_frames == 2
    assert settings(file, environment).load(RecognizerConfig).num_stable_frames == 4
    given = settings(file, environment, recognizer__num_stable_frames="5")
    assert given.load(RecognizerConfig).num_stable_frames == 5
    levels = {"KOUXING_RECOGNIZER_LOG_LEVEL": "DEBUG", "KOUXING_LOG_LEVEL": "error"}
    for given in (settings(file), settings(environment=levels)):
        assert given.load(RecognizerConfig).log_level == "debug"
        assert given.load(ControlConfig).log_level == "error"


def test_a_list_is_a_list_in_a_file_and_a_text_elsewhere(tmp_path: Path) -> None:
    file = write(tmp_path, '[gateway]\nsenders = ["vmc://", "vts://?delay=120"]\n')
    environment = {"KOUXING_GATEWAY_SENDERS": "vmc:// vts://?delay=120"}
    for given in (settings(file), settings(environment=environment)):
        assert given.load(GatewayConfig).senders == ("vmc://", "vts://?delay=120")


def test_a_default_may_depend_on_another_key() -> None:
    given = settings(recognizer__acoustic="gmm")
    items = {item.key: item for item in given.describe(RecognizerConfig)}
    item = items["num_stable_frames"]
    assert (item.value, item.default) == (1, 2)
    assert item.is_default
    assert item.meaning.endswith("The default is 1 if acoustic is light or gmm.")
    short = {name for name, rule in MODEL_RULES.items() if rule.num_stable_frames == 1}
    assert short == {"light", "gmm"}
    delays_ms = {
        name: settings(synthesizer__lips=name).load(SynthesizerConfig).delay_ms
        for name in lip_model_names()
    }
    assert delays_ms == {"learned": 60.0, "dynamic-visemes": 160.0, "ferguson": 160.0}


@pytest.mark.parametrize(
    ("key", "text", "allowed"),
    [
        ("recognizer.num_stable_frames", "many", "an integer from 1 to 20"),
        ("recognizer.num_stable_frames", "2.9", "an integer from 1 to 20"),
        *(
            ("recognizer.advertise", text, "a host name of at most 190 characters, or an address")
            for text in ("tcp://here", 191 * "h")
        ),
        ("recognizer.audio", "tcp://127.0.0.1:99999", "an endpoint, tcp://HOST:PORT"),
        ("recognizer.control", "here", "an endpoint, tcp://HOST:PORT"),
        ("recognizer.insecure", "yes", "true or false"),
        ("synthesizer.frame_rate_hz", "nan", "a number from 10 to 240"),
        ("synthesizer.delay_ms", "0.06", "0, or a number of milliseconds from 1 to 300"),
        ("driver.view", "hologram", "one of auto, window, none"),
        ("recognizer.acoustic", "bloks", "or a file such as model.npz; did you mean blocks?"),
        ("driver.head", "womam", "or a file (.glb, .gltf, .vrm or .npz); did you mean woman?"),
        ("driver.background", "blurple", "green, blue, or #rrggbb; did you mean blue?"),
        ("synthesizer.lips", "fergusen", "; did you mean ferguson?"),
        ("driver.size", "641x480", "an even WIDTHxHEIGHT from 16x16 to 7680x4320"),
        *(
            ("recognizer.metrics", text, "HOST:PORT such as 127.0.0.1:9100, or empty")
            for text in ("9100", "127.0.0.1:*", "localhost:0", "*:9100")
        ),
        *(
            ("gateway.https", text, "empty, proxy, or the path of a PEM file such as kouxing.pem")
            for text in ("true", "False", "0")
        ),
        ("gateway.trusted_origins", "https://a.example; *", '"A B" elsewhere'),
        ("gateway.senders", "vmc://127.0.0.1 http://127.0.0.1", '"A B" elsewhere'),
    ],
)
def test_an_error_names_key_value_origin_and_what_is_allowed(
    key: str, text: str, allowed: str
) -> None:
    with pytest.raises(UserError) as error:
        assign({key: text}).load(CONFIG_TYPES[key.partition(".")[0]])
    assert str(error.value).startswith(f"{key}: {text!r} (from --set) is not ")
    assert str(error.value).endswith(allowed)


def test_names_may_have_capitals() -> None:
    known = KnownNames(lambda: ("MyLips", "ferguson"))
    assert [*map(known.convert, ("MyLips", "Ferguson"))] == ["MyLips", "ferguson"]
    assert settings(driver__background="Green").load(DriverConfig).background == "green"
    assert settings(driver__background="grey").load(DriverConfig).background == "grey"
    assert settings(gateway__https="Proxy").load(GatewayConfig).is_behind_proxy


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("num_stable_frames =", "Invalid value"),
        ("[recogniser]\n", r"unknown table \[recogniser\]; the nearest is recognizer"),
        ("common = 1\n", r"'common' is not in a table; write it below a line such as \[common\]"),
        ("head = 'mika'\n", "'head' is not in a table"),
        ("[recognizer]\nspeed = 1\n", "unknown key recognizer.speed; the nearest is recognizer."),
        ("[common]\nmin_confidence = 1\n", "the nearest is recognizer.min_confidence"),
        ("[control]\nlips = 'learned'\n", "the nearest is synthesizer.lips"),
        ("[driver]\nout = ['a']\n", "driver.out: .* is not text"),
        (
            "[gateway]\nsenders = 'vmc://'\n",
            r'gateway.senders: .* is not a list .*; write \["A", "B"\] in a file',
        ),
        ("[recognizer]\naudio = 5560\n", r"audio: '5560' \(from .*kouxing.toml"),
    ],
)
def test_an_error_in_a_file_is_located(tmp_path: Path, text: str, message: str) -> None:
    file = write(tmp_path, text)
    with pytest.raises(UserError, match=message) as error:
        settings(file).load(DriverConfig if "driver" in text else RecognizerConfig)
    assert "kouxing.toml" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("environment", "assignments", "error"),
    [
        ({"KOUXING_VIEW": "1"}, {}, r"\$KOUXING_VIEW: .* the nearest is KOUXING_DRIVER_VIEW;"),
        ({"KOUXING_CONTROLL": "1"}, {}, "the nearest is KOUXING_CONTROL;"),
        ({"KOUXING_INSTANCE": "a"}, {}, "the nearest is KOUXING_.*_INSTANCE;"),
        ({}, {"recognizer.acustic": "gmm"}, "--set: .*; the nearest is .*acoustic;"),
    ],
)
def test_an_unknown_key_is_an_error_with_the_nearest_name(
    environment: dict[str, str], assignments: dict[str, str], error: str
) -> None:
    with pytest.raises(UserError, match=error):
        Settings(CONFIG_TYPES, environment=environment, assignments=assignments)


@pytest.mark.parametrize("name", ["docker-compose.yml", "docs/hosts.md"])
def test_the_variables_in_documents_are_known(name: str) -> None:
    names = re.findall(r"KOUXING_\w+", (ROOT / name).read_text(encoding="utf-8"))
    assert names
    settings(environment=dict.fromkeys(names, ""))


def test_a_host_that_others_can_reach_must_be_encrypted() -> None:
    with pytest.raises(UserError, match=r"gateway.host: other machines can reach 0\.0\.0\.0"):
        assign({"gateway.host": ANYWHERE}).load(GatewayConfig)
    for key, text in (("https", "proxy"), ("https", "face.pem"), ("insecure", "true")):
        given = assign({"gateway.host": ANYWHERE, f"gateway.{key}": text})
        assert given.load(GatewayConfig).host == ANYWHERE


def test_the_file_for_all_hosts_in_the_docs_is_valid(tmp_path: Path) -> None:
    (text,) = code_blocks(ROOT / "docs" / "hosts.md", "toml")
    given = settings(write(tmp_path, text))
    control = given.load(ControlConfig)
    assert (
        control.advertised_endpoint(control.bound_control) == given.load(RecognizerConfig).control
    )


@pytest.mark.parametrize(
    ("advertise", "bound", "advertised_endpoint"),
    [
        ("face-host", "tcp://0.0.0.0:5571", "tcp://face-host:5571"),
        ("203.0.113.7", "tcp://10.0.0.2:5571", "tcp://203.0.113.7:5571"),  # behind NAT
        ("fd00::7", "tcp://0.0.0.0:5571", "tcp://[fd00::7]:5571"),
        ("", "tcp://10.0.0.2:5571", "tcp://10.0.0.2:5571"),
    ],
)
def test_other_hosts_receive_the_advertised_address(
    advertise: str, bound: str, advertised_endpoint: str
) -> None:
    assert SynthesizerConfig(advertise=advertise).advertised_endpoint(bound) == advertised_endpoint


@pytest.mark.parametrize("host", ["face.example", "10.0.0.1"])
def test_control_binds_the_address_by_which_others_find_it(host: str) -> None:
    config = settings(environment={"KOUXING_CONTROL": f"tcp://{host}:5550"}).load(ControlConfig)
    assert config.bound_control == f"tcp://{host if host[0] == '1' else ANYWHERE}:5550"
    assert config.advertised_endpoint(config.bound_control) == f"tcp://{host}:5550"
    assert config.advertised_endpoint(f"tcp://{ANYWHERE}:5551") == f"tcp://{host}:5551"


PAGE = Path(__file__).parents[2] / "docs" / "configuration.md"


def test_the_page_in_the_docs_is_current() -> None:
    assert PAGE.read_text(encoding="utf-8") == markdown_page(), (
        "run: python -m kouxing.services.cli.configuration > docs/configuration.md"
    )


def test_the_output_is_a_file_with_the_same_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KOUXING_DRIVER_VIRTUAL_CAMERA", "true")
    monkeypatch.setenv("KOUXING_RECOGNIZER_LOG_LEVEL", "debug")
    file = tmp_path / "first.toml"
    text = "[driver]\nout = 'a \"b\" 口'\n[gateway]\nport = 0\nsenders = ['vmc://']\n"
    file.write_text(text, encoding="utf-8")
    expected = [read_settings(file).load(config_type) for config_type in CONFIG_TYPES.values()]
    config("driver", config=file, assignments=["camera=mouth", "driver.size=64x48"])
    printed = capsys.readouterr().out
    assert "[gateway]" not in printed
    assert 'camera = "mouth"  # --set' in printed
    assert 'size = "64x48"  # --set' in printed
    config(config=file)
    printed = capsys.readouterr().out
    assert f"port = 0  # {file}" in printed
    assert "virtual_camera = true  # $KOUXING_DRIVER_VIRTUAL_CAMERA" in printed
    assert "default 8080." in printed
    monkeypatch.undo()
    file.write_text(printed, encoding="utf-8")
    assert [read_settings(file).load(kind) for kind in CONFIG_TYPES.values()] == expected


def test_an_unknown_service_or_key_is_an_error() -> None:
    with pytest.raises(UserError, match="one of common, control"):
        config("listener")
    with pytest.raises(UserError, match=r"--set: .* key port; the nearest is gateway.port"):
        config(assignments=["port=1"])
    with pytest.raises(UserError, match="only the keys of control, and not the key gateway"):
        parse_assignments(["lost_after_s=2", "gateway.port=1"], "control")
