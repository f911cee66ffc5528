"""Formats files of Rhubarb Lip Sync (TSV, XML or JSON), which list when each mouth is drawn.

Source: README of Rhubarb Lip Sync, "Output formats". Times have two decimals, and the end of the
recording is truncated to them. A cue ends where the next one starts. The last line of a TSV is the
end of the recording, with the mouth at rest.
"""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias
from xml.sax.saxutils import escape

from kouxing.services.cli.options import CurveFormat
from kouxing.shared.arrays import Floats
from kouxing.shared.face.mouth_shapes import CLOSED, REST, SILENCE, Cue, mouth_cues, oculus_cues
from kouxing.shared.files.output_file import path_as_text

Frames: TypeAlias = Iterable[tuple[float, Floats]]  # times in seconds, FAPs (68,)
_NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ufffe\uffff]")
_Span: TypeAlias = tuple[str, str, str]  # start, end, and the mouth between them


# functions that find the cues of a set of mouths, and the mouth at rest
CUE_KINDS: dict[CurveFormat, tuple[Callable[[Frames], Iterator[Cue]], str]] = {
    CurveFormat.RHUBARB: (mouth_cues, REST),
    CurveFormat.OCULUS: (oculus_cues, SILENCE),
}


def format_cues(
    suffix: str, cues: Iterable[Cue], rest: str, end_s: float, source: Path | None
) -> str:
    """Return the cues of a recording as a file, for a suffix in ``CUE_FORMATS``.

    ``end_s`` is the end of the recording. Later cues are omitted. A closed mouth directly before a
    rest becomes part of the rest. Consecutive cues with the same mouth are merged.
    """
    end = math.floor(100.0 * end_s + 1e-6) / 100.0
    merged: list[Cue] = []
    for start_s, mouth in cues:
        before = merged[-1][1] if merged else ""
        continues = before == mouth or (before, mouth) == (CLOSED, REST)
        merged.append((merged.pop()[0] if continues else min(start_s, end), mouth))
    spans = [
        (f"{start:.2f}", f"{until:.2f}", mouth)
        for (start, mouth), (until, _) in pairwise([*merged, (end, rest)])
        if round(start, 2) < round(until, 2)
    ]
    return CUE_FORMATS[suffix](spans or [("0.00", f"{end:.2f}", rest)], rest, source)


def _format_tsv(spans: Sequence[_Span], rest: str, _: Path | None) -> str:
    lines = [f"{start}\t{mouth}\n" for start, _, mouth in spans]
    return "".join(lines) + f"{spans[-1][1]}\t{rest}\n"


def _format_xml(spans: Sequence[_Span], _: str, source: Path | None) -> str:
    cues = "".join(
        f'    <mouthCue start="{start}" end="{end}">{mouth}</mouthCue>\n'
        for start, end, mouth in spans
    )
    name = _NOT_IN_XML.sub("\ufffd", escape(_name(source)))
    return (
        '<?xml version="1.0" encoding="utf-8"?>\n<rhubarbResult>\n  <metadata>\n'
        f"    <soundFile>{name}</soundFile>\n"
        f"    <duration>{spans[-1][1]}</duration>\n  </metadata>\n"
        f"  <mouthCues>\n{cues}  </mouthCues>\n</rhubarbResult>\n"
    )


def _format_json(spans: Sequence[_Span], _: str, source: Path | None) -> str:
    cues = ",\n".join(
        f'    {{ "start": {start}, "end": {end}, "value": "{mouth}" }}'
        for start, end, mouth in spans
    )
    sound_file = json.dumps(_name(source), ensure_ascii=False)
    return (
        f'{{\n  "metadata": {{\n    "soundFile": {sound_file},\n'
        f'    "duration": {spans[-1][1]}\n  }},\n  "mouthCues": [\n{cues}\n  ]\n}}\n'
    )


def _name(source: Path | None) -> str:
    return "" if source is None else path_as_text(source.absolute())


CUE_FORMATS: dict[str, Callable[[Sequence[_Span], str, Path | None], str]] = {
    ".tsv": _format_tsv,
    ".xml": _format_xml,
    ".json": _format_json,
}
