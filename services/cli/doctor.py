"""``kouxing doctor``: checks the keys, addresses, clocks and versions of a system from here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib.metadata import version
from typing import NamedTuple
from urllib.parse import urlsplit

from kouxing_client import ServiceState
from kouxing_client.keys import Key

from kouxing.services.cli.clients import find_system
from kouxing.services.kinds import KINDS
from kouxing.shared.bus import Bus, Reach
from kouxing.shared.control_client import connect
from kouxing.shared.endpoints import reach_error, split_endpoint, with_key
from kouxing.shared.errors import UserError
from kouxing.shared.keys import CLIENT, CLIENT_ROLES, local_keys, rejection_hint, user_key
from kouxing.shared.terminal import plural

MAX_CLOCK_OFFSET_MS = 1000.0
MAX_AGE_S = 2.0  # of the newest heartbeat
MIN_SERVICES = ("control", "recognizer", "synthesizer")  # without them, no face moves
# Endpoints that accept every allowed key; only services use the others.
PUBLISHERS = ("phones", "faps", "events")
ROUTERS = ("audio", "unpaced_audio")


class Finding(NamedTuple):
    """The result of one check."""

    subject: str
    result: str
    fix: str = ""  # empty: the check passed


def examine(given: str) -> Iterator[Finding]:
    """Yield the result of each check; ``given`` is the address of control, empty by default."""
    control, config = find_system(given)
    control = control or config.control
    address = control.partition(" ")[0]
    if reason := reach_error(*split_endpoint(address, "control")):
        yield Finding(f"control at {address}", "cannot be reached", reason)
        return
    yield Finding(f"control at {address}", "can be reached")
    keys: Mapping[str, Key | None] = {"none": None}
    if not config.insecure:
        try:
            keys = local_keys() or {CLIENT: user_key(control=address)}
        except UserError as error:
            yield Finding("keys", "cannot be used", str(error))
            return
    accepted: list[tuple[Key | None, str]] = []
    for name, key in keys.items():
        endpoint = with_key(address, key.control if key else "")
        finding = _check_key(name, key, endpoint)
        if not finding.fix:
            accepted.append((key, endpoint))
        yield finding
    if not accepted:
        return
    key, endpoint = accepted[0]
    try:
        with connect(endpoint, key=key, timeout_s=5.0) as client:
            services = client.status().services
    except UserError as error:
        yield Finding("status", "control does not answer", str(error))
        return
    with Bus(key) as bus:
        for service in services:
            yield from _check_service(service, bus)
    for name in MIN_SERVICES:
        if name not in {service.service for service in services}:
            yield Finding(name, "is not running", f"start it: kouxing {name} --config kouxing.toml")


def _check_key(name: str, key: Key | None, control: str) -> Finding:
    with Bus(key) as bus:
        reach = bus.probe(control)
    if reach is Reach.ACCEPTED:
        return Finding(f"key {name}", "control accepts it")
    roles = KINDS[name].key_roles if name in KINDS else CLIENT_ROLES
    return Finding(
        f"key {name}", "control does not accept it", rejection_hint(control, name, roles)
    )


def _check_service(service: ServiceState, bus: Bus) -> Iterator[Finding]:
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
        if problem := _endpoint_problem(name, endpoint, bus):
            problems.append(f"{name} at {address}: {problem}")
    endpoints = plural(len(service.endpoints), "endpoint")
    about = f"{endpoints}, clock {service.clock_offset_ms:+.0f} ms"
    yield Finding(service.instance, about, "\n".join(problems))


def _endpoint_problem(name: str, endpoint: str, bus: Bus) -> str:
    if endpoint.startswith("http"):
        page = urlsplit(endpoint)
        default = 443 if page.scheme == "https" else 80
        return reach_error(page.hostname or "", str(page.port or default))
    if reason := reach_error(*split_endpoint(endpoint.partition(" ")[0], name)):
        return reason
    if name not in (*PUBLISHERS, *ROUTERS):
        return ""
    if bus.probe(endpoint, is_publisher=name in PUBLISHERS) is Reach.REFUSED:
        return "it does not accept this machine's key; restart the service, or look at its log"
    return ""
