"""The gateway's configuration."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

from pydantic import AfterValidator

from kouxing.services.gateway.connection_quota import ADDRESS_SHARE
from kouxing.services.senders.target import parse_target
from kouxing.shared.config import BoundHost, BoundPort, Form, ServiceConfig, Switch
from kouxing.shared.errors import UserError

_ORIGIN = re.compile(r"https?://[A-Za-z0-9.-]+(:\d{1,5})?|https?://\[[0-9a-fA-F:]+\](:\d{1,5})?")


def _check_origins(value: str) -> str:
    if not all(_ORIGIN.fullmatch(origin) for origin in value.split()):
        raise ValueError
    return value


def _check_targets(value: str) -> str:
    try:
        for url in value.split():
            parse_target(url)
    except UserError as error:
        raise ValueError(str(error)) from None
    return value


Origins = Annotated[
    str,
    AfterValidator(_check_origins),
    Form("origins such as https://example.org, separated by spaces", is_list=True),
]
Targets = Annotated[
    str,
    AfterValidator(_check_targets),
    Form("addresses such as vmc://127.0.0.1:39540, separated by spaces", is_list=True),
]


class GatewayConfig(ServiceConfig):
    """Configuration keys of the gateway."""

    safer: ClassVar[str] = (
        "bind a loopback address, serve https with gateway.certificate=kouxing.pem (the file is "
        "created), or serve plain http to a proxy with gateway.plain_http = true"
    )

    host: BoundHost = "127.0.0.1"
    """Address at which the page is served."""
    port: BoundPort = 8080
    """Port at which the page is served; 0 uses any free port."""
    head: str = ""
    """GLB file to show as the page's head, from 'kouxing head export'."""
    certificate: str = ""
    """PEM file with a certificate and its private key, for https. If the file does not exist, it is
    created with a self-signed certificate."""
    token: str = ""
    """Secret that the page's address must contain. If empty, one is created when a certificate or
    plain_http is set."""
    plain_http: Switch = False
    """Serve unencrypted http at an address that other machines can reach. Use it only behind a
    proxy that encrypts, or for a port that is published to this machine only."""
    names: str = ""
    """Other host names of the page, for example a proxy's, separated by spaces."""
    allowed_origins: Origins = ""
    """Origins of other pages that may connect to the page's sessions."""
    frame_ancestors: Origins = ""
    """Origins of other pages that may show this page in a frame."""
    senders: Targets = ""
    """Programs to send the face to: vmc://, livelink://, osc:// and vts:// addresses, as for
    'kouxing send'."""

    @property
    def is_encrypted(self) -> bool:
        """Whether traffic from other machines is encrypted, here or by a proxy."""
        return bool(self.certificate) or self.plain_http

    @property
    def address_share(self) -> float:
        """Maximum fraction of a connection quota for one address; 1 if it is a proxy's."""
        return 1.0 if self.plain_http else ADDRESS_SHARE
