"""Addresses: what an endpoint looks like, and who can reach it."""

from __future__ import annotations

import ipaddress
import re

from shared.errors import UserError

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


def reachable(endpoint: str, advertise: str, key: str) -> str:
    """Return the endpoint that others connect to for one that was bound."""
    host, port = split_endpoint(endpoint, key)
    return f"tcp://{advertise or host}:{port}"


def key_of(endpoint: str) -> str:
    """Return the public key of whom is bound at an endpoint; empty where all is plain."""
    return endpoint.partition(" ")[2]


def with_key(endpoint: str, public_key: str) -> str:
    """Return an endpoint as sockets take it: with the key of whom is bound there, if it has one."""
    return f"{endpoint} {public_key}" if public_key else endpoint
