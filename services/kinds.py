"""The kinds of service, and the addresses that they bind."""

from __future__ import annotations

import contextlib
import errno
import pkgutil
import socket
from collections.abc import Collection, Mapping
from pathlib import Path

from kouxing.shared.config import COMMON, Bound, Settings, bound_keys, variable
from kouxing.shared.endpoints import WILDCARDS
from kouxing.shared.errors import UserError
from kouxing.shared.service_kind import ServiceKind

_PACKAGES = ("control", "recognizer", "synthesizer", "driver", "gateway")  # in order of start

KINDS: dict[str, ServiceKind] = {
    package: pkgutil.resolve_name(f"kouxing.services.{package}.kind:KIND") for package in _PACKAGES
}
WORKERS = tuple(kind.name for kind in KINDS.values() if kind.role == "worker")
PROVIDERS = {endpoint: kind.name for kind in KINDS.values() for endpoint in kind.provides}


def read_settings(
    file: Path | None = None, assignments: Mapping[str, str] | None = None
) -> Settings:
    """Return what a file, the environment and a command line say about all services.

    Raises
    ------
    UserError
        As ``kouxing.shared.config.Settings``.
    """
    types = {kind.name: kind.config_type for kind in KINDS.values()}
    return Settings(types, file=file, assignments=assignments)


def free_addresses(
    names: Collection[str] = tuple(KINDS), hosts: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return an environment in which services bind free ports, beside a system that runs already.

    Parameters
    ----------
    names
        Services that bind.
    hosts
        Addresses of this machine, by service; 127.0.0.1 where none is given.
    """
    environment = {}
    with contextlib.ExitStack() as probes:  # all stay open, so that no port is found twice
        for name in names:
            host = (hosts or {}).get(name, "127.0.0.1")
            for key, bound in bound_keys(KINDS[name].config_type).items():
                if bound is Bound.HOST:
                    continue
                probe = probes.enter_context(socket.socket())
                probe.bind((host, 0))
                port = str(probe.getsockname()[1])
                address = f"tcp://{host}:{port}" if bound is Bound.ENDPOINT else port
                environment[variable(name, key)] = address
    if "control" in names:
        environment[variable(COMMON, "control")] = environment[variable("control", "control")]
    return environment


def available_addresses(settings: Settings) -> dict[str, str]:
    """Return an environment in which services bind free ports where default ones are taken.

    Raises
    ------
    UserError
        If a port that was chosen is taken.
    """
    free = free_addresses()
    environment = {}
    for kind in KINDS.values():
        values = {each.key: each for each in settings.describe(kind.config_type)}
        bound = bound_keys(kind.config_type)
        host = next((str(values[key].value) for key in bound if bound[key] is Bound.HOST), "")
        for key in (key for key in bound if bound[key] is not Bound.HOST):
            setting = values[key]
            endpoint_host, _, port = str(setting.value).removeprefix("tcp://").rpartition(":")
            if port not in ("0", "*"):
                if not _is_taken(endpoint_host or host, int(port)):
                    continue
                if not setting.is_default:
                    raise UserError(
                        f"{kind.name}.{key}: another program has port {port}; choose another, or"
                        " none to get a free one"
                    )
            environment[variable(kind.name, key)] = free[variable(kind.name, key)]
    return environment


def more_workers(settings: Settings, number: int) -> dict[str, dict[str, str]]:
    """Return environments of that many workers of a kind in all, but for the first of each.

    Their names are ``recognizer-2`` and so on. They bind free ports, on the addresses of the first.
    """
    environments: dict[str, dict[str, str]] = {}
    for name in WORKERS:
        config = settings.load(KINDS[name].config_type)
        own = {variable(name, "instance"): ""}
        for key, bound in bound_keys(type(config)).items():
            if bound is Bound.ENDPOINT:
                host = str(getattr(config, key)).rpartition(":")[0]
                own[variable(name, key)] = f"{host}:*"
            elif bound is Bound.PORT:
                own[variable(name, key)] = "0"
        environments |= {f"{name}-{count}": own for count in range(2, number + 1)}
    return environments


def kind_of(name: str) -> str:
    """Return the kind of service that has some name, such as ``recognizer-2``."""
    return name.partition("-")[0]


def _is_taken(host: str, port: int) -> bool:
    host = "" if host in WILDCARDS else host.strip("[]")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.create_server((host, port), family=family):
            return False
    except OSError as error:
        return error.errno == errno.EADDRINUSE
