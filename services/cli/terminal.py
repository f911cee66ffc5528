"""What commands share: choices of options, the console, and writing results."""

from __future__ import annotations

import json
import shutil
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from kouxing.shared.errors import UserError
from kouxing.shared.face.shape_names import ShapeSetName

CONSOLE = Console(stderr=True)
JsonFile = Annotated[Path | None, typer.Option("--json", help="Also write the figures here.")]
VoiceFile = Annotated[
    Path | None, typer.Option("--voice", help="The speaker's own mouth, from kouxing adapt.")
]


class CurveForm(StrEnum):
    """What the values of a face's curves are."""

    FAPS = "faps"
    ARKIT = ShapeSetName.ARKIT
    OCULUS = ShapeSetName.OCULUS
    VRM = ShapeSetName.VRM


class Shown(StrEnum):
    """What ``kouxing listen`` prints."""

    FAPS = "faps"
    SYLLABLES = "syllables"
    PHONES = "phones"


class Timing(StrEnum):
    """What tells when the phones of a text are spoken."""

    ENDPOINTS = "endpoints"  # energy and zero crossings
    ALIGN = "align"  # the acoustic model


def print_message(text: str) -> None:
    """Print a line for the user on standard error, apart from a command's results."""
    CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)


def command_name() -> str:
    """Return what a user types for this command here: kouxing, or where it is."""
    called = Path(sys.argv[0])
    if shutil.which("kouxing") or called.name != "kouxing":
        return "kouxing"
    return str(called.relative_to(Path.cwd()) if called.is_relative_to(Path.cwd()) else called)


def write_output(text: str, output: Path | None) -> None:
    """Write a command's result to a file, or to standard output if there is none."""
    if output is None:
        sys.stdout.write(text)
    else:
        write_text(output, text)


def write_json(path: Path | None, figures: object) -> None:
    """Write figures if there is a file for them."""
    if path is not None:
        write_text(path, json.dumps(figures, indent=1, ensure_ascii=False, default=_plain))


def check_output(*paths: Path | None) -> None:
    """Check before long work that files can be written; None stands for no file.

    Raises
    ------
    UserError
        If one of them cannot be written.
    """
    for path in paths:
        if path is None:
            continue
        is_new = not path.exists()
        try:
            with path.open("a"):
                pass
            if is_new:
                path.unlink()
        except OSError as error:
            raise _not_written(path, error) from None


def write_text(path: Path, text: str) -> None:
    """Write a file into a folder that exists.

    Raises
    ------
    UserError
        If it cannot be written.
    """
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise _not_written(path, error) from None


def _not_written(path: Path, error: OSError) -> UserError:
    if isinstance(error, FileNotFoundError):
        return UserError(f"{path}: cannot be written: first type: mkdir -p {path.parent}")
    return UserError(f"{path}: cannot be written: {error.strerror}")


def _plain(value: object) -> object:
    if hasattr(value, "item"):  # a NumPy scalar; NumPy would make every command slow to start
        return value.item()
    raise TypeError(f"{type(value).__name__} has no JSON form")
