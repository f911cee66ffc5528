"""Configuration: defaults < TOML file < environment < command line.

A TOML file has one table per service (``[recognizer]``), and ``[common]`` for the keys of all
services. The environment variable of a key is ``KOUXING_<SERVICE>_<KEY>``, or ``KOUXING_<KEY>``
for all services. Within one source, a value for one service overrides a value for all services. An
unknown key, table or variable is an error that names the nearest known one.

Each service declares its keys as a subclass of ``ServiceConfig`` in its ``config.py``. Types and
ranges are checked with msgspec. The import of pydantic would take a quarter of the startup time of
a service. The package pydantic-settings also has no table of common keys, ignores unknown
variables, and does not report where a value came from.
"""

import ast
import dataclasses
import difflib
import inspect
import itertools
import os
import re
import textwrap
import tomllib
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, StrEnum, auto
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
from msgspec import Meta

from kouxing.shared.errors import UserError
from kouxing.shared.files.user_file import check_content, read_text
from kouxing.shared.settings.endpoints import (
    WILDCARDS,
    is_loopback,
    local_address,
    split_endpoint,
    with_host,
)

Mark = TypeVar("Mark")
PREFIX = "KOUXING_"
_MAX_FILE_BYTES = 64 << 10
_MAX_DOTS = 1000  # per line; tomllib's memory grows with the square of a key's parts
COMMON = "common"  # table of the keys of all services
_DEFAULT = "default"  # origin of a value that no source sets


class BindAddress(Enum):
    """Marks a key as an address that the process binds."""

    ENDPOINT = auto()  # tcp://HOST:PORT
    HOST = auto()
    PORT = auto()


@dataclass(frozen=True, slots=True)
class ValueHint:
    """Describes the values of a key whose type is not specific enough."""

    text: str


@dataclass(frozen=True, slots=True)
class Check:
    """Converts a value; raises ``ValueError`` if the value is not allowed.

    The checks of a key run in their order, after its type and range are checked.
    """

    convert: Callable[[Any], Any]


@dataclass(frozen=True, slots=True)
class KnownNames:
    """Restricts a text to names, or texts that match ``pattern``, which ``others`` describes."""

    names: Callable[[], Iterable[str]]
    pattern: str = "(?!)"
    others: str = ""

    def __str__(self) -> str:
        return f"one of {', '.join(self.names())}{self.others}"

    def convert(self, text: str) -> str:
        """Return a known name in its own case, or the text; raises as ``Check``."""
        name = text.strip()
        for known in (name, name.lower()):
            if known in self.names():
                return known
        if not re.fullmatch(self.pattern, text):
            raise ValueError
        return text


def _check_endpoint(value: str) -> str:
    try:
        split_endpoint(value, "")
    except UserError as error:
        raise ValueError(str(error)) from None
    return value


def _check_host(value: str) -> str:
    if value:  # empty: not set, or all addresses
        _check_endpoint(with_host("tcp://*:*", value))
    return value


def _check_metrics(value: str) -> str:
    if value:
        host, port = split_endpoint(_check_endpoint(f"tcp://{value}"), "metrics")
        if host == "*" or port == "*" or int(port) == 0:  # Prometheus needs a known port
            raise ValueError
    return value


Endpoint = Annotated[str, Check(_check_endpoint), ValueHint("an endpoint, tcp://HOST:PORT")]
BoundEndpoint = Annotated[Endpoint, BindAddress.ENDPOINT]
Host = Annotated[
    str, Check(_check_host), ValueHint("a host name of at most 190 characters, or an address")
]
BoundHost = Annotated[Host, BindAddress.HOST]
BoundPort = Annotated[int, Meta(ge=0, le=65535), BindAddress.PORT]
InstanceName = Annotated[str, Meta(max_length=128), ValueHint("up to 128 characters")]
LOG_LEVELS = ("debug", "info", "warning", "error")
HostNames = Annotated[tuple[Host, ...], ValueHint("a list of host names")]


@dataclass(frozen=True, slots=True)
class _DerivedDefault:
    compute: Callable[[Any], Any]


def derived_default(compute: Callable[[Any], Any]) -> Any:
    """Return a default that is computed from the configuration, which has the other keys."""
    return dataclasses.field(default=_DerivedDefault(compute))


