"""Processes many files in one command: names their outputs, and continues after errors."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from kouxing.shared.command.terminal import print_message
from kouxing.shared.errors import UserError
from kouxing.shared.files.output_file import write_error

T = TypeVar("T", Path, Path | None)


def pair_outputs(
    sources: Sequence[Path], output: Path | None, suffix: str
) -> list[tuple[Path, Path]]:
    """Return each source with its output, whose name ends in ``suffix``.

    ``output`` is a folder, which is created, or a file for a single source (see ``is_folder``).
    None: the outputs are next to their sources. The output of standard input is named ``stdin``.
    Raises ``UserError`` if several sources need a folder, the folder cannot be created, or two
    sources would have the same output.
    """
    if output is not None and not is_folder(output):
        if len(sources) > 1:
            raise UserError(
                f"{output} is a single file, but there are {len(sources)} inputs; use a folder"
            )
        return [(sources[0], output)]
    pairs: dict[Path, tuple[Path, Path]] = {}  # key: resolved path of the output
    for source in sources:
        name = "stdin" if source == Path("-") else source.stem
        target = (output or source.parent) / f"{name}{suffix}"
        if other := pairs.get(target.resolve()):
            raise UserError(
                f"{source} is named twice"
                if other[0] == source
                else f"{other[0]} and {source} would both be written to {target}; rename one"
            )
        pairs[target.resolve()] = source, target
    if output is not None:
        try:
            output.mkdir(exist_ok=True)
        except OSError as error:
            raise write_error(output, error) from None
    return [*pairs.values()]


def is_folder(output: Path) -> bool:
    """Return whether the output of a command is a folder: it exists, or its name has no suffix."""
    return output.is_dir() or not (output.suffix or str(output) == "-")


def process_all(pairs: Sequence[tuple[Path, T]], process: Callable[[Path, T], None]) -> None:
    """Process pairs of a source and its output.

    A source with an error does not stop the others. Raises the error of a single source, or
    ``UserError`` if any of several sources failed.
    """
    num_failed = 0
    for source, output in pairs:
        try:
            process(source, output)
        except UserError as error:
            if len(pairs) == 1:
                raise
            num_failed += 1
            print_message(str(error))
    if num_failed:
        raise UserError(f"{num_failed} of {len(pairs)} files failed; see the messages above")
