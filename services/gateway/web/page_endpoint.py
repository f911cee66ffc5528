"""Determines the page's URL, certificate and access policy from the configuration."""

import socket
import ssl
from dataclasses import dataclass
from urllib.parse import quote

from kouxing_client.field_types import MAX_ENDPOINT

from kouxing.services.gateway.config import GatewayConfig
from kouxing.services.gateway.web.access import AccessPolicy
from kouxing.shared.errors import UserError
from kouxing.shared.settings.endpoints import WILDCARDS, is_address, is_loopback


@dataclass(frozen=True, slots=True)
class PageEndpoint:
    """Address and access policy of the page."""

    url: str
    """The page's URL, with the token if one is required."""
    tls: ssl.SSLContext | None
    """TLS context for https; None for http."""
    access: AccessPolicy


def make_page_endpoint(config: GatewayConfig, port: int) -> PageEndpoint:
    """Return the endpoint that a configuration describes, on a port that is already bound.

    Raises ``UserError`` if the certificate can neither be read nor created, or the URL is too long
    for the messages in which the gateway reports it.
    """
    host = config.advertise or (config.advertised_host if config.host in WILDCARDS else config.host)
    token = config.page_token()
    local_name = socket.gethostname().removesuffix(".local")  # macOS includes it
    own_names = (host, local_name, f"{local_name}.local", *config.names)
    names = {name.lower() for name in own_names}  # as `AccessPolicy` gets a request's host
    tls = None
    if config.certificate:
        from kouxing.services.gateway.web.certificate import load_tls_context

        tls = load_tls_context(config.certificate, [*sorted(names), "localhost", "127.0.0.1"])
    address = f"{f'[{host}]' if ':' in host else host}:{port}"
    fragment = f"#token={quote(token)}" if token else ""
    access = AccessPolicy(
        is_gateway_host=lambda name: (
            is_loopback(name)
            or name in names
            or (not is_loopback(config.host) and is_address(name))
        ),
        token=token,
        trusted_origins=config.trusted_origins,
        proxy_schemes=("https",) if config.is_behind_proxy else (),
    )
    url = f"{'https' if tls else 'http'}://{address}/{fragment}"
    if len(url) > MAX_ENDPOINT:
        raise UserError(
            f"gateway.token: the page's URL would have {len(url)} characters, more than"
            f" {MAX_ENDPOINT}; use a shorter token"
        )
    return PageEndpoint(url, tls, access)