@dataclass(frozen=True, kw_only=True)
class ServiceConfig:
    """The keys that every service has. ``Settings`` checks the values; the constructor does not."""

    safe_alternative: ClassVar[str] = "bind a loopback address"
    """Alternative to an unencrypted address that other machines can reach, for errors."""

    control: Endpoint = "tcp://127.0.0.1:5550"
    """Address at which control accepts commands. Control binds it; if it contains a host name,
    control binds all addresses of its host."""
    advertise: Host = ""
    """Host name or address at which others reach this service, for example behind NAT. If empty,
    the bound address is used; for 0.0.0.0, the address from which this host reaches control."""
    insecure: bool = False
    """Accept unencrypted connections from anyone. docs/security.md describes the risks."""
    log_level: Annotated[str, KnownNames(lambda: LOG_LEVELS)] = "info"
    """Lowest level of log messages to write."""
    instance: InstanceName = ""
    """Name of this process, different for each process. If empty, a name is generated."""
    metrics: Annotated[
        str, Check(_check_metrics), ValueHint("HOST:PORT such as 127.0.0.1:9100, or empty")
    ] = ""
    """Address to bind for Prometheus metrics (/metrics) and the health check (/healthz), over plain
    HTTP. Empty turns both off. Services on one machine need different ports. With 0.0.0.0, other
    machines can read them."""

    def __post_init__(self) -> None:
        for key, value in vars(self).items():
            if isinstance(value, _DerivedDefault):
                object.__setattr__(self, key, value.compute(self))

    @property
    def advertised_host(self) -> str:
        """Host by which others reach a service that binds every address of this host."""
        host, _ = split_endpoint(self.control, "control")
        return local_address() if is_loopback(host) else local_address(host)

    def advertised_endpoint(self, endpoint: str) -> str:
        """Return the endpoint by which others reach a bound endpoint."""
        host, _ = split_endpoint(endpoint, "endpoint")
        bound_host = self.advertised_host if host in WILDCARDS and not self.advertise else host
        return with_host(endpoint, self.advertise or bound_host)

    @property
    def is_encrypted(self) -> bool:
        """Whether connections to the bound hosts are encrypted."""
        return False


@dataclass(frozen=True, slots=True)
class KeyType:
    """The type of a key, and the marks of its annotation."""

    kind: Any
    marks: tuple[Any, ...]

    @classmethod
    def of(cls, annotation: Any) -> "KeyType":
        """Return the type that an annotation describes."""
        if typing.get_origin(annotation) is Annotated:
            return cls(annotation.__origin__, annotation.__metadata__)
        return cls(annotation, ())

    def mark(self, kind: type[Mark]) -> Mark | None:
        """Return the mark of a type, or None."""
        return next((mark for mark in self.marks if isinstance(mark, kind)), None)

    @property
    def is_list(self) -> bool:
        """Whether it is a list: an array in a TOML file; elsewhere a text with spaces."""
        return typing.get_origin(self.kind) is tuple

    @property
    def names(self) -> list[str]:
        """The names that it allows; empty if it is not restricted to names."""
        if known := self.mark(KnownNames):
            return list(known.names())
        if typing.get_origin(self.kind) is Literal:
            return list(typing.get_args(self.kind))
        is_enum = isinstance(self.kind, type) and issubclass(self.kind, StrEnum)
        return list(self.kind) if is_enum else []

    @property
    def allowed(self) -> str:
        """The allowed values in words, such as "an integer from 1 to 20"."""
        if hint := self.mark(ValueHint):
            return hint.text
        if known := self.mark(KnownNames):
            return str(known)
        if self.names:
            return f"one of {', '.join(self.names)}"
        if self.kind is bool:
            return "true or false"
        limits = self.mark(Meta)
        if limits is None:
            return "text"
        number = "a number" if self.kind is float else "an integer"
        return f"{number} from {limits.ge} to {limits.le}"

    def parse(self, text: str) -> Any:
        """Return the value of a text; raises ``ValueError`` if it is not allowed."""
        if self.is_list:
            item = KeyType.of(typing.get_args(self.kind)[0])
            return tuple(item.parse(part) for part in text.split())
        limits = self.mark(Meta)
        kind = Annotated[self.kind, limits] if limits else self.kind
        value = msgspec.convert(text if kind is str else text.strip(), kind, strict=False)
        for mark in self.marks:
            if isinstance(mark, Check | KnownNames):
                value = mark.convert(value)
        return value


