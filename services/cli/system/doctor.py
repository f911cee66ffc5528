"""``kouxing doctor``: checks the keys, addresses, clocks and versions of a system from here."""

import contextlib
from collections.abc import Collection, Iterator, Mapping
from importlib.metadata import version
from typing import NamedTuple
from urllib.parse import urlsplit

from kouxing_client import ServiceState
from kouxing_client.connection_check import explain_unreachable
from kouxing_client.keys import Key

from kouxing.services.cli.system.running_system import choose_system, running_systems
from kouxing.services.service_kinds import KINDS
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.command.terminal import plural
from kouxing.shared.errors import UserError
from kouxing.shared.network.bus import Bus, ProbeResult
from kouxing.shared.settings.endpoints import is_loopback, split_endpoint, with_key
from kouxing.shared.settings.keys import (
    CLIENT,
    CLIENT_ROLES,
    load_local_keys,
    load_user_key,
    rejection_hint,
)

MAX_CLOCK_OFFSET_MS = 1000.0
MAX_AGE_S = 2.0  # limit for the age of the newest heartbeat
REQUIRED_SERVICES = ("control", "recognizer", "synthesizer")  # without them, no face moves
PUBLISHERS = ("phones", "faps", "events")  # accept every allowed key
CLIENT_NEEDS = ("commands", "audio", "unpaced_audio", *PUBLISHERS)  # endpoints
INSECURE = "none"  # in place of the name of a key
# role that a key needs, by router
ROUTER_ROLES = {"audio": "client", "unpaced_audio": "client", "phone_input": "service"}


class CheckResult(NamedTuple):
    """The result of one check."""

    subject: str
    result: str
    remedy: str = ""  # what to do; empty if the check passed


def run_checks(address: str) -> Iterator[CheckResult]:
    """Yield the result of each check; if ``address`` is empty, control is the configured one."""
    system = choose_system(address)
    config = system.config
    control = system.running_endpoint or config.control
    endpoint_address = control.partition(" ")[0]
    if reason := explain_unreachable(*split_endpoint(endpoint_address, "control"), is_zeromq=True):
        yield CheckResult(f"control at {endpoint_address}", "cannot be reached", reason)
        return
    yield CheckResult(f"control at {endpoint_address}", "can be reached")
    keys: Mapping[str, Key | None] = {INSECURE: None}
    if not config.insecure:
        try:
            keys = load_local_keys() or {CLIENT: load_user_key(control=endpoint_address)}
        except UserError as error:
            yield CheckResult("keys", "cannot be used", str(error))
            return
    accepted: dict[str, Key | None] = {}
    for name, key in keys.items():
        result = _check_key(name, key, endpoint_address)
        if not result.remedy:
            accepted[name] = key
        yield result
    if not accepted:
        return
    key = next(iter(accepted.values()))
    try:
        with connect_client(
            with_key(endpoint_address, key.control if key else ""), key=key, timeout_s=5.0
        ) as client:
            services = client.status().services
    except UserError as error:
        yield CheckResult("status", "control does not report it", str(error))
        return
    is_one_host = is_loopback(split_endpoint(endpoint_address, "control")[0])
    with contextlib.ExitStack() as stack:
        buses = {name: stack.enter_context(Bus(key)) for name, key in accepted.items()}
        for service in services:
            yield from _check_service(service, buses, is_one_host=is_one_host)
    for name in REQUIRED_SERVICES:
        if name not in {service.service for service in services}:
            yield CheckResult(
                name, "is not running", f"start it: kouxing {name} --config kouxing.toml"
            )


def _check_key(name: str, key: Key | None, address: str) -> CheckResult:
    control = with_key(address, key.control if key else "")
    try:
        with Bus(key) as bus:
            result = bus.probe(control)
    except UserError as error:
        return CheckResult(f"key {name}", "cannot be used", str(error))
    if result is ProbeResult.ACCEPTED:
        return CheckResult(f"key {name}", "control accepts it")
    controls = [system.control for system in running_systems() if system.address == address]
    if key is not None and controls and controls[0] not in (address, control):
        return CheckResult(
            f"key {name}",
            "belongs to a different system than this control",
            "set XDG_STATE_HOME to the same folder as for 'kouxing run'",
        )
    return CheckResult(
        f"key {name}",
        "control does not accept it",
        rejection_hint(control, name, _default_roles(name)),
    )


def _default_roles(name: str) -> Collection[str]:
    return KINDS[name].key_roles if name in KINDS else CLIENT_ROLES


def _check_service(
    service: ServiceState, buses: Mapping[str, Bus], *, is_one_host: bool
) -> Iterator[CheckResult]:
    problems = []
    if service.age_s > MAX_AGE_S:
        problems.append(f"silent for {service.age_s:.0f} s; look at its log")
    if abs(service.clock_offset_ms) > MAX_CLOCK_OFFSET_MS:
        problems.append(
            f"its clock differs from control's by {service.clock_offset_ms / 1000:.1f} s; turn on"
            " time synchronization (NTP) on both machines"
        )
    if service.build and service.build != version("kouxing"):
        problems.append(
            f"it runs kouxing {service.build}, this machine {version('kouxing')}; install the"
            " same version"
        )
    for name, endpoint in service.endpoints.items():
        address = endpoint.partition(" ")[0]
        if not _concerns_host(service.service, name, endpoint, buses, is_one_host=is_one_host):
            continue
        if problem := _endpoint_problem(name, endpoint, buses, is_one_host=is_one_host):
            problems.append(f"{name} at {address}: {problem}")
    endpoints = plural(len(service.endpoints), "endpoint")
    about = f"{endpoints}, clock {service.clock_offset_ms:+z.0f} ms"
    yield CheckResult(service.instance, about, "\n".join(problems))


def _concerns_host(
    service: str, name: str, endpoint: str, keys: Collection[str], *, is_one_host: bool
) -> bool:
    """Return whether programs of this host provide or use an endpoint.

    ``keys`` are the names of this host's keys. A service's key has the name of the service.
    """
    if INSECURE in keys or service in keys:
        return True
    if any(name in KINDS[key].needs for key in keys if key in KINDS):
        return True
    if not any(CLIENT in _default_roles(key) for key in keys):
        return False
    if endpoint.startswith("http"):  # by default, the page is only for browsers of its own host
        return is_one_host or not is_loopback(urlsplit(endpoint).hostname or "")
    return name in CLIENT_NEEDS


def _endpoint_problem(
    name: str, endpoint: str, buses: Mapping[str, Bus], *, is_one_host: bool
) -> str:
    if endpoint.startswith("http"):
        page = urlsplit(endpoint)
        default = 443 if page.scheme == "https" else 80
        return explain_unreachable(page.hostname or "", str(page.port or default))
    host, port = split_endpoint(endpoint.partition(" ")[0], name)
    if reason := explain_unreachable(host, port, is_zeromq=True):
        if is_loopback(host) and not is_one_host:
            return (
                "only its own host can connect; set this key of the service to tcp://0.0.0.0:PORT"
            )
        return reason
    is_publisher = name in PUBLISHERS
    for key_name, bus in buses.items():
        roles = {role.partition(":")[0] for role in _default_roles(key_name)}
        if not is_publisher and ROUTER_ROLES.get(name) not in roles:
            continue
        if bus.probe(endpoint, is_publisher=is_publisher) is ProbeResult.REJECTED:
            return (
                f"it does not accept the key {key_name}; check its roles with 'kouxing keys list'"
                " on control's machine, or restart the service"
            )
    return ""
