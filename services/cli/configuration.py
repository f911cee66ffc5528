"""``kouxing config``: every key with its meaning, its present value and where that came from."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from typing import Annotated

import typer

from kouxing.services.cli.options import Assignments, ConfigFile
from kouxing.services.kinds import KINDS, read_settings
from kouxing.shared.config import COMMON, ServiceConfig, Setting, Settings, parse_assignments
from kouxing.shared.errors import UserError

TABLES: dict[str, type[ServiceConfig]] = {
    COMMON: ServiceConfig,
    **{kind.name: kind.config_type for kind in KINDS.values()},
}
PAGE_HEAD = """\
# Configuration

Made by `kouxing config --markdown > docs/configuration.md`; a test says when it is out of date.

A value comes from, weakest first:

1. the default below,
2. a TOML file (`--config FILE`) with one table per service, such as `[recognizer]`,
3. the environment, as `KOUXING_<SERVICE>_<KEY>`, such as `KOUXING_RECOGNIZER_MIN_CONFIDENCE`,
4. the command line: `--set KEY=VALUE` of a service, `--set SERVICE.KEY=VALUE` of `kouxing run`.

Every service also has the keys of `[common]`. They can be set for all services, in the table
`[common]` or as `KOUXING_<KEY>`, and for one service, which counts more. A key, table or variable
that is not listed here is an error. What is separated by spaces may also be a list in the file:
`senders = ["vmc://", "vts://"]`.

`kouxing config` prints all keys with their present values and where each came from, as a TOML file;
`kouxing config recognizer --set min_confidence=0.8` does so for one service.
"""


def config(
    service: Annotated[
        str, typer.Argument(help=f"One of {', '.join(TABLES)}; without it, all.")
    ] = "",
    config: ConfigFile = None,
    assignments: Assignments = None,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="Print the documentation page instead.")
    ] = False,
) -> None:
    """Print all keys: meaning, range, default, present value and where it came from."""
    if service and service not in TABLES:
        raise UserError(f"there is no service {service!r}; write one of {', '.join(TABLES)}")
    values = parse_assignments(assignments or [])
    if markdown:
        text = markdown_page()
    elif service:
        text = _toml_table(service, read_settings(config).describe(TABLES[service], values))
    else:
        settings = read_settings(config, values)
        text = "\n".join(_toml_table(*each) for each in _all_settings(settings))
    sys.stdout.write(text)


def markdown_page() -> str:
    """Return the documentation of all keys, ``docs/configuration.md``."""
    tables = []
    for name, settings in _all_settings(Settings(TABLES, environment={})):
        rows = [
            f"| `{each.key}` | `{_as_toml(each.default)}` | {each.allowed} | {each.meaning} |\n"
            for each in settings
        ]
        head = "| key | default | allowed | meaning |\n|---|---|---|---|\n"
        tables.append(f"\n## [{name}]\n\n{head}{''.join(rows)}")
    return PAGE_HEAD + "".join(tables)


def _all_settings(settings: Settings) -> Iterable[tuple[str, list[Setting]]]:
    """Yield each table with its keys: common ones only where a service has a value of its own."""
    common = settings.describe(ServiceConfig)
    for name, config_type in TABLES.items():
        keys = settings.describe(config_type)
        yield name, common if name == COMMON else [each for each in keys if each not in common]


def _toml_table(name: str, settings: list[Setting]) -> str:
    lines = [f"[{name}]"]
    for each in settings:
        lines += [
            f"# {each.meaning}",
            f"# {each.allowed[0].upper()}{each.allowed[1:]}; default {_as_toml(each.default)}.",
            f"{each.key} = {_as_toml(each.value)}  # {each.origin}",
        ]
    return "\n".join(lines) + "\n"


def _as_toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
