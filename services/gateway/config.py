"""The gateway's configuration."""

import re
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

from kouxing.services.heads import HeadConfig
from kouxing.shared.errors import UserError
from kouxing.shared.settings.config import BoundHost, BoundPort, Check, HostNames, ValueHint

ADDRESS_SHARE = 0.75  # maximum fraction of each quota for one address, which may be a proxy
_ORIGIN = re.compile(r"https?://[A-Za-z0-9.-]+(:\d{1,5})?|https?://\[[0-9a-fA-F:]+\](:\d{1,5})?")


def _check_origin(origin: str) -> str:
    if not _ORIGIN.fullmatch(origin):
        raise ValueError
    return origin.lower()  # as browsers send it


def _check_https(value: str) -> str:
    text = value.strip().lower()
    if text in {"true", "false", "yes", "no", "on", "off", "0", "1"}:
        raise ValueError
    return "proxy" if text == "proxy" else value


def _check_target(url: str) -> str:
    # every command loads this module, and senders import NumPy
    from kouxing.services.senders.protocols import parse_target  # noqa: PLC0415

    try:
        parse_target(url)
    except UserError as error:
        raise ValueError(str(error)) from None
    return url


Origins = Annotated[
    tuple[Annotated[str, Check(_check_origin)], ...],
    ValueHint("a list of origins such as https://example.org"),
]
Targets = Annotated[
    tuple[Annotated[str, Check(_check_target)], ...],
    ValueHint("a list of addresses such as vmc://127.0.0.1:39540"),
]


@dataclass(frozen=True, kw_only=True)
class GatewayConfig(HeadConfig):
    """Configuration keys of the gateway."""

    safe_alternative: ClassVar[str] = (
        "bind a loopback address, serve https with gateway.https=kouxing.pem (the file is "
        "created), or serve http to an encrypting proxy with gateway.https=proxy"
    )

    host: BoundHost = "127.0.0.1"
    """Address at which the page is served."""
    port: BoundPort = 8080
    """Port at which the page is served; 0 uses any free port."""
    https: Annotated[
        str,
        Check(_check_https),
        ValueHint("empty, proxy, or the path of a PEM file such as kouxing.pem"),
    ] = ""
    """Path of a PEM file with a certificate and its private key. If the file does not exist, the
    gateway creates it with a self-signed certificate. "proxy" serves http at an address that only
    an encrypting proxy or this machine can reach. If empty, http is served only on this machine."""
    token: str = ""
    """Secret that the page's address must contain. If empty, the gateway creates a token when
    https is set."""
    names: HostNames = ()
    """Additional host names of the page, such as a proxy's."""
    trusted_origins: Origins = ()
    """Origins of other pages that may connect to the gateway's sessions and embed this page in a
    frame."""
    senders: Targets = ()
    """Programs to send the face to: vmc://, livelink://, osc:// and vts:// addresses, as for
    'kouxing send'."""

    @property
    def is_encrypted(self) -> bool:
        """Whether traffic from other machines is encrypted, here or by a proxy."""
        return bool(self.https)

    def page_token(self) -> str:
        """Return the configured token, a new one if traffic is encrypted, or else an empty one."""
        return self.token or (secrets.token_urlsafe(16) if self.is_encrypted else "")

    @property
    def is_behind_proxy(self) -> bool:
        """Whether a proxy encrypts the traffic from other machines."""
        return self.https == "proxy"

    @property
    def certificate(self) -> Path | None:
        """The PEM file for https; None for http."""
        return Path(self.https) if self.https and not self.is_behind_proxy else None

    @property
    def address_share(self) -> float:
        """Maximum fraction of a connection quota for one address; 1 if it is a proxy's."""
        return 1.0 if self.is_behind_proxy else ADDRESS_SHARE