def key_types(config_type: type[ServiceConfig], table: str = "") -> dict[str, KeyType]:
    """Return the types of a table's keys. ``[common]`` has no ``instance``: names must differ."""
    return {
        field.name: KeyType.of(field.type)
        for field in dataclasses.fields(config_type)
        if (table, field.name) != (COMMON, "instance")
    }


Config = TypeVar("Config", bound=ServiceConfig)
Address = tuple[str, str]  # a table and a key


@dataclass(frozen=True, slots=True)
class _RawValue:
    """A value as the user entered it."""

    text: str
    origin: str


Layer = dict[Address, _RawValue]  # values of one source


@dataclass(frozen=True, slots=True)
class Setting:
    """A key of a service with its current value."""

    key: str
    value: object
    origin: str  # "default", a file, $VARIABLE or --set
    default: object
    allowed: str
    meaning: str

    @property
    def is_default(self) -> bool:
        """Whether no source sets the key."""
        return self.origin == _DEFAULT

    @property
    def text(self) -> str:
        """The value as the environment and the command line have it."""
        return " ".join(self.value) if isinstance(self.value, tuple) else str(self.value)


class Settings:
    """The values of all keys of all services, from every source.

    ``types`` has the configuration class of each service, and of ``[common]``. ``assignments`` are
    the values from the command line, by ``service.key``. ``environment`` defaults to the
    environment of this process.

    Raises ``UserError`` if the file cannot be read, or a table, key or variable is unknown.
    """

    def __init__(
        self,
        types: Mapping[str, type[ServiceConfig]],
        *,
        file: Path | None = None,
        environment: Mapping[str, str] | None = None,
        assignments: Mapping[str, str] | None = None,
    ) -> None:
        self._tables: dict[str, type[ServiceConfig]] = dict(types)
        environment = os.environ if environment is None else environment
        addresses = [(table, key) for table in self._tables for key in self._keys(table)]
        variables = {variable_name(*address): address for address in addresses}
        self._names = {".".join(address): address for address in addresses}
        self._layers = (
            {} if file is None else self._read_file(file),
            _make_layer(
                {n: text for n, text in environment.items() if n.startswith(PREFIX)}, variables
            ),
            _make_layer(assignments or {}, self._names, "--set"),
        )

    def load(self, config_type: type[Config]) -> Config:
        """Return the checked configuration of a service, or of a client (``ServiceConfig``).

        Raises ``UserError`` if a value is not allowed; the text names the key, the value and its
        origin.
        """
        return self._resolve(config_type)[0]

    def describe(self, config_type: type[ServiceConfig]) -> list[Setting]:
        """Return all keys of a service with their current values; raises as ``load``."""
        config, values = self._resolve(config_type)
        defaults, meanings = config_type(), _meanings(config_type)
        return [
            Setting(
                key=key,
                value=getattr(config, key),
                origin=values[key].origin if key in values else _DEFAULT,
                default=getattr(defaults, key),
                allowed=kind.allowed,
                meaning=meanings[key],
            )
            for key, kind in key_types(config_type, self._table(config_type)).items()
        ]

    def _resolve(self, config_type: type[Config]) -> tuple[Config, dict[str, _RawValue]]:
        table = self._table(config_type)
        kinds = key_types(config_type)
        values = {
            key: layer[name, key]
            for layer in self._layers
            for name in (COMMON, table)
            for key in kinds
            if (name, key) in layer
        }
        parsed = {}
        for key, value in values.items():
            try:
                parsed[key] = kinds[key].parse(value.text)
            except ValueError:
                raise self._value_error((table, key), value) from None
        config = config_type(**parsed)
        _check_hosts(table, config)
        return config, values

    def _table(self, config_type: type[ServiceConfig]) -> str:
        return next((n for n, known in self._tables.items() if known is config_type), COMMON)

    def _keys(self, table: str) -> dict[str, KeyType]:
        return key_types(self._tables[table], table)

    def _read_file(self, file: Path) -> Layer:
        text = read_text(file, _MAX_FILE_BYTES)
        if any(line.count(".") > _MAX_DOTS for line in text.splitlines()):
            raise UserError(f"{file}: a line has more than {_MAX_DOTS} dots; split it")
        with check_content(file, "a TOML file of kouxing"):
            content = tomllib.loads(text)
        values: dict[str, Any] = {}
        for table, entries in content.items():
            if not isinstance(entries, dict):
                raise UserError(
                    f"{file}: {table!r} is not in a table; write it below a line such as [common]"
                )
            if table not in self._tables:
                raise UserError(f"{file}: unknown table [{table}]; {_hint(table, self._tables)}")
            values |= {f"{table}.{key}": value for key, value in entries.items()}
        layer = _make_layer({n: _as_text(v) for n, v in values.items()}, self._names, str(file))
        for name, value in values.items():
            table, key = address = self._names[name]
            is_list = self._keys(table)[key].is_list
            if not isinstance(value, list if is_list else str | int | float):
                raise self._value_error(address, layer[address])
        return layer

    def _value_error(self, address: Address, value: _RawValue) -> UserError:
        table, key = address
        kind = self._keys(table)[key]
        similar = difflib.get_close_matches(value.text, kind.names, n=1, cutoff=0.5)
        hint = f"; did you mean {similar[0]}?" if similar else ""
        if kind.is_list:
            hint = '; write ["A", "B"] in a file, and "A B" elsewhere'
        return UserError(
            f"{table}.{key}: {value.text!r} (from {value.origin}) is not {kind.allowed}{hint}"
        )


