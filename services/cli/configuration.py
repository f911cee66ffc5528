"""``kouxing config``: prints every key with its meaning, its current value and its origin."""

import json
import sys
from collections.abc import Iterable
from typing import Annotated

import typer

from kouxing.services.cli.options import Assignments, ConfigFile
from kouxing.services.service_kinds import CONFIG_TYPES, read_settings
from kouxing.shared.errors import UserError
from kouxing.shared.settings.config import COMMON, Setting, Settings, parse_assignments

PAGE_HEAD = """\
# Configuration

A test checks this page. To update it, run
`python -m kouxing.services.cli.configuration > docs/configuration.md`.

The sources of a value, from weakest to strongest:

1. the default in the tables below
2. a TOML file (`--config FILE`) with one table per service, such as `[recognizer]`
3. the environment: `KOUXING_<SERVICE>_<KEY>`, such as `KOUXING_RECOGNIZER_MIN_CONFIDENCE`
4. the command line: `--set SERVICE.KEY=VALUE`, or `--set KEY=VALUE` for a command of one service

Services also have the keys of `[common]`. To set such a key for all services, use the table
`[common]` or the variable `KOUXING_<KEY>`. Only the driver and the gateway have `head`. Only these
and the synthesizer have `idle_motion`. Only the recognizer and the synthesizer have `max_lag_s`.
Within one source, a value for one service overrides the value for all services.
An unknown key, table or variable is an error.

In a TOML file, write a list as `senders = ["vmc://", "vts://"]`. In the environment and on the
command line, separate the items of a list with spaces.

`kouxing config` prints a TOML file with all keys, their values and the origin of each value.
`kouxing config recognizer --set min_confidence=0.8` does the same for one service.
"""


def config(
    service: Annotated[str, typer.Argument(help=f"{', '.join(CONFIG_TYPES)}. Default: all.")] = "",
    config: ConfigFile = None,
    assignments: Assignments = None,
) -> None:
    """Print the value, source, default, allowed values and meaning of every setting."""
    if service and service not in CONFIG_TYPES:
        raise UserError(f"unknown service {service!r}; choose one of {', '.join(CONFIG_TYPES)}")
    values = parse_assignments(assignments or [])
    if service:
        text = _toml_table(service, read_settings(config).describe(CONFIG_TYPES[service], values))
    else:
        tables = _all_settings(read_settings(config, values))
        text = "\n".join(_toml_table(name, settings) for name, settings in tables)
    sys.stdout.write(text)


def markdown_page() -> str:
    """Return the documentation of all keys, ``docs/configuration.md``."""
    tables = []
    for name, settings in _all_settings(Settings(CONFIG_TYPES, environment={})):
        rows = [
            f"| `{setting.key}` | `{_as_toml(setting.default)}` | {setting.allowed} |"
            f" {setting.meaning} |\n"
            for setting in settings
        ]
        head = "| key | default | allowed | meaning |\n|---|---|---|---|\n"
        tables.append(f"\n## [{name}]\n\n{head}{''.join(rows)}")
    return PAGE_HEAD + "".join(tables)


def _all_settings(settings: Settings) -> Iterable[tuple[str, list[Setting]]]:
    """Yield each table with its keys; a common key only where it differs from ``[common]``."""
    common = settings.describe(CONFIG_TYPES[COMMON])
    for name, config_type in CONFIG_TYPES.items():
        keys = settings.describe(config_type)
        yield name, common if name == COMMON else [key for key in keys if key not in common]


def _toml_table(name: str, settings: list[Setting]) -> str:
    lines = [f"[{name}]"]
    for setting in settings:
        allowed = f"{setting.allowed[0].upper()}{setting.allowed[1:]}"
        lines += [
            f"# {setting.meaning}",
            f"# {allowed}; default {_as_toml(setting.default)}.",
            f"{setting.key} = {_as_toml(setting.value)}  # {setting.origin}",
        ]
    return "\n".join(lines) + "\n"


def _as_toml(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)


if __name__ == "__main__":
    sys.stdout.write(markdown_page())
