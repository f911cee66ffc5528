"""Parses endpoints, and classifies their hosts."""

import contextlib
import ipaddress
import re
import socket

from kouxing.shared.errors import UserError

WILDCARDS = {"*", "0.0.0.0", "[::]"}  # noqa: S104 - compared, not bound
_INTERNET = ("192.0.2.1", "2001:db8::1")  # any addresses that are reached over the default route
_ENDPOINT = re.compile(
    r"tcp://(?P<host>\[[0-9a-fA-F:]{2,45}\]|\*|\w[\w.-]{0,189}):(?P<port>\d{1,5}|\*)", re.ASCII
)


def split_endpoint(endpoint: str, key: str) -> tuple[str, str]:
    """Return host and port of ``tcp://host:port``.

    Raises ``UserError`` if the endpoint has another form. The error names the configuration key.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or (match["port"] != "*" and int(match["port"]) > 65535):
        raise UserError(f"{key}: {endpoint!r} is not an endpoint; write tcp://HOST:PORT")
    return match["host"], match["port"]


def is_address(host: str) -> bool:
    """Return whether a host is an IP address rather than a name."""
    try:
        ipaddress.ip_address(host.strip("[]"))
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host name or address."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def is_local(host: str) -> bool:
    """Return whether a host name or address belongs to this machine.

    Raises ``UserError`` if the name is unknown.
    """
    if host in WILDCARDS:
        return True
    try:
        addresses = socket.getaddrinfo(host.strip("[]"), None, type=socket.SOCK_DGRAM)
        for family, kind, _, _, address in addresses:
            with socket.socket(family, kind) as probe:
                probe.bind(address)
    except (socket.gaierror, UnicodeError):  # UnicodeError: a label of the name is too long
        raise UserError(
            f"control's host name {host!r} is unknown; correct it, or write an IP address"
        ) from None
    except OSError:  # the address of another machine
        return False
    return True


def with_host(endpoint: str, host: str) -> str:
    """Replace the host of an endpoint with another name or address."""
    _, port = split_endpoint(endpoint, "endpoint")
    if ":" in host and not host.startswith("["):
        host = f"[{host}]"
    return f"tcp://{host}:{port}"


def local_address(destination: str = _INTERNET[0]) -> str:
    """Return the local address for connections to a host. Nothing is sent.

    Without a host, or if it cannot be reached, this is the address of the default route, or
    127.0.0.1 if there is no route.
    """
    for host in dict.fromkeys((destination, *_INTERNET)):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((host.strip("[]"), 9))
            address: str = probe.getsockname()[0]
            return address
    return "127.0.0.1"


def key_of(endpoint: str) -> str:
    """Return the public key in an endpoint, empty without encryption."""
    return endpoint.partition(" ")[2]


def with_key(endpoint: str, public_key: str) -> str:
    """Append the public key of the bound socket, if any, to an endpoint."""
    return f"{endpoint} {public_key}" if public_key else endpoint
