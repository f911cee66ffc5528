"""Lists the sender protocols, and parses target addresses.

Other distributions add protocols by entry points of the group ``kouxing.senders``. The entry point
has the name of the protocol. Its value is the ``package:Class`` of a ``TargetConnection``.
"""

import ipaddress
import re
from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from pkgutil import resolve_name
from urllib.parse import SplitResult, parse_qsl, quote, urlsplit, urlunsplit

from kouxing.services.senders.connection import TargetConnection
from kouxing.services.senders.live_link import LiveLinkConnection
from kouxing.services.senders.osc import OscConnection
from kouxing.services.senders.target import Target, TrackerPortError, is_host, parse_delay_s
from kouxing.services.senders.vmc import VmcConnection
from kouxing.services.senders.vtube_studio import VTubeStudioConnection
from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.plugins import plugins
from kouxing.shared.settings.endpoints import is_loopback

LOOPBACK = "127.0.0.1"
MAX_TEXT = 64  # characters of an option without fixed values
ENTRY_POINTS = "kouxing.senders"
_BUILT_IN: dict[str, type[TargetConnection]] = {
    "vmc": VmcConnection,
    "livelink": LiveLinkConnection,
    "osc": OscConnection,
    "vts": VTubeStudioConnection,
}


@lru_cache
def protocols() -> dict[str, type[TargetConnection]]:
    """Return the installed protocols by name. Faulty ones are logged and left out."""
    installed = dict(_BUILT_IN)
    for name, reference in plugins(ENTRY_POINTS).items():
        try:
            connection = resolve_name(reference)
            if not issubclass(connection, TargetConnection):
                raise TypeError(f"{reference} is not a TargetConnection")
            installed[name] = connection
        except Exception as error:  # code of another distribution may raise any exception
            LOG.warning("cannot import the sender protocol %s from %s: %s", name, reference, error)
    return installed


def make_connection(target: Target) -> TargetConnection:
    """Return a connection to a target; ``run`` opens it."""
    return protocols()[target.protocol](target)


def parse_target(url: str) -> Target:
    """Return the target of an address such as ``vmc://127.0.0.1:39540?delay=120``.

    Raises ``UserError`` if the address is not valid; the text says what is expected.
    """
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or LOOPBACK, parts.port
    except ValueError:
        raise _address_error(url) from None
    host = _normalize_host(host)
    protocol = protocols().get(parts.scheme)
    is_bare = parts.path in ("", "/") and not parts.fragment and parts.username is None
    is_readable = url.isprintable() and " " not in url
    if protocol is None or not is_bare or port == 0 or not is_readable or not is_host(host):
        raise _address_error(url)
    options = _parse_options(url, parts.query, protocol)
    try:
        target = Target(
            url=_normalize(parts, host, options, protocol),
            protocol=parts.scheme,
            frame_contents=protocol.contents,
            host=host,
            port=port or protocol.default_port,
            options=options,
            delay_s=parse_delay_s(options["delay"]),
        )
        _check_combination(target)
    except UserError as error:
        raise UserError(f"{url}: {error}") from None
    return target


def change_delay(target: Target, delay_s: float) -> Target:
    """Return a copy of a target with a new delay, which its address also shows."""
    options = {**target.options, "delay": f"{1e3 * delay_s:g}"}
    protocol = protocols()[target.protocol]
    url = _normalize(urlsplit(target.url), target.host, options, protocol)
    return replace(target, url=url, options=options, delay_s=delay_s)


def _normalize_host(host: str) -> str:
    try:
        return str(ipaddress.ip_address(host))
    except ValueError:
        return LOOPBACK if host == "localhost" else host


def _normalize(
    parts: SplitResult, host: str, options: Mapping[str, str], protocol: type[TargetConnection]
) -> str:
    """Return the canonical form of an address: with the host, and without default values."""
    address = f"[{host}]" if ":" in host else host
    if parts.port not in (None, protocol.default_port):
        address += f":{parts.port}"
    query = "&".join(
        f"{name}={re.sub('[%&+# ]', lambda found: quote(found[0]), value)}"  # others stay readable
        for name, value in options.items()
        if value != protocol.options[name].default
    )
    return urlunsplit((parts.scheme, address, "", query, ""))


def _address_error(url: str) -> UserError:
    *others, last = (f"{name}://HOST:{kind.default_port}" for name, kind in protocols().items())
    forms = f"{', '.join(others)} or {last}"
    return UserError(f"{url!r} is not a valid address; write {forms}")


def _check_combination(target: Target) -> None:
    if target.is_mouth_only and target.options.get("head") == "on":
        raise UserError("only=mouth lets another program control the head; leave out head=on")
    if (
        target.tracker_address is not None
        and is_loopback(target.host)
        and target.tracker_address[1] == target.port
    ):
        raise TrackerPortError(target.port)


def _parse_options(url: str, query: str, protocol: type[TargetConnection]) -> dict[str, str]:
    options = {name: option.default for name, option in protocol.options.items()}
    for name, value in parse_qsl(query, keep_blank_values=True):
        if name not in options:
            raise UserError(f"{url}: unknown option {name!r}; use {', '.join(options)}")
        choices = protocol.options[name].choices
        if choices and value not in choices:
            raise UserError(f"{url}: {name} must be {' or '.join(choices)}")
        if not value.isprintable():
            raise UserError(f"{url}: {name} contains a character that is not printable")
        if len(value) > MAX_TEXT:
            raise UserError(f"{url}: {name} is longer than {MAX_TEXT} characters")
        options[name] = value
    if not options.get("prefix", "").startswith("/") and options.get("prefix"):
        raise UserError(f"{url}: prefix must start with '/'")
    return options
