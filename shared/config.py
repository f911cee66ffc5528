"""Configuration of every service: file < environment < command line.

A TOML file has one table a service (``[recognizer]``) and ``[common]`` for keys that several
share. The environment names a key ``KOUXING_<SERVICE>_<KEY>`` or, for all services,
``KOUXING_<KEY>``. An error names the key and where its value came from.
"""

from __future__ import annotations

import dataclasses
import os
import socket
import tomllib
import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from shared.bus import is_loopback, split_endpoint
from shared.errors import UserError

PREFIX = "KOUXING_"
WILDCARDS = {"*", "0.0.0.0", "[::]"}  # noqa: S104 - named to be recognised, not bound


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """What every service knows."""

    control: str = "tcp://127.0.0.1:5550"  # where control takes commands
    advertise: str = ""  # host name or address that others reach this service by
    insecure: bool = False  # allow plaintext beyond this machine
    log_level: str = "info"
    instance: str = ""  # name of this process; chosen when empty


@dataclass(frozen=True, slots=True, kw_only=True)
class ControlConfig(Config):
    """Control's own keys."""

    commands: str = "tcp://127.0.0.1:5550"
    events: str = "tcp://127.0.0.1:5551"
    max_sessions: int = 64
    idle_limit_s: float = 60.0  # a session without audio for so long is closed
    lost_after_s: float = 3.0  # a service without heartbeat for so long is lost


@dataclass(frozen=True, slots=True, kw_only=True)
class RecognizerConfig(Config):
    """The recognizer's own keys."""

    audio: str = "tcp://127.0.0.1:5560"
    phones: str = "tcp://127.0.0.1:5561"
    acoustic: str = "neural"  # model: neural, gmm, or a file
    look_ahead_ms: float = 10.0  # of the neural model: 10, 30, 60, 100 or 200
    agreement: int = 1  # frames that must agree before a unit is put out (N of Li 2011, who has 3)
    least_confidence: float = 0.9  # of each of those frames; 0 is the paper's rule


@dataclass(frozen=True, slots=True, kw_only=True)
class SynthesizerConfig(Config):
    """The synthesizer's own keys."""

    phones: str = "tcp://127.0.0.1:5570"
    faps: str = "tcp://127.0.0.1:5571"
    frame_rate_hz: float = 50.0
    look_ahead_ms: float = 160.0  # how much later than its sound a frame is made; steps of 20
    gesture_seed: int = 3  # of blinks, gaze and head motion; 0: the mouth alone moves


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverConfig(Config):
    """The driver's own keys."""

    view: str = "auto"  # window, none, or auto: a window where there is a display
    out: str = "out"  # folder for recorded videos
    head: str = "woman"  # a head of the package, an .npz, or a .glb with morph targets
    background: str = "studio"  # studio, #rrggbb, or a colour's name
    camera: str = "face"  # what fills the picture: face, head, mouth
    virtual_camera: bool = False  # also be a camera for other programs
    width_px: int = 1280
    height_px: int = 720
    frame_rate_hz: float = 25.0


@dataclass(frozen=True, slots=True, kw_only=True)
class GatewayConfig(Config):
    """The gateway's own keys."""

    host: str = "127.0.0.1"
    port: int = 8080
    head: str = ""  # another head for the page: a GLB that 'kouxing head export' wrote


SECTIONS: dict[str, type[Config]] = {
    "control": ControlConfig,
    "recognizer": RecognizerConfig,
    "synthesizer": SynthesizerConfig,
    "driver": DriverConfig,
    "gateway": GatewayConfig,
    "client": Config,
}
BINDS = {
    "control": ("commands", "events"),
    "recognizer": ("audio", "phones"),
    "synthesizer": ("phones", "faps"),
}


