"""The gateway's configuration."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Field

from kouxing.services.gateway.places import ADDRESS_SHARE
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
    """The gateway's own keys."""

    safer: ClassVar[str] = (
        "bind a loopback address, or serve https with gateway.certificate=kouxing.pem "
        "(a new file is made), or plain http to a proxy with gateway.plain_http = true"
    )

    host: BoundHost = "127.0.0.1"
    """Address at which the page is served."""
    port: BoundPort = 8080
    """Port at which the page is served; 0 takes a free one."""
    vosk_port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Port at which clients of vosk-server find it under no path, 2700 as a rule; 0: none, they
    reach it under the page's address as /vosk."""
    head: str = ""
    """Another head for the page: a GLB that 'kouxing head export' wrote."""
    certificate: str = ""
    """PEM file with a certificate and its private key, for https; if there is no such file, a
    self-signed certificate is written there."""
    token: str = ""
    """Secret that the page's address carries; with a certificate or plain_http one is made if this
    is empty."""
    plain_http: Switch = False
    """Serve an address that others can reach unencrypted: where only a proxy that encrypts, or a
    port that is published to this machine alone, leads there."""
    names: str = ""
    """Other names by which browsers reach the page, as through a proxy, separated by spaces."""
    allowed_origins: Origins = ""
    """Other pages that may connect to the page's sessions."""
    frame_ancestors: Origins = ""
    """Other pages that may show this one in a frame."""
    senders: Targets = ""
    """Programs that the face is sent to: vmc://, livelink://, osc:// and vts:// as of
    'kouxing send'."""

    @property
    def is_encrypted(self) -> bool:
        """Whether what others can reach is encrypted, here or by a proxy."""
        return bool(self.certificate) or self.plain_http

    @property
    def address_share(self) -> float:
        """How many of the places one address may have: all where that is a proxy's."""
        return 1.0 if self.plain_http else ADDRESS_SHARE
