"""Prints or records the output of a session: FAPs, shapes, syllables or phones."""

import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeVar

import numpy as np
from kouxing_client import Client, FapFrame, Phone, Refused, Results, Session

from kouxing.services.cli.options import SPEECH_FORMATS, CurveFormat, ExportOptions, ListenFormat
from kouxing.services.cli.recordings.curve_exporters import (
    CURVE_EXPORTERS,
    CurveExporter,
    FrameRow,
    FrameStream,
    json_line,
)
from kouxing.services.cli.system.streaming import missed_warning
from kouxing.shared.command.client_connection import connect_client
from kouxing.shared.command.terminal import CONSOLE, plural, print_message
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS
from kouxing.shared.face.mouth_shapes import mouth_cues
from kouxing.shared.interrupt import (
    catch_interrupt,
    delay_interrupt,
    install_interrupt_handler,
    is_interrupted,
)
from kouxing.shared.phones import events
from kouxing.shared.phones.alphabets import Alphabet, respell
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory
from kouxing.shared.phones.syllable_captions import SyllableCaptions

INTERRUPT_POLL_S = 0.1
OPEN_POLL_S = 0.05  # the services repeat what they published shortly before
PRINTED_FAPS = (3, 4, 5, 6, 16, 17)  # jaw, lips, lip corner, protrusion
LEGEND = "columns: time, then FAPs " + ", ".join(f"{n} {FAPS[n - 1].name}" for n in PRINTED_FAPS)

T = TypeVar("T", FapFrame, Phone)


def follow(
    session: str,
    output: Path | None,
    as_format: ListenFormat | None,
    control: AbstractContextManager[str],
    alphabet: Alphabet | None = None,
) -> None:
    """Follow a session until it ends. Without a name, follow the newest one or wait for the next.

    Writes the frames to ``output``. Without it, prints the frames, or the syllables or phones that
    ``as_format`` names. Phones are in ``alphabet``. ``control`` is entered only after the format of
    the file has been checked, so that a wrong name fails at once. Raises ``UserError`` if control
    does not answer, the file cannot be written, or its format does not fit ``as_format``.
    """
    is_speech = as_format in SPEECH_FORMATS
    curve_format = None if as_format is None or is_speech else CurveFormat(as_format)
    exporter = None if output is None else _open_exporter(output, curve_format)
    install_interrupt_handler()  # a background shell ignores SIGINT
    with control as endpoint, connect_client(endpoint) as client:
        followed = _wait_for_session(session, client)
        results = followed.results(Phone if is_speech else FapFrame, keep_all=True)
        arriving = _iter_until_interrupt(results, followed.name)
        if is_speech:
            inventory = load_inventory(followed.info["facts"]["language"] or DEFAULT_LANGUAGE)
            phones = map(events.Phone.from_message, arriving)
            if as_format is ListenFormat.SYLLABLES:
                count = _print(_syllable_lines(phones, inventory))
            else:
                written = respell(phones, inventory, alphabet)
                count = _print(_line(p.onset_s, p.duration_s, p.symbol) for p in written)
        else:
            rows = ((f.time_s, f.sequence, np.array(f.values, np.float32)) for f in arriving)
            live = FrameStream(rows, is_live=True)
            count = _print_frames(rows, curve_format) if exporter is None else exporter.write(live)
    unit = as_format.value.removesuffix("s") if as_format and is_speech else "frame"
    if as_format is ListenFormat.RHUBARB and output is None:
        unit = "mouth shape"
    print_message(f"session {followed.name} ended: {plural(count, unit)}")
    if results.num_missed:
        print_message(missed_warning(results.num_missed, "phone" if is_speech else "frame"))
    if output is not None:
        print_message(f"wrote {output}")


def _open_exporter(output: Path, curve_format: CurveFormat | None) -> CurveExporter:
    exporter = CURVE_EXPORTERS.get(output.suffix.lower())
    if exporter is None:
        raise UserError(
            f"{output}: unknown format; use a name that ends in {', '.join(CURVE_EXPORTERS)}"
        )
    return exporter(output, ExportOptions(curve_format=curve_format))


def _wait_for_session(name: str, client: Client) -> Session:
    """Follow the open session of that name, or the newest; wait until one is open."""
    is_waiting = False
    while True:
        try:
            return client.follow(name)
        except Refused as refusal:
            if refusal.code != "unknown-session":
                raise
        if not is_waiting:
            wanted = f"session {name}" if name else "a session"
            opener = f"speak my.wav --session {name}" if name else "speak my.wav"
            print_message(
                f"waiting for {wanted} to open, as with kouxing {opener}; press Ctrl-C to stop"
            )
            is_waiting = True
        time.sleep(OPEN_POLL_S)


def _iter_until_interrupt(results: Results[T], session: str) -> Iterator[T]:
    """Yield results until the session ends, or until Ctrl-C or SIGTERM.

    An interrupt takes effect between two results, so the caller can write what it has received.
    """
    with catch_interrupt(), delay_interrupt():
        print_message(f"following session {session}")
        while not is_interrupted():
            has_ended = results.has_ended
            result = results.get(INTERRUPT_POLL_S)
            if result is not None:
                yield result
            elif has_ended:
                return
        raise KeyboardInterrupt


def _syllable_lines(phones: Iterable[events.Phone], inventory: PhoneInventory) -> Iterator[str]:
    """Yield a line for each syllable when it is final. Pauses have no line."""
    track = SyllableCaptions(inventory)
    for phone in phones:
        for syllable in track.update(phone):
            if syllable.final and syllable.duration_s > 0 and syllable.text != inventory.silence:
                yield _line(syllable.onset_s, syllable.duration_s, syllable.text)


def _line(onset_s: float, duration_s: float, text: str) -> str:
    return f"{onset_s:9.3f} s  {duration_s:6.3f} s  {text}"


def _print_frames(rows: Iterable[FrameRow], curve_format: CurveFormat | None) -> int:
    """Print frames, a line for each, and return their number; drawn mouths when they change."""
    if curve_format is CurveFormat.RHUBARB:
        cues = mouth_cues((time_s, faps) for time_s, _, faps in rows)
        return _print(f"{time_s:.2f}\t{mouth}" for time_s, mouth in cues)
    if curve_format not in (None, CurveFormat.FAPS):
        return _print(json_line(row, curve_format) for row in rows)
    CONSOLE.print(LEGEND, markup=False, highlight=False)
    return _print(
        f"{time_s:9.3f} s  " + "  ".join(f"{values[n - 1]:6.0f}" for n in PRINTED_FAPS)
        for time_s, _, values in rows
    )


def _print(lines: Iterable[str]) -> int:
    count = 0
    for line in lines:
        print(line, flush=True)
        count += 1
    return count