def load(
    section: str,
    *,
    file: Path | None = None,
    overrides: Mapping[str, str] | None = None,
    environment: Mapping[str, str] | None = None,
) -> Config:
    """Return the checked configuration of one service.

    Parameters
    ----------
    section
        A key of ``SECTIONS``.
    file
        A TOML file.
    overrides
        Values from the command line, by key.
    environment
        Defaults to the process's own.

    Raises
    ------
    UserError
        Naming the key, the value and what is allowed.
    """
    config_type = SECTIONS[section]
    environment = os.environ if environment is None else environment
    kinds = typing.get_type_hints(config_type)
    values: dict[str, object] = {}
    for table in ("common", section):
        for key, value in _read_table(file, table).items():
            if key not in kinds and table == section:
                raise UserError(f"{file}: unknown key {section}.{key}; known: {', '.join(kinds)}")
            if key in kinds:
                values[key] = _convert(value, kinds[key], f"{section}.{key} in {file}")
    for key, kind in kinds.items():
        for name in (PREFIX + key.upper(), f"{PREFIX}{section.upper()}_{key.upper()}"):
            if name in environment:
                values[key] = _convert(environment[name], kind, f"{section}.{key} in ${name}")
    for key, text in (overrides or {}).items():
        if key not in kinds:
            raise UserError(f"--set {key}: {section} has no such key; known: {', '.join(kinds)}")
        values[key] = _convert(text, kinds[key], f"{section}.{key} in --set")
    config = config_type(**values)  # type: ignore[arg-type]
    _check(section, config)
    return config


def reachable(endpoint: str, advertise: str, key: str) -> str:
    """Return the endpoint that others connect to for one that was bound."""
    host, port = split_endpoint(endpoint, key)
    return f"tcp://{advertise or host}:{port}"


def _read_table(file: Path | None, table: str) -> dict[str, object]:
    if file is None:
        return {}
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"--config {file}: {error}") from None
    for name, entry in content.items():
        if name not in (*SECTIONS, "common") or not isinstance(entry, dict):
            raise UserError(
                f"--config {file}: unknown table [{name}]; known: common, {', '.join(SECTIONS)}"
            )
    found: dict[str, object] = content.get(table, {})
    return found


def _convert(value: object, kind: type, where: str) -> object:
    try:
        if kind is bool:
            if isinstance(value, bool):
                return value
            return {"true": True, "1": True, "false": False, "0": False}[str(value).lower()]
        if kind is str and not isinstance(value, str):
            raise ValueError
        return kind(value)
    except (KeyError, ValueError, TypeError):
        expected = "true or false" if kind is bool else f"a value of type {kind.__name__}"
        raise UserError(f"{where}: {value!r} is not {expected}") from None


def _check(section: str, config: Config) -> None:
    split_endpoint(config.control, f"{section}.control")
    if config.log_level.lower() not in ("debug", "info", "warning", "error"):
        raise UserError(f"{section}.log_level: one of debug, info, warning, error")
    for key in BINDS.get(section, ()):
        name = f"{section}.{key}"
        host, _ = split_endpoint(getattr(config, key), name)
        if host in WILDCARDS and not config.advertise:
            raise UserError(
                f"{section}.advertise: name the host by which others reach {name} "
                f"({host} is every address of this host), for example {socket.gethostname()}"
            )
        _require_secure(host, name, config)
    ranges: dict[str, tuple[float, float]] = {
        "agreement": (1, 20),
        "least_confidence": (0, 1),
        "frame_rate_hz": (10, 240),
        "look_ahead_ms": (0, 300),
        "width_px": (16, 7680),
        "height_px": (16, 4320),
        "port": (0, 65535),
        "max_sessions": (1, 10000),
        "idle_limit_s": (1, 86400),
        "lost_after_s": (1, 3600),
    }
    for field in dataclasses.fields(config):
        if field.name in ranges:
            low, high = ranges[field.name]
            if not low <= getattr(config, field.name) <= high:
                raise UserError(
                    f"{section}.{field.name}: {getattr(config, field.name)} is outside "
                    f"{low:g} to {high:g}"
                )
    if isinstance(config, DriverConfig):
        if config.view not in ("auto", "window", "none"):
            raise UserError("driver.view: one of auto, window, none")
        for key in ("width_px", "height_px"):
            if getattr(config, key) % 2:
                raise UserError(f"driver.{key}: must be even, for H.264")
    if isinstance(config, GatewayConfig):
        _require_secure(config.host, "gateway.host", config)


def _require_secure(host: str, name: str, config: Config) -> None:
    if not is_loopback(host) and not config.insecure:
        raise UserError(
            f"{name}: {host} can be reached from other machines and nothing is encrypted; "
            "bind a loopback address, or accept the risk on a trusted network with insecure = true"
        )
