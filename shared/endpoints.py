"""Addresses: what an endpoint looks like, and who can reach it."""

from __future__ import annotations

import contextlib
import ipaddress
import re
import socket

from kouxing.shared.errors import UserError

WILDCARDS = {"*", "0.0.0.0", "[::]"}  # noqa: S104 - named to be recognised, not bound
_ENDPOINT = re.compile(
    r"tcp://(?P<host>\[[0-9a-fA-F:]{2,45}\]|\*|\w[\w.-]{0,189}):(?P<port>\d{1,5}|\*)", re.ASCII
)


def split_endpoint(endpoint: str, key: str) -> tuple[str, str]:
    """Return host and port of ``tcp://host:port``.

    Raises
    ------
    UserError
        Naming the configuration key, if the endpoint is not of that form.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or (match["port"] != "*" and int(match["port"]) > 65535):
        raise UserError(f"{key}: {endpoint!r} is no endpoint; write tcp://HOST:PORT")
    return match["host"], match["port"]


def is_address(host: str) -> bool:
    """Return whether a host is given by its IP address, not by a name."""
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Return whether a host name or address can only be reached from this machine."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def with_host(endpoint: str, host: str) -> str:
    """Return an endpoint at another host, given by name or address."""
    _, port = split_endpoint(endpoint, "endpoint")
    if ":" in host and not host.startswith("["):
        host = f"[{host}]"
    return f"tcp://{host}:{port}"


def own_address(towards: str = "192.0.2.1") -> str:
    """Return the address of this host from which it would connect to another; nothing is sent.

    Parameters
    ----------
    towards
        Name or address of the other host; by default one of no network of its own (RFC 5737).
        Where no way leads there, the way to that one counts, then 127.0.0.1.
    """
    for host in dict.fromkeys((towards, "192.0.2.1")):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((host.strip("[]"), 9))
            address: str = probe.getsockname()[0]
            return address
    return "127.0.0.1"


def key_of(endpoint: str) -> str:
    """Return the public key of whom is bound at an endpoint; empty where all is plain."""
    return endpoint.partition(" ")[2]


def with_key(endpoint: str, public_key: str) -> str:
    """Return an endpoint as sockets take it: with the key of whom is bound there, if it has one."""
    return f"{endpoint} {public_key}" if public_key else endpoint
