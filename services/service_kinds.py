"""The kinds of services, and the addresses that they bind."""

import contextlib
import errno
import secrets
import socket
import sys
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from kouxing.services.heads import HeadConfig
from kouxing.shared.errors import UserError
from kouxing.shared.face.config import LiveConfig
from kouxing.shared.service.service_kind import ServiceKind
from kouxing.shared.settings.config import (
    COMMON,
    BindAddress,
    ServiceConfig,
    Settings,
    bound_keys,
    variable_name,
)
from kouxing.shared.settings.endpoints import WILDCARDS

_FREE_PORTS = range(20_000, 32_000)  # below the range for outgoing connections

KINDS: dict[str, ServiceKind] = {  # in order of start
    "control": ServiceKind(
        name="control",
        role="control",
        summary="Run control: it opens sessions and places them on the other services.",
    ),
    "recognizer": ServiceKind(
        name="recognizer",
        role="worker",
        summary="Run a recognizer: audio in, timestamped phones out.",
        provides=("audio", "unpaced_audio", "phones"),
        needs=("phone_input",),
    ),
    "synthesizer": ServiceKind(
        name="synthesizer",
        role="worker",
        summary="Run a synthesizer: phones in, FAP frames out.",
        provides=("phone_input", "faps"),
    ),
    "driver": ServiceKind(
        name="driver",
        role="observer",
        summary="Run a driver: FAP frames in, a window and videos out.",
        needs=("phones", "faps"),
    ),
    "gateway": ServiceKind(
        name="gateway",
        role="observer",
        summary="Run the gateway: the face and a microphone in a browser.",
        needs=("phones", "faps"),
        client_roles=("client",),
    ),
}


@dataclass(frozen=True, kw_only=True)
class CommonConfig(HeadConfig, LiveConfig):
    """The keys of the table ``[common]``."""


CONFIG_TYPES: dict[str, type[ServiceConfig]] = {
    COMMON: CommonConfig,
    **{kind.name: kind.config_type for kind in KINDS.values()},
}
"""The configuration classes by table."""
WORKERS = tuple(kind.name for kind in KINDS.values() if kind.role == "worker")
PROVIDERS = {endpoint: kind.name for kind in KINDS.values() for endpoint in kind.provides}


def read_settings(
    file: Path | None = None, assignments: Mapping[str, str] | None = None
) -> Settings:
    """Return the settings of all services; raises as ``shared.settings.config.Settings``."""
    return Settings(CONFIG_TYPES, file=file, assignments=assignments)


def free_port_environment(
    names: Collection[str] = tuple(KINDS),
    hosts: Mapping[str, str] | None = None,
    reservations: contextlib.ExitStack | None = None,
) -> dict[str, str]:
    """Return an environment in which services bind free ports, on 127.0.0.1 or the given hosts.

    On Linux, no other program gets these ports until ``reservations`` is closed.
    """
    environment = {}
    with contextlib.ExitStack() as probes:  # all stay open, so that the ports differ
        for name in names:
            host = (hosts or {}).get(name, "127.0.0.1")
            for key, bound in bound_keys(KINDS[name].config_type).items():
                if bound is BindAddress.HOST:
                    continue
                probe = probes.enter_context(_bind_free_port(host))
                port = str(probe.getsockname()[1])
                address = f"tcp://{host}:{port}" if bound is BindAddress.ENDPOINT else port
                environment[variable_name(name, key)] = address
        if reservations is not None and sys.platform == "linux":
            reservations.push(probes.pop_all())
    if "control" in names:
        environment[variable_name(COMMON, "control")] = environment[
            variable_name("control", "control")
        ]
    return environment


def _bind_free_port(host: str) -> socket.socket:
    """Bind a random port that the system does not use for outgoing connections.

    Otherwise, another program could get the port before the service starts.
    """
    while True:
        probe = socket.socket()
        try:
            probe.bind((host, secrets.choice(_FREE_PORTS)))
        except OSError as error:
            probe.close()
            if error.errno != errno.EADDRINUSE:
                raise
        else:
            # On Linux, servers, which also set this option, can still bind the port.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            return probe


def available_port_environment(settings: Settings) -> dict[str, str]:
    """Return an environment in which services bind free ports instead of default ports in use.

    Raises ``UserError`` if a port that the user set is not available.
    """
    free = free_port_environment()
    environment = {}
    for kind in KINDS.values():
        values = {setting.key: setting for setting in settings.describe(kind.config_type)}
        bound = bound_keys(kind.config_type)
        host = next((str(values[key].value) for key in bound if bound[key] is BindAddress.HOST), "")
        for key in (key for key in bound if bound[key] is not BindAddress.HOST):
            setting = values[key]
            endpoint_host, _, port = str(setting.value).removeprefix("tcp://").rpartition(":")
            is_any = port in ("0", "*")
            problem = "" if is_any else _port_problem(endpoint_host or host, int(port))
            if problem and not setting.is_default:
                raise UserError(
                    f"{kind.name}.{key}: {problem}; choose another port, or omit it to use a free"
                    " one"
                )
            if problem or is_any:
                environment[variable_name(kind.name, key)] = free[variable_name(kind.name, key)]
    return environment


def extra_worker_environments(settings: Settings, number: int) -> dict[str, dict[str, str]]:
    """Return the environments of additional workers, so that each kind has ``number`` of them.

    Their names are ``recognizer-2`` and so on. They bind free ports on the first worker's host,
    and serve no metrics.
    """
    environments: dict[str, dict[str, str]] = {}
    for name in WORKERS:
        config = settings.load(KINDS[name].config_type)
        environment = dict.fromkeys(
            (variable_name(name, "instance"), variable_name(name, "metrics")), ""
        )
        for key, bound in bound_keys(type(config)).items():
            if bound is BindAddress.ENDPOINT:
                host = str(getattr(config, key)).rpartition(":")[0]
                environment[variable_name(name, key)] = f"{host}:*"
            elif bound is BindAddress.PORT:
                environment[variable_name(name, key)] = "0"
        environments |= {f"{name}-{count}": environment for count in range(2, number + 1)}
    return environments


def kind_of(name: str) -> str:
    """Return the kind of a service from its name, such as ``recognizer-2``."""
    return name.partition("-")[0]


def _port_problem(host: str, port: int) -> str:
    """Return the reason why a port cannot be bound; empty if it can be bound."""
    host = "" if host in WILDCARDS else host.strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family):
            return ""
    except OSError as error:
        problems = {
            errno.EADDRINUSE: f"another program uses port {port}",
            errno.EACCES: f"port {port} needs privileges",
        }
        return problems.get(error.errno or 0, "")
