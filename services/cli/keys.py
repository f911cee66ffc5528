"""The commands under ``kouxing keys``."""

from pathlib import Path
from typing import Annotated

import typer

from kouxing.services.service_kinds import KINDS
from kouxing.shared.command.terminal import Force, check_output, print_message, print_table
from kouxing.shared.errors import UserError
from kouxing.shared.name_rules import NAME_RULE, is_name
from kouxing.shared.settings.keys import (
    CLIENT,
    add_key,
    key_folder,
    load_key,
    load_user_key,
    read_grants,
    revoke_key,
)

app = typer.Typer(no_args_is_help=True, help="Manage the keys that may connect to the services.")


@app.command()
def init() -> None:
    """Create all keys of a system on this machine, for its services and for your commands."""
    for kind in KINDS.values():
        load_key(kind.name, kind.key_roles)
    load_user_key()
    print_message(f"the keys are in {key_folder()}")


@app.command()
def add(
    name: Annotated[str, typer.Argument(help="Name of the machine, program or person.")],
    roles: Annotated[
        list[str] | None,
        typer.Option(
            "--role",
            help="Role: client (the default), operator, service:KIND, subscriber:SESSION or"
            " 'subscriber:*'; repeatable.",
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="File to write. Default: NAME.key.")
    ] = None,
    force: Force = False,
) -> None:
    """Create a key for another machine, and allow it immediately."""
    if not is_name(name):
        raise UserError(f"{name!r} is not a valid name; {NAME_RULE}")
    roles = roles or [CLIENT]
    path = output or Path(f"{name}.key")
    check_output(path, force=force)
    kinds = [role.removeprefix("service:") for role in roles if role.startswith("service:")]
    for kind in kinds:
        if kind not in KINDS:
            raise UserError(f"there is no service {kind!r}; choose one of {', '.join(KINDS)}")
    add_key(name, roles, path)
    copies = " and ".join(f"~/.local/state/kouxing/{kind}.key" for kind in kinds or [CLIENT])
    print_message(
        f"wrote {path}; copy it to {copies} on the other machine (folder: mode 700, file: mode 600)"
    )


@app.command("list")
def list_keys() -> None:
    """List the allowed keys with their roles."""
    grants = sorted(read_grants().items(), key=lambda item: item[1].name)
    rows = ((grant.name, ", ".join(grant.roles), public) for public, grant in grants)
    print_table(("name", "roles", "public key"), rows)


@app.command()
def revoke(name: Annotated[str, typer.Argument(help="Name, as in 'kouxing keys list'.")]) -> None:
    """Revoke a key, and close its connections immediately."""
    revoke_key(name)
    print_message(f"revoked the key of {name}")