def _meanings(config_type: type[ServiceConfig]) -> dict[str, str]:
    """Return the docstring of each key, on one line."""
    meanings = {}
    for part in reversed(config_type.__mro__[:-1]):
        tree = ast.parse(textwrap.dedent(inspect.getsource(part)))
        for key, docstring in itertools.pairwise(ast.iter_child_nodes(tree.body[0])):
            match key, docstring:
                case ast.AnnAssign(target=ast.Name(name)), ast.Expr(value=ast.Constant(str(text))):
                    meanings[name] = " ".join(text.split())
    return meanings


def variable_name(table: str, key: str) -> str:
    """Return the environment variable of a service's key, or of a common key for all services."""
    return PREFIX + (key if table == COMMON else f"{table}_{key}").upper()


def bound_keys(config_type: type[ServiceConfig]) -> dict[str, BindAddress]:
    """Return the keys that are addresses which a service binds."""
    return {
        key: mark
        for key, kind in key_types(config_type).items()
        if (mark := kind.mark(BindAddress))
    }


def parse_assignments(assignments: Iterable[str], service: str = "") -> dict[str, str]:
    """Return the values of ``--set`` by ``service.key``.

    If ``service`` is set, its name may be omitted before a key. Raises ``UserError`` if an
    assignment is not ``KEY=VALUE``, or sets a key of another service than ``service``.
    """
    values = {}
    for assignment in assignments:
        key, equals, value = assignment.partition("=")
        if not equals:
            raise UserError(f"--set {assignment}: write --set KEY=VALUE")
        key = key.removeprefix(f"{service}.")
        if service and "." in key:
            raise UserError(
                f"--set {assignment}: this command has only the keys of {service}, and not the key"
                f" {key}"
            )
        values[f"{service}.{key}" if service else key] = value
    return values


def _make_layer(values: Mapping[str, str], known: Mapping[str, Address], origin: str = "") -> Layer:
    """Return the values of a source by table and key; without ``origin``, of the environment."""
    layer: Layer = {}
    for name, text in values.items():
        if name not in known:
            problem = f"{origin}: unknown key {name}" if origin else f"${name}: unknown variable"
            raise UserError(f"{problem}; {_hint(name, known)}")
        layer[known[name]] = _RawValue(text, origin or f"${name}")
    return layer


def _as_text(value: object) -> str:
    if isinstance(value, list):
        return " ".join(map(str, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def _hint(name: str, known: Iterable[str]) -> str:
    _, dot, key = name.rpartition(".")
    same_key = [other for other in known if dot and other.endswith(f".{key}")]
    (nearest,) = difflib.get_close_matches(name, same_key or [*known], n=1, cutoff=0.0)
    return f"the nearest is {nearest}; 'kouxing config' lists all"


def _check_hosts(table: str, config: ServiceConfig) -> None:
    """Reject hosts that other machines can reach, unless connections to them are encrypted."""
    if config.insecure or config.is_encrypted:
        return
    for key, kind in bound_keys(type(config)).items():
        host = getattr(config, key)
        if kind is BindAddress.HOST and not is_loopback(host):
            raise UserError(
                f"{table}.{key}: other machines can reach {host}, and nothing is encrypted; "
                f"{config.safe_alternative}, or, for an experiment on an isolated network, set "
                "insecure = true (not supported)"
            )
