"""How browsers come in: the address that is served, its certificate, and what they must show."""

from __future__ import annotations

import secrets
import ssl
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from kouxing.services.gateway.access import Access
from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.https import own_names, tls_context
from kouxing.shared.endpoints import WILDCARDS, is_address, is_loopback, own_address


@dataclass(frozen=True, slots=True)
class Entrance:
    """What ``make_entrance`` returns."""

    url: str
    """Of the page, with the token if there is one."""
    tls: ssl.SSLContext | None
    """For https; None: http."""
    access: Access


def make_entrance(config: GatewayConfig, port: int) -> Entrance:
    """Return what the configuration says of the page that is served at a port.

    Raises
    ------
    UserError
        If the certificate can neither be read nor made.
    """
    host = config.advertise or (own_address() if config.host in WILDCARDS else config.host)
    token = config.token or (secrets.token_urlsafe(16) if config.is_encrypted else "")
    names = {host, *own_names(), *config.names.split()}
    tls = None
    if config.certificate:
        tls = tls_context(Path(config.certificate), [*sorted(names), "localhost", "127.0.0.1"])
    address = f"{f'[{host}]' if ':' in host else host}:{port}"
    secret = f"#token={quote(token)}" if token else ""
    access = Access(
        is_own_host=lambda name: (
            is_loopback(name)
            or name in names
            or (not is_loopback(config.host) and is_address(name))
        ),
        token=token,
        allowed_origins=config.allowed_origins.split(),
    )
    return Entrance(f"{'https' if tls else 'http'}://{address}/{secret}", tls, access)
