"""Configuration: defaults < TOML file < environment < command line.

A TOML file has one table per service (``[recognizer]``) and ``[common]`` for the keys that every
service has. The environment names a service's key ``KOUXING_<SERVICE>_<KEY>``, and a common key
also ``KOUXING_<KEY>``. A value for one service beats one for all services. A key, table or variable
that nobody knows is an error that names the nearest known one.

Each service declares its keys as a subclass of ``ServiceConfig`` in its ``config.py``. pydantic
checks types and ranges. The sources are read here: every value remembers where it came from.
"""

from __future__ import annotations

import difflib
import os
import tomllib
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from annotated_types import Ge, Le, MultipleOf
from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo

from kouxing.shared.endpoints import WILDCARDS, is_loopback, own_address, split_endpoint, with_host
from kouxing.shared.errors import UserError

PREFIX = "KOUXING_"
COMMON = "common"  # table of the keys that every service has
_BOOLEANS = {"true", "false", "1", "0"}  # pydantic would also take "yes", "on" and others


class Bound(Enum):
    """Marks a key as an address that the process binds."""

    ENDPOINT = auto()  # tcp://HOST:PORT
    HOST = auto()
    PORT = auto()


@dataclass(frozen=True, slots=True)
class Form:
    """Says in words what a value looks like, where its type does not tell."""

    text: str
    is_list: bool = False  # texts separated by spaces, or in a file a list of them


def _check_endpoint(value: str) -> str:
    try:
        split_endpoint(value, "")
    except UserError as error:
        raise ValueError(str(error)) from None
    return value


def _check_host(value: str) -> str:
    if value:
        _check_endpoint(with_host("tcp://*:*", value))
    return value


def _check_boolean(value: object) -> object:
    if isinstance(value, str) and value.lower() not in _BOOLEANS:
        raise ValueError
    return value


def _lower(value: object) -> object:
    return value.lower() if isinstance(value, str) else value


Switch = Annotated[bool, BeforeValidator(_check_boolean)]
Endpoint = Annotated[str, AfterValidator(_check_endpoint), Form("an endpoint, tcp://HOST:PORT")]
BoundEndpoint = Annotated[Endpoint, Bound.ENDPOINT]
Host = Annotated[str, AfterValidator(_check_host), Form("a host name or address")]
BoundHost = Annotated[str, Bound.HOST, Form("a host name or address")]
BoundPort = Annotated[int, Field(ge=0, le=65535), Bound.PORT]
LogLevel = Annotated[Literal["debug", "info", "warning", "error"], BeforeValidator(_lower)]


class ServiceConfig(BaseModel):
    """The keys that every service has."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    safer: ClassVar[str] = "bind a loopback address"
    """What to do instead of binding an address that others can reach."""

    control: Endpoint = "tcp://127.0.0.1:5550"
    """Where control takes commands."""
    advertise: Host = ""
    """Host name or address by which others reach this service, as behind NAT; when empty the one
    that is bound, for every address (0.0.0.0) this host's own on the way to control."""
    insecure: Switch = False
    """Let services and clients talk unencrypted, to anybody; docs/security.md says what that gives
    away."""
    log_level: LogLevel = "info"
    """Least level of the log lines that are written."""
    instance: str = ""
    """Name of this process; chosen when empty."""
    metrics_port: Annotated[int, Field(ge=0, le=65535)] = 0
    """Port of figures for Prometheus (/metrics) and of a health check (/healthz), over plain HTTP;
    0: none. Each service on a machine needs its own."""
    metrics_host: Annotated[str, Form("a host name or address")] = "127.0.0.1"
    """Address to bind for them; 0.0.0.0 lets other machines read them."""
    idle_motion_seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 3
    """Seed of blinks, gaze, brows and head motion, of what makes or shows a face; 0: none."""

    @property
    def own_host(self) -> str:
        """Host by which others reach what is bound to every address of this one."""
        host, _ = split_endpoint(self.control, "control")
        return own_address() if is_loopback(host) else own_address(host)

    def reachable(self, endpoint: str) -> str:
        """Return the endpoint that others connect to for one that was bound."""
        host, _ = split_endpoint(endpoint, "endpoint")
        own = self.own_host if host in WILDCARDS and not self.advertise else host
        return with_host(endpoint, self.advertise or own)

    @property
    def is_encrypted(self) -> bool:
        """Whether what others can reach is encrypted."""
        return False


