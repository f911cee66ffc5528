"""docker-compose.yml, run without a container engine."""

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Collection, Iterator
from http.client import HTTPConnection
from pathlib import Path
from typing import Any

import pytest
import yaml
from kouxing_client import Client

from kouxing.evaluation.system.network import Network, NetworkLink
from kouxing.shared.settings.keys import control_endpoint
from tests.containers import READ_CAP, USER_ID, Containers, network_or_skip
from tests.system import LIMIT_S, ROOT, VOWELS_FILE

COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))
HOSTS = {  # containers by name, and their services
    "control": "control",
    "recognizer-1": "recognizer",
    "synthesizer-1": "synthesizer",
    "gateway-1": "gateway",
    "client-1": "client",
}


@pytest.fixture(scope="module")
def network() -> Iterator[Network]:
    with network_or_skip([*HOSTS], NetworkLink()) as virtual_network:
        yield virtual_network


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder of keys that the service ``keys`` creates; this process also uses them."""
    folder = tmp_path_factory.mktemp("keys")
    run_keys_service(folder, *COMPOSE["services"]["keys"]["command"])
    key_files = folder / "kouxing"
    assert (key_files / "control.key").stat().st_uid == USER_ID
    own = tmp_path_factory.mktemp("own-keys") / "kouxing"
    shutil.copytree(key_files, own)  # owned by this user
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(own.parent))
        yield key_files


def run_keys_service(folder: Path, *command: str) -> None:
    """Run the service that creates the keys; a folder replaces its volume."""
    shell, option, script, name = COMPOSE["services"]["keys"]["entrypoint"]
    programs = folder.parent / "programs"
    programs.mkdir(exist_ok=True)
    (programs / "kouxing").write_text(f'#!/bin/sh\nexec {sys.executable} -m kouxing "$@"\n')
    (programs / "kouxing").chmod(0o755)
    script = script.replace("$$", "$").replace("/keys", str(folder))
    script = script.replace(
        "setpriv ",
        f"setpriv --inh-caps=-all,{READ_CAP} --ambient-caps=-all,{READ_CAP} ",
    )
    subprocess.run(
        [shell, option, script, name, *command],
        cwd=ROOT,
        env={
            "PATH": f"{programs}:/usr/bin:/bin",
            **{name: str(folder) for name in ("XDG_STATE_HOME", "NUMBA_CACHE_DIR")},
        },
        check=True,
    )


@pytest.fixture(scope="module")
def containers(
    network: Network, keys: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Containers]:
    new_containers = Containers(tmp_path_factory.mktemp("compose"), network, {"control": "control"})
    running = {
        host: start(new_containers, host, service, keys, *COMPOSE["services"][service]["command"])
        for host, service in HOSTS.items()
        if service != "client"
    }
    yield new_containers
    for process in running.values():
        process.terminate()
    statuses = {host: process.wait(LIMIT_S) for host, process in running.items()}
    assert set(statuses.values()) == {0}, statuses


def start(
    containers: Containers, host: str, service: str, keys: Path, *arguments: str
) -> subprocess.Popen[bytes]:
    description = COMPOSE["services"][service]
    # A variable without a value is that of the shell, if it is set.
    environment = {
        name: value for name, value in description["environment"].items() if value is not None
    }
    if service == "control":
        (volume,) = description["volumes"]
        assert (volume["source"], volume["read_only"]) == ("./deploy/keys/kouxing", True)
        return containers.start(host, arguments, environment, {}, (keys, volume["target"]))
    files = {name: COMPOSE["secrets"][name]["file"] for name in description["secrets"]}
    secrets = {name: keys / Path(path).name for name, path in files.items()}
    return containers.start(host, arguments, environment, secrets)


@pytest.mark.timeout(900)  # the recognizer compiles its functions, on a busy machine
def test_containers_are_healthy_private_and_speak(
    containers: Containers, network: Network, keys: Path
) -> None:
    end_s = time.monotonic() + 800
    address = f"tcp://{network.address('control')}:5550"
    endpoint = control_endpoint(address, insecure=False)
    with (
        network.on("client-1"),
        Client(endpoint, timeout_s=LIMIT_S, start_s=LIMIT_S) as client,
    ):
        while len(services := client.status().services) < len(HOSTS) - 1:
            assert time.monotonic() < end_s, services
            time.sleep(0.2)
        reported_endpoints = {item for state in services for item in state.endpoints.values()}
        check_page(reported_endpoints, network.address("gateway-1"))
    for host, service in HOSTS.items():
        if service != "client":
            check = COMPOSE["services"][service]["healthcheck"]["test"][1:]
            while not containers.is_healthy(host, check):
                assert time.monotonic() < end_s, containers.log(host).read_text("utf-8")
    for host, port in (("recognizer-1", 5560), ("synthesizer-1", 5571)):
        assert any(
            item.startswith(f"tcp://{network.address(host)}:{port} ") for item in reported_endpoints
        ), reported_endpoints

    speaker = start(containers, "client-1", "client", keys, "speak", str(VOWELS_FILE), "--fast")
    assert speaker.wait(LIMIT_S) == 0, containers.log("client-1").read_text("utf-8")
    assert " phones in " in containers.log("client-1").read_text("utf-8")


def check_page(reported_endpoints: Collection[str], gateway: str) -> None:
    """Check that compose publishes the page, and that it requires the token in its address."""
    (published,) = COMPOSE["services"]["gateway"]["ports"]
    host, port, own_port = published.split(":")
    (secret,) = [
        item.removeprefix(address)
        for address in [f"http://{host}:{port}/#"]
        for item in reported_endpoints
        if item.startswith(address)
    ]
    for query, status in (("", 403), (f"?{secret}", 200)):
        with contextlib.closing(HTTPConnection(gateway, int(own_port), timeout=LIMIT_S)) as http:
            http.request("GET", f"/senders{query}")
            assert http.getresponse().status == status


def test_every_container_is_isolated() -> None:
    for name, service in COMPOSE["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert "KOUXING_INSECURE" not in service["environment"], name
        advertised = service["environment"].get("KOUXING_ADVERTISE")  # which replicas would share
        assert advertised == ("127.0.0.1" if name == "gateway" else None), name
        assert (service.get("user") == "root") == (name == "keys"), name
    dockerfile = (ROOT / "deploy" / "Dockerfile").read_text("utf-8")
    assert f"\nUSER {USER_ID}:{USER_ID}\n" in dockerfile


def test_the_shell_can_set_the_token_of_the_page() -> None:
    gateway = COMPOSE["services"]["gateway"]["environment"]
    assert gateway["KOUXING_GATEWAY_TOKEN"] is None


def test_the_image_builds_the_files_of_the_page_itself() -> None:
    lines = (ROOT / ".gitignore").read_text("utf-8").splitlines()
    generated = {line.rstrip("/") for line in lines if line.startswith("services/")}
    assert generated
    assert generated <= set((ROOT / ".dockerignore").read_text("utf-8").splitlines())


def test_the_image_has_all_packages() -> None:
    dockerfile = (ROOT / "deploy" / "Dockerfile").read_text("utf-8")
    links = {path.resolve().name for path in (ROOT / "kouxing").iterdir() if path.is_symlink()}
    for folder in ("kouxing", "clients/python", *links):
        assert f"\nCOPY {folder} {folder}\n" in dockerfile
