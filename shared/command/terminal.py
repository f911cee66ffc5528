"""Terminal output of all commands: messages, progress, tables and result files."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated

import typer
from rich.cells import cell_len
from rich.console import Console

from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import open_output, write_error

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

CONSOLE = Console(stderr=True)
Force = Annotated[bool, typer.Option("--force", help="Overwrite output files that exist.")]
JsonFile = Annotated[Path | None, typer.Option("--json", help="JSON file for the results.")]


def replace_closed_streams() -> None:
    """Replace a closed standard input or output (``<&-``, ``>&-``) with the null device."""
    if sys.stdin is None:
        sys.stdin = open(os.devnull)  # noqa: SIM115, PTH123 (open until exit)
    if sys.stdout is None:
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115, PTH123


def discard_output() -> None:
    """Discard buffered standard output, which Python would otherwise write at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)


def print_message(text: str, style: str | None = None) -> None:
    """Print a message to standard error, because standard output is for results.

    A full disk is ignored.
    """
    with contextlib.suppress(OSError):
        CONSOLE.print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def open_progress(*columns: ProgressColumn) -> Progress:
    """Return progress bars for a terminal, which disappear when they are done."""
    from rich.progress import Progress  # noqa: PLC0415 (few commands need it)

    return Progress(*columns, console=CONSOLE, transient=True, disable=not CONSOLE.is_interactive)


@contextlib.contextmanager
def show_loading() -> Iterator[None]:
    """Show a progress bar while slow modules and models are loaded."""
    with open_progress() as progress:
        progress.add_task("loading", total=None)
        yield


def plural(count: int, noun: str) -> str:
    """Return a count with its noun, such as "1 image" or "2 images"."""
    return f"{count} {noun}{'' if count == 1 else 's'}"


def print_table(columns: Sequence[str], rows: Iterable[Sequence[str]], *, title: str = "") -> None:
    """Print a table to standard output; a row may lack its last cells.

    Cells wrap between words. If the longest words do not fit side by side, each row is printed as
    a list of its cells.
    """
    from rich import box  # noqa: PLC0415 (few commands need it)
    from rich.table import Table  # noqa: PLC0415
    from rich.text import Text  # noqa: PLC0415

    console = Console()
    wrap = partial(fill, width=console.width - 2, break_long_words=False, break_on_hyphens=False)
    cells = [[*row, *[""] * (len(columns) - len(row))] for row in rows]
    available = console.width - 2 * (len(columns) - 1)
    widths = _column_widths(columns, cells, available)
    console.print(Text(f"\n{title}".rstrip("\n")))
    if sum(widths) > available:
        for row in cells:
            lines = (f"{name}: {cell}" for name, cell in zip(columns, row, strict=True) if cell)
            text = "\n  ".join(wrap(line, subsequent_indent="    ") for line in lines)
            console.print(Text(text), soft_wrap=True)
        return
    table = Table(box=box.SIMPLE, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for name, width in zip(columns, widths, strict=True):
        table.add_column(Text(name), width=width)
    for row in cells:
        table.add_row(*map(Text, row))
    console.print(table)


def _column_widths(
    columns: Sequence[str], rows: Sequence[Sequence[str]], available: int
) -> list[int]:
    """Return widths for the longest words. Narrow columns grow first, up to ``available``."""
    cells_of_column = [*zip(columns, *rows, strict=True)]
    widths = [
        max(cell_len(word) for cell in cells for word in ["", *cell.split()])
        for cells in cells_of_column
    ]
    bodies = [max(map(cell_len, cells[1:]), default=0) for cells in cells_of_column]
    for limits in (bodies, [*map(cell_len, columns)]):  # values stay whole rather than headings
        while sum(widths) < available:
            narrow = [n for n, limit in enumerate(limits) if widths[n] < limit]
            if not narrow:
                break
            widths[min(narrow, key=widths.__getitem__)] += 1
    return widths


def command_name() -> str:
    """Return the command that starts this program: ``kouxing``, or its path if not in PATH."""
    called = Path(sys.argv[0])
    if shutil.which("kouxing") or called.name != "kouxing":
        return "kouxing"
    return str(called.relative_to(Path.cwd()) if called.is_relative_to(Path.cwd()) else called)


def write_output(text: str, output: Path | None) -> None:
    """Write a result to a file, or to standard output if ``output`` is None."""
    if output is None:
        sys.stdout.write(text)
    else:
        write_text(output, text)
        print_message(f"wrote {output}")


def write_json(path: Path | None, results: object) -> None:
    """Write results as JSON, unless ``path`` is None."""
    if path is not None:
        write_text(path, json.dumps(results, indent=1, ensure_ascii=False, default=_to_python))


def check_output(
    *outputs: Path | Sequence[Path] | None, inputs: Iterable[Path | None] = (), force: bool = False
) -> None:
    """Check that output files can be written. Call this before long work; None is skipped.

    The existing pictures of a sequence are one output. Asks whether to overwrite a file, unless
    ``force`` is set. Raises ``UserError`` if a file cannot be written, exists and there is no
    terminal to ask on, or is also one of the ``inputs``.
    """
    sources = [source for source in inputs if source is not None and _exists(source)]
    for output in outputs:
        if output is None:
            continue
        path, *others = [output] if isinstance(output, Path) else output
        if str(path) == "-":
            raise UserError("-: cannot write to standard output; name a file")
        is_new = not _exists(path)
        for file in () if is_new else (path, *others):
            if any(file.samefile(source) for source in sources):
                raise UserError(
                    f"{file}: the output is also an input; use another name for the output"
                )
        if path.is_file() and not force:
            exists = f"{path} and {len(others)} more exist" if others else f"{path} exists"
            them = "them" if others else "it"
            if not (sys.stdin.isatty() and CONSOLE.is_terminal):
                raise UserError(f"{exists}; add --force to overwrite {them}")
            typer.confirm(f"{exists}. Overwrite {them}?", abort=True, err=True)
        if path.is_fifo():  # its reader would see the end of the file
            continue
        try:
            with path.open("a"):
                pass
            if is_new:
                path.resolve().unlink()  # deletes the target of a link, not the link
        except OSError as error:
            raise write_error(path, error) from None


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # not a valid file name
        return False


def write_text(path: Path, text: str) -> None:
    """Write a text file. Its folder must exist.

    Raises ``UserError`` if the file cannot be written.
    """
    with open_output(path) as file:
        file.write(text.encode())


def _to_python(value: object) -> object:
    if hasattr(value, "item"):  # a NumPy scalar; importing NumPy would slow down every command
        return value.item()
    raise TypeError(f"cannot convert {type(value).__name__} to JSON")
