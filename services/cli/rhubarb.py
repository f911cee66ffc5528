"""``kouxing-rhubarb``: the command line of Rhubarb Lip Sync, with the lips of kouxing.

Programs that run ``rhubarb`` use kouxing if this command is on their path under that name. Source:
README of Rhubarb Lip Sync 1.13, "Command-line options" and "Machine-readable status messages".
"""

import argparse
import io
import json
import math
import sys
from collections.abc import Iterable, Sequence
from contextlib import redirect_stderr
from importlib.metadata import version
from pathlib import Path

from rich.progress import Progress

from kouxing.services.cli.recordings.animation import FaceMotion, animate
from kouxing.services.cli.recordings.cue_files import format_cues
from kouxing.services.cli.texts.spoken_text import MAX_TEXT_BYTES
from kouxing.shared.clock import MEDIA_RATE_HZ
from kouxing.shared.command.terminal import (
    check_output,
    discard_output,
    replace_closed_streams,
    write_text,
)
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.face.mouth_shapes import REST, Cue, mouth_cues
from kouxing.shared.files.output_file import write_error
from kouxing.shared.files.user_file import read_text
from kouxing.shared.phones.inventory import AUTO, find_language

_BASIC_MOUTHS = {"G": "A", "H": "C", "X": "A"}  # shown instead of a mouth that is not drawn
_PRESTON_BLAIR = dict(zip("ABCDEFGHX", "MBP etc E AI O U FV L rest".split(), strict=True))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line; exit with status 1 after an error."""
    replace_closed_streams()
    options = _parser().parse_args(arguments)
    try:
        rate_hz = options.datFrameRate
        if options.exportFormat == "dat" and not 10.0 <= rate_hz <= 100.0:
            raise UserError(f"--datFrameRate {rate_hz:g}: choose 10 to 100 frames per second")
        check_output(options.output, inputs=[Path(options.input), options.dialogFile], force=True)
        _report(options, "start", f"reading {options.input}", file=options.input)
        motion = _animate(options)
        _report(options, "progress", "progress: 100 %", value=1.0)
        result = _format_mouths(motion, options)
        if options.output is None:
            _print_result(result)
        else:
            write_text(options.output, result)
    except UserError as error:
        if options.logFile is not None:
            try:
                write_text(options.logFile, f"[Fatal] {error}\n")
            except UserError as log_error:
                _report(options, "log", str(log_error))
        _report(options, "failure", str(error), reason=str(error))
        sys.exit(1)
    _report(options, "success", "finished")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("rhubarb", description="Animate a mouth from a recording.")
    program = f"Rhubarb Lip Sync version 1.13.0, in kouxing {version('kouxing')}"
    add = parser.add_argument
    add("--version", action="version", version=program)
    add("input", help="audio or video file")
    add("-f", "--exportFormat", choices=("tsv", "xml", "json", "dat"), default="tsv")
    add("-o", "--output", type=Path, help="file to write; an existing file is overwritten")
    add("-d", "--dialogFile", type=Path, help="file with the spoken text")
    add("--language", default=AUTO, help="language of the speech, such as en or zh; not in Rhubarb")
    add("--extendedShapes", default="GHX", help="which of the mouths G, H and X you have drawn")
    add(
        "--datFrameRate", type=float, default=24.0, help="frames per second of dat files, 10 to 100"
    )
    add(
        "--datUsePrestonBlair",
        action="store_true",
        help="use Preston Blair's names of the mouths in dat",
    )
    add("-q", "--quiet", action="store_true", help="print only errors")
    add("--machineReadable", action="store_true", help="print the status as JSON")
    add("--logFile", type=Path, help="file to write errors to")
    for names in (("-r", "--recognizer"), ("--consoleLevel",), ("--logLevel",), ("--threads",)):
        add(*names, help="ignored; accepted for compatibility")
    return parser


def _animate(options: argparse.Namespace) -> FaceMotion:
    """Animate the recording; report messages about its text as Rhubarb reports warnings."""
    text = "" if options.dialogFile is None else read_text(options.dialogFile, MAX_TEXT_BYTES)
    language = find_language(options.language)
    messages = io.StringIO()
    with redirect_stderr(messages), Progress(disable=True) as progress:
        motion = animate(
            Path(options.input),
            [DEFAULT_LIP_MODEL],
            progress,
            language=language,
            text=text.strip() or None,
            text_may_differ=True,
        )
    for message in messages.getvalue().splitlines():
        _report(options, "log", message)
    return motion


def _format_mouths(motion: FaceMotion, options: argparse.Namespace) -> str:
    substitutes = {
        letter: _BASIC_MOUTHS[letter]
        for letter in _BASIC_MOUTHS
        if letter not in options.extendedShapes
    }
    samples = motion.samples if motion.samples is not None else ()
    end_s, rest = len(samples) / MEDIA_RATE_HZ, substitutes.get(REST, REST)
    cues = [
        (start_s, substitutes.get(mouth, mouth)) for start_s, mouth in mouth_cues(motion.frames)
    ]
    if options.exportFormat == "dat":
        names = _PRESTON_BLAIR if options.datUsePrestonBlair else {}
        spoken = [(start_s, mouth) for start_s, mouth in cues if start_s < end_s]
        return _moho_switches([*spoken, (end_s, rest)], options.datFrameRate, names)
    return format_cues(f".{options.exportFormat}", cues, rest, end_s, motion.source)


def _moho_switches(cues: Iterable[Cue], rate_hz: float, names: dict[str, str]) -> str:
    """Return the switch data of Moho and OpenToonz: frame numbers from 1, and their mouths.

    If several mouths start in a frame, the last one counts.
    """
    mouths = {
        1 + math.floor(rate_hz * start_s + 1e-6): names.get(mouth, mouth) for start_s, mouth in cues
    }
    return "MohoSwitch1\n" + "".join(f"{frame} {mouth}\n" for frame, mouth in mouths.items())


def _print_result(result: str) -> None:
    """Print and flush the result, because plug-ins read it when success is reported."""
    try:
        print(result, end="", flush=True)
    except OSError as error:
        discard_output()
        raise write_error(Path("standard output"), error) from None


def _report(options: argparse.Namespace, kind: str, text: str, **details: object) -> None:
    """Print the status to standard error."""
    level = "Fatal" if kind == "failure" else "Info"
    if options.quiet and kind != "failure":
        return
    if options.machineReadable:
        text = json.dumps({"type": kind, **details, "log": {"level": level, "message": text}})
    print(text, file=sys.stderr)