Config = TypeVar("Config", bound=ServiceConfig)


@dataclass(frozen=True, slots=True)
class Given:
    """A value as it was given."""

    text: str
    origin: str


Layer = dict[str, dict[str, Given]]  # what one source gives, by table and key


@dataclass(frozen=True, slots=True)
class Setting:
    """One key of one service, with its present value."""

    key: str
    value: object
    origin: str  # "default", a file, $VARIABLE or --set
    default: object
    allowed: str
    meaning: str


class Settings:
    """What a file and the environment say about the services.

    Parameters
    ----------
    types
        Each service's own keys, by the service's name.
    file
        A TOML file, if there is one.
    environment
        Defaults to the process's own.
    assignments
        Values from the command line, by ``service.key``.

    Raises
    ------
    UserError
        If the file cannot be read, or a table, key or variable is unknown.
    """

    def __init__(
        self,
        types: Mapping[str, type[ServiceConfig]],
        *,
        file: Path | None = None,
        environment: Mapping[str, str] | None = None,
        assignments: Mapping[str, str] | None = None,
    ) -> None:
        self._tables: dict[str, type[ServiceConfig]] = {COMMON: ServiceConfig, **types}
        self._layers = (
            {} if file is None else _read_file(file, self._tables),
            _read_environment(os.environ if environment is None else environment, self._tables),
            _read_assignments(assignments or {}, self._tables),
        )

    def load(self, config_type: type[Config], overrides: Mapping[str, str] | None = None) -> Config:
        """Return the checked configuration of a service.

        Parameters
        ----------
        config_type
            Class of the service's keys, or ``ServiceConfig`` for a client.
        overrides
            Values from the command line, by key.

        Raises
        ------
        UserError
            Naming the key, the value, what is allowed, and where the value came from.
        """
        return self._resolve(config_type, overrides or {})[0]

    def describe(
        self, config_type: type[ServiceConfig], overrides: Mapping[str, str] | None = None
    ) -> list[Setting]:
        """Return all keys of a service with their present values; raises as ``load``."""
        config, given = self._resolve(config_type, overrides or {})
        return [
            Setting(
                key=key,
                value=getattr(config, key),
                origin=given[key].origin if key in given else "default",
                default=field.default,
                allowed=allowed(field),
                meaning=" ".join((field.description or "").split()),
            )
            for key, field in config_type.model_fields.items()
        ]

    def _resolve(
        self, config_type: type[Config], overrides: Mapping[str, str]
    ) -> tuple[Config, dict[str, Given]]:
        table = next(name for name, each in self._tables.items() if each is config_type)
        given: dict[str, Given] = {}
        for layer in self._layers:
            given |= layer.get(COMMON, {})
            given |= layer.get(table, {})
        for key, text in overrides.items():
            if key not in config_type.model_fields:
                nearest = _nearest(key, config_type.model_fields)
                raise UserError(f"--set {key}: {table} has no such key; {nearest}")
            given[key] = Given(text, "--set")
        try:
            config = config_type.model_validate_strings({k: g.text for k, g in given.items()})
        except ValidationError as error:
            key = str(error.errors()[0]["loc"][0])
            raise _refusal(table, key, given[key], config_type) from None
        _check_addresses(table, config)
        return config, given


def variable(table: str, key: str) -> str:
    """Return the environment variable of a service's key, or of a common key for all services."""
    return PREFIX + (key if table == COMMON else f"{table}_{key}").upper()


def allowed(field: FieldInfo) -> str:
    """Say in words which values a key takes, such as "a whole number from 1 to 20"."""
    kind = field.annotation
    marks: dict[type, Any] = {type(mark): mark for mark in field.metadata}
    if Form in marks:
        return str(marks[Form].text)
    if typing.get_origin(kind) is Literal:
        return f"one of {', '.join(typing.get_args(kind))}"
    if isinstance(kind, type) and issubclass(kind, StrEnum):
        return f"one of {', '.join(kind)}"
    if kind is bool:
        return "true or false"
    if kind is str:
        return "text"
    number = "a number" if kind is float else "a whole number"
    if MultipleOf in marks:
        number = f"a multiple of {marks[MultipleOf].multiple_of}"
    return f"{number} from {marks[Ge].ge} to {marks[Le].le}"


