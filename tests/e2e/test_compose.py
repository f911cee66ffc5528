"""docker-compose.yml, carried out without an engine."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from evaluation.system.network import Link, Network
from shared.client import Client
from shared.errors import UserError
from shared.keys import control_endpoint
from tests.containers import READ, USER, Containers
from tests.system import ROOT, VOWELS_FILE

pytestmark = pytest.mark.e2e
COMPOSE: dict[str, Any] = yaml.safe_load((ROOT / "docker-compose.yml").read_text("utf-8"))
HOSTS = {  # containers by name, and their services: two recognizers, as by --scale
    "control": "control",
    "recognizer-1": "recognizer",
    "recognizer-2": "recognizer",
    "synthesizer-1": "synthesizer",
    "gateway-1": "gateway",
    "driver-1": "driver",
    "client-1": "client",
}


@pytest.fixture(scope="module")
def network() -> Iterator[Network]:
    try:
        made = Network([*HOSTS], Link())
    except UserError as error:  # where nobody may have a network of his own
        pytest.skip(str(error))
    with made:
        yield made


@pytest.fixture(scope="module")
def volume(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the service ``keys`` has made."""
    folder = tmp_path_factory.mktemp("keys")
    run_keys_service(folder, *COMPOSE["services"]["keys"]["command"])
    assert (folder / "kouxing" / "control.key").stat().st_uid == USER
    return folder


@pytest.fixture(scope="module")
def keys(volume: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Path]]:
    """Secrets by name; this process gets them, too."""
    own = tmp_path_factory.mktemp("own-keys") / "kouxing"
    shutil.copytree(volume / "kouxing", own)  # owned by who copies
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(own.parent))
        yield {name: own / Path(each["file"]).name for name, each in COMPOSE["secrets"].items()}


def run_keys_service(folder: Path, *arguments: str) -> None:
    """Run what makes the keys, on a folder that takes the place of its volume."""
    service = COMPOSE["services"]["keys"]
    shell, option, script, name = service["entrypoint"]
    programs = folder.parent / "programs"
    programs.mkdir(exist_ok=True)
    (programs / "kouxing").write_text(f'#!/bin/sh\nexec {sys.executable} -m services "$@"\n')
    (programs / "kouxing").chmod(0o755)
    script = script.replace("$$", "$").replace("/keys", str(folder))
    script = script.replace(
        "setpriv ", f"setpriv --inh-caps=-all,{READ} --ambient-caps=-all,{READ} "
    )
    subprocess.run(
        [shell, option, script, name, *arguments],
        cwd=ROOT,
        env={
            "PATH": f"{programs}:/usr/bin:/bin",
            **{name: str(folder) for name in ("XDG_STATE_HOME", "NUMBA_CACHE_DIR")},
        },
        check=True,
    )


@pytest.fixture(scope="module")
def containers(
    network: Network,
    volume: Path,
    keys: dict[str, Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Containers]:
    made = Containers(tmp_path_factory.mktemp("compose"), network, {"control": "control"})
    running = {
        host: start(made, host, service, keys, volume, *COMPOSE["services"][service]["command"])
        for host, service in HOSTS.items()
        if service != "client"
    }
    yield made
    for process in running.values():
        process.terminate()
    for host, process in running.items():
        grace_s = int(COMPOSE["services"][HOSTS[host]]["stop_grace_period"].removesuffix("s"))
        assert process.wait(grace_s) == 0, made.log(host).read_text("utf-8")


def start(
    containers: Containers,
    host: str,
    service: str,
    keys: dict[str, Path],
    volume: Path,
    *arguments: str,
) -> subprocess.Popen[bytes]:
    description = COMPOSE["services"][service]
    environment = description["environment"]
    mounted = ("", "")
    if service == "driver":  # no volume is mounted for it here
        environment = {**environment, "KOUXING_DRIVER_OUT": "/tmp"}  # noqa: S108
    elif "volumes" in description:
        ((source, target, mode),) = (each.split(":") for each in description["volumes"])
        assert mode == "ro"
        mounted = (str(volume / Path(source).relative_to("deploy/keys")), target)
    secrets = {name: keys[name] for name in description.get("secrets", ())}
    return containers.start(host, arguments, environment, secrets, mounted)


@pytest.mark.timeout(400)  # of a busy machine
def test_containers_are_healthy_private_and_speak(
    containers: Containers, network: Network, keys: dict[str, Path], volume: Path
) -> None:
    end_s = time.monotonic() + 200
    for host, service in HOSTS.items():
        if service == "client":
            continue
        check = COMPOSE["services"][service]["healthcheck"]["test"][1:]
        while not containers.is_healthy(host, check):
            assert time.monotonic() < end_s, containers.log(host).read_text("utf-8")
            time.sleep(0.2)

    address = f"tcp://{network.bound('control')}:5550"
    with network.on("client-1"), Client(control_endpoint(address, insecure=False)) as client:
        while len(services := client.status().services) < len(HOSTS) - 1:
            assert time.monotonic() < end_s, services
            time.sleep(0.2)
        told = {each for state in services for each in state.endpoints.values()}
    for host, port in (("recognizer-1", 5560), ("recognizer-2", 5560), ("synthesizer-1", 5571)):
        assert any(each.startswith(f"tcp://{network.bound(host)}:{port} ") for each in told), told

    said = "speak", str(VOWELS_FILE), "--fast"
    speaker = start(containers, "client-1", "client", keys, volume, *said)
    assert speaker.wait(60) == 0, containers.log("client-1").read_text("utf-8")
    assert " phones in " in containers.log("client-1").read_text("utf-8")


def test_a_key_is_revoked_without_a_restart(
    containers: Containers, network: Network, keys: dict[str, Path], volume: Path
) -> None:
    address = f"tcp://{network.bound('control')}:5550"
    with network.on("client-1"), Client(control_endpoint(address, insecure=False)) as client:
        assert client.status().services
    run_keys_service(volume, "revoke", "client")
    with (
        network.on("client-1"),
        Client(control_endpoint(address, insecure=False)) as client,
        pytest.raises(UserError, match="does not accept"),
    ):
        client.status()


def test_every_service_is_locked_in() -> None:
    for name, service in COMPOSE["services"].items():
        assert service["read_only"], name
        assert service["cap_drop"] == ["ALL"], name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        assert "KOUXING_INSECURE" not in service["environment"], name
        assert "KOUXING_ADVERTISE" not in service["environment"], "replicas share the environment"
        assert (service.get("user") == "root") == (name == "keys"), name
    dockerfile = (ROOT / "deploy" / "Dockerfile").read_text("utf-8")
    assert f"\nUSER {USER}:{USER}\n" in dockerfile
