"""Where a face is sent and how: ``PROTOCOL://HOST:PORT?OPTION=VALUE``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlsplit

from kouxing.shared.endpoints import is_loopback
from kouxing.shared.errors import UserError

LOOPBACK = "127.0.0.1"
MAX_DELAY_MS = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Protocol:
    """What an address may say beside its host."""

    port: int
    """The one that such programs listen at."""
    options: Mapping[str, tuple[str, ...]]
    """Names and values, the first of which is the default; no values: any text."""


_COMMON: dict[str, tuple[str, ...]] = {"delay": ("0",), "only": ("face", "mouth")}

PROTOCOLS = {
    "vmc": Protocol(
        port=39540, options={**_COMMON, "shapes": ("vrm", "arkit"), "head": ("off", "on")}
    ),
    "livelink": Protocol(port=11111, options={**_COMMON, "name": ()}),
    "osc": Protocol(
        port=9000, options={**_COMMON, "shapes": ("arkit", "vrm", "oculus"), "prefix": ()}
    ),
    "vts": Protocol(port=8001, options=_COMMON),
}
FORMS = "vmc://HOST:39540, livelink://HOST:11111, osc://HOST:9000 or vts://HOST:8001"


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """One program that shows the face."""

    url: str
    """As it was given; names the target."""
    protocol: str
    """One of ``PROTOCOLS``."""
    host: str
    """Name or address; that of this machine if none was given."""
    port: int
    delay_s: float = 0.0
    """How much later than they could be frames are sent."""
    is_mouth_only: bool = False
    """Whether eyes, brows and head are left to another program."""
    shapes: str = "arkit"
    """Set of shapes, of ``kouxing.shared.face.shapes.SHAPE_SETS``."""
    has_head: bool = False
    """Whether the head's turn is sent as a bone's."""
    name: str = "kouxing"
    """Of the subject, in Unreal."""
    prefix: str = "/kouxing/"
    """Of each OSC address."""

    @property
    def contents(self) -> str:
        """What the target gets, in words."""
        shapes = {"arkit": "ARKit shapes", "vrm": "VRM shapes", "oculus": "Oculus visemes"}
        contents = "tracking parameters" if self.protocol == "vts" else shapes[self.shapes]
        if self.is_mouth_only:
            contents += " of the mouth"
        elif self.has_head or self.protocol != "vmc":
            contents += " and head"
        return contents

    @property
    def is_local(self) -> bool:
        """Whether the target can only be on this machine."""
        return is_loopback(self.host)


def parse_target(url: str) -> Target:
    """Return the target of an address such as ``vmc://127.0.0.1:39540?delay=120``.

    Raises
    ------
    UserError
        If it is none, saying what is expected.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        raise UserError(f"{url!r} is no address to send to; write {FORMS}") from None
    protocol = PROTOCOLS.get(parts.scheme)
    is_bare = parts.path in ("", "/") and not parts.fragment and parts.username is None
    if protocol is None or not is_bare or not url.isprintable() or " " in url:
        raise UserError(f"{url!r} is no address to send to; write {FORMS}")
    options = _options(url, parts.query, protocol)
    try:
        delay_s = parse_delay_s(options["delay"])
    except UserError as error:
        raise UserError(f"{url}: {error}") from None
    return Target(
        url=url,
        protocol=parts.scheme,
        host=host or LOOPBACK,
        port=port or protocol.port,
        delay_s=delay_s,
        is_mouth_only=options["only"] == "mouth",
        shapes=options.get("shapes", "arkit"),
        has_head=options.get("head") == "on",
        name=options.get("name") or "kouxing",
        prefix=options.get("prefix") or "/kouxing/",
    )


def _options(url: str, query: str, protocol: Protocol) -> dict[str, str]:
    options = {name: next(iter(values), "") for name, values in protocol.options.items()}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in options:
            raise UserError(f"{url}: {name!r} is no option; there are {', '.join(options)}")
        allowed = protocol.options[name]
        if len(allowed) > 1 and value not in allowed:
            raise UserError(f"{url}: {name} must be {' or '.join(allowed)}")
        options[name] = value
    if not options.get("prefix", "/").startswith("/") and options["prefix"]:
        raise UserError(f"{url}: prefix must begin with '/'")
    if len(options.get("name", "")) > 64 or len(options.get("prefix", "")) > 64:
        raise UserError(f"{url}: a name or prefix has up to 64 characters")
    return options


def parse_delay_s(delay_ms: str | float) -> float:
    """Return a delay in seconds.

    Raises
    ------
    UserError
        If it is no number, or out of range.
    """
    try:
        delay_s = float(delay_ms) / 1e3
    except (ValueError, OverflowError):
        delay_s = -1.0
    if not 0.0 <= delay_s <= MAX_DELAY_MS / 1e3:
        raise UserError(f"delay is a number of milliseconds from 0 to {MAX_DELAY_MS:g}")
    return delay_s
