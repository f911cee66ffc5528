"""Targets, programs that receive the face: ``PROTOCOL://HOST:PORT?OPTION=VALUE``."""

from collections.abc import Mapping
from dataclasses import dataclass

from kouxing.shared.errors import UserError
from kouxing.shared.settings.endpoints import is_loopback

MAX_DELAY_MS = 10_000.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Target:
    """A program that receives the face."""

    url: str  # its address with all options
    protocol: str  # one of ``protocols.protocols``
    frame_contents: str  # what a frame contains; empty: the shapes
    host: str
    port: int
    options: Mapping[str, str]  # options of the protocol
    delay_s: float = 0.0  # additional delay of each frame

    @property
    def key(self) -> tuple[str, str, int]:
        """Identifies the target: two targets with one key are the same program."""
        return self.protocol, self.host, self.port

    @property
    def is_mouth_only(self) -> bool:
        """Whether another program controls eyes, brows and head."""
        return self.options["only"] == "mouth"

    @property
    def shapes(self) -> str:
        """Name of the shape set to send."""
        return self.options.get("shapes", "arkit")

    @property
    def contents(self) -> str:
        """Description of what the target receives."""
        names = {"arkit": "ARKit shapes", "vrm": "VRM shapes", "oculus": "Oculus visemes"}
        contents = self.frame_contents or names[self.shapes]
        if self.is_mouth_only:
            contents += " of the mouth"
        elif self.options.get("head", "on") == "on":
            contents += " and head"
        return contents

    @property
    def expression_hint(self) -> str:
        """How the target gets expressions such as joy; empty if it gets them, or needs none."""
        if self.shapes == "arkit" or self.is_mouth_only:
            return ""
        return (
            "these shapes do not move brows or cheeks, so joy and anger hardly show; if the"
            " avatar has ARKit's shapes, add ?shapes=arkit to the address"
        )

    @property
    def is_local(self) -> bool:
        """Whether the target, and the tracker if any, are on this machine."""
        return is_loopback(self.host) and (
            self.tracker_address is None or is_loopback(self.tracker_address[0])
        )

    @property
    def tracker_address(self) -> tuple[str, int] | None:
        """Address and port on which a tracker's packets arrive, if any."""
        option = self.options.get("camera", "")
        return parse_tracker_address(option) if option else None


class TrackerPortError(UserError):
    """The tracker's packets arrive at the port of the target itself."""

    def __init__(self, port: int) -> None:
        super().__init__(
            f"camera={port} is the port of the avatar program itself; choose another port,"
            " and set the tracker to send to it"
        )


def is_host(text: str) -> bool:
    """Return whether a text can be a host: no part of a name is empty or longer than 63 bytes."""
    try:
        text.encode("idna")  # as when the name is resolved
    except UnicodeError:
        return False
    return True


def parse_tracker_address(option: str) -> tuple[str, int]:
    """Return the address and port of ``PORT`` (this machine only) or ``ADDRESS:PORT``.

    Raises ``UserError`` if the port is not a number from 1 to 65535, or the address is invalid.
    """
    host, _, port = option.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")  # of an IPv6 address
    is_port = port.isascii() and port.isdecimal() and 0 < int(port) < 1 << 16
    if not (is_port and is_host(host)):
        raise UserError(f"camera must be a port such as 39541, or ADDRESS:PORT, not {option!r}")
    return host or "127.0.0.1", int(port)


def parse_delay_s(delay_ms: str | float) -> float:
    """Return a delay in seconds.

    Raises ``UserError`` if the value is not a number or is out of range. A value between 0 and 1 is
    out of range, because it is surely in seconds.
    """
    try:
        number = float(delay_ms)
    except (ValueError, OverflowError):
        number = -1.0
    if number != 0.0 and not 1.0 <= number <= MAX_DELAY_MS:
        raise UserError(
            f"the delay must be 0 or 1 to {MAX_DELAY_MS:g} ms, not {delay_ms!r};"
            " a value in seconds must be multiplied by 1000"
        )
    return number / 1e3