def bound_keys(config_type: type[ServiceConfig]) -> dict[str, Bound]:
    """Return the keys that are addresses which a service binds."""
    return {
        key: mark
        for key, field in config_type.model_fields.items()
        for mark in field.metadata
        if isinstance(mark, Bound)
    }


def parse_assignments(assignments: Iterable[str]) -> dict[str, str]:
    """Split what ``--set`` takes into keys and values.

    Raises
    ------
    UserError
        If one is not ``KEY=VALUE``.
    """
    values = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals:
            raise UserError(f"--set {assignment}: write --set KEY=VALUE")
        values[key] = value
    return values


def _read_file(file: Path, tables: Mapping[str, type[ServiceConfig]]) -> Layer:
    try:
        content = tomllib.loads(file.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"--config {file}: {error}") from None
    layer: Layer = {}
    for table, entries in content.items():
        if table not in tables or not isinstance(entries, dict):
            raise UserError(f"{file}: unknown table [{table}]; {_nearest(table, tables)}")
        layer[table] = {}
        for key, value in entries.items():
            if key not in tables[table].model_fields:
                candidates = [
                    f"{name}.{each}"
                    for name, config_type in tables.items()
                    for each in config_type.model_fields
                    if table in (name, COMMON)
                ]
                name = f"{table}.{key}"
                raise UserError(f"{file}: unknown key {name}; {_nearest(name, candidates)}")
            if _is_list(tables[table], key) and isinstance(value, list):
                value = " ".join(map(str, value))  # noqa: PLW2901 - as it is written elsewhere
            text = str(value).lower() if isinstance(value, bool) else str(value)
            layer[table][key] = Given(text, str(file))
            if not isinstance(value, str | int | float):
                raise _refusal(table, key, layer[table][key], tables[table])
    return layer


def _is_list(config_type: type[ServiceConfig], key: str) -> bool:
    marks = config_type.model_fields[key].metadata
    return any(isinstance(mark, Form) and mark.is_list for mark in marks)


def _read_environment(
    environment: Mapping[str, str], tables: Mapping[str, type[ServiceConfig]]
) -> Layer:
    known = {
        variable(table, key): (table, key)
        for table, config_type in tables.items()
        for key in config_type.model_fields
    }
    layer: Layer = {}
    for name, text in environment.items():
        if name in known:
            table, key = known[name]
            layer.setdefault(table, {})[key] = Given(text, f"${name}")
        elif name.startswith(PREFIX):
            raise UserError(f"${name}: unknown variable; {_nearest(name, known)}")
    return layer


def _read_assignments(
    assignments: Mapping[str, str], tables: Mapping[str, type[ServiceConfig]]
) -> Layer:
    known = [f"{table}.{key}" for table, each in tables.items() for key in each.model_fields]
    layer: Layer = {}
    for name, text in assignments.items():
        if name not in known:
            raise UserError(f"--set {name}: there is no such key; {_nearest(name, known)}")
        table, _, key = name.partition(".")
        layer.setdefault(table, {})[key] = Given(text, "--set")
    return layer


def _refusal(table: str, key: str, given: Given, config_type: type[ServiceConfig]) -> UserError:
    return UserError(
        f"{table}.{key}: {given.text!r} (from {given.origin}) is not "
        f"{allowed(config_type.model_fields[key])}"
    )


def _nearest(name: str, known: Iterable[str]) -> str:
    """Return the hint of an error about an unknown name."""
    (nearest,) = difflib.get_close_matches(name, list(known), n=1, cutoff=0.0)
    return f"the nearest is {nearest}; 'kouxing config' lists all"


def _check_addresses(table: str, config: ServiceConfig) -> None:
    """Refuse hosts that others can reach though nothing is encrypted, as endpoints are."""
    for key, kind in bound_keys(type(config)).items():
        host = getattr(config, key)
        if kind is not Bound.HOST or is_loopback(host):
            continue
        if not config.insecure and not config.is_encrypted:
            raise UserError(
                f"{table}.{key}: {host} can be reached from other machines and nothing is "
                f"encrypted; {config.safer}, or accept the risk on a trusted network with "
                "insecure = true"
            )
