"""The gateway's configuration."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

from pydantic import AfterValidator

from shared.config import BoundHost, BoundPort, Form, ServiceConfig

_ORIGIN = re.compile(r"https?://[A-Za-z0-9.-]+(:\d{1,5})?|https?://\[[0-9a-fA-F:]+\](:\d{1,5})?")


def _check_origins(value: str) -> str:
    if not all(_ORIGIN.fullmatch(origin) for origin in value.split()):
        raise ValueError
    return value


Origins = Annotated[
    str,
    AfterValidator(_check_origins),
    Form("origins such as https://example.org, separated by spaces"),
]


class GatewayConfig(ServiceConfig):
    """The gateway's own keys."""

    safer: ClassVar[str] = (
        "bind a loopback address, or serve https with gateway.certificate=kouxing.pem "
        "(a new file is made)"
    )

    host: BoundHost = "127.0.0.1"
    """Address at which the page is served."""
    port: BoundPort = 8080
    """Port at which the page is served; 0 takes a free one."""
    head: str = ""
    """Another head for the page: a GLB that 'kouxing head export' wrote."""
    certificate: str = ""
    """PEM file with a certificate and its private key, for https; if there is no such file, a
    self-signed certificate is written there."""
    token: str = ""
    """Secret that the page's address carries; with a certificate one is made if this is empty."""
    names: str = ""
    """Other names by which browsers reach the page, as through a proxy, separated by spaces."""
    allowed_origins: Origins = ""
    """Other pages that may connect to the page's sessions."""
    frame_ancestors: Origins = ""
    """Other pages that may show this one in a frame."""

    @property
    def is_encrypted(self) -> bool:
        """Whether what others can reach is encrypted, and needs a token."""
        return bool(self.certificate)
