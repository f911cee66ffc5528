"""The commands under ``kouxing export``."""

from pathlib import Path
from typing import Annotated

import typer

from kouxing.shared.command.terminal import Force, check_output, print_message
from kouxing.shared.files.output_file import create_folder, open_output

app = typer.Typer(no_args_is_help=True, help="Export the models for other programs.")


@app.callback()
def _export() -> None:
    """Without this callback, Typer would drop the name of the only command."""


@app.command("web")
def export_web(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Folder to write.")],
    force: Force = False,
) -> None:
    """Write the models for lip sync in a browser, without a server."""
    from kouxing.services.cli.web_model import web_model

    create_folder(folder)
    contents = web_model()
    check_output(*(folder / name for name in contents), force=force)
    for name, content in contents.items():
        with open_output(folder / name) as file:
            file.write(content)
    print_message(f"wrote {folder} ({sum(map(len, contents.values())) / 1e6:.1f} MB)")
