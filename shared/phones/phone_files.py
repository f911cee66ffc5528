"""Formats timed phones as a readable table, CSV, JSON, or TextGrid for Praat.

The TextGrid layout is Praat's long text format (Boersma and Weenink, Praat manual, "TextGrid file
formats"). Intervals cover the whole time without gaps, so pauses are intervals with empty text.
praatio would replace only the line templates, because it does not cut overlaps.
"""

import csv
import io
import json
from bisect import bisect_right
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from typing import TypeAlias

from kouxing.shared.fast_record import replace
from kouxing.shared.phones.events import Phone
from kouxing.shared.phones.transcript import TimedSyllable

_COLUMNS = ("index", "phone", "onset_s", "duration_s", "confidence")


def format_phones(
    phones: Sequence[Phone], style: str, total_s: float, syllables: Sequence[TimedSyllable] = ()
) -> str:
    """Write the spoken phones, in order, as ``table``, ``csv``, ``json`` or ``textgrid``.

    ``total_s`` is the length of the recording. ``syllables`` are those of a known text, which all
    formats contain.
    """
    spoken = (phone for phone in phones if phone.is_spoken)
    numbered = [replace(phone, index=number) for number, phone in enumerate(spoken)]
    return _STYLES[style](numbered, total_s, syllables)


def _cells(phone: Phone) -> tuple[int, str, float, float, float]:
    return (
        phone.index,
        phone.symbol,
        round(phone.onset_s, 4),
        round(phone.duration_s, 4),
        round(phone.confidence, 3),
    )


def _format_table(
    phones: Sequence[Phone], _total_s: float, syllables: Sequence[TimedSyllable]
) -> str:
    lines = ["  onset_s  duration_s  phone  confidence"]
    lines[0] += "  syllable  text" if syllables else ""
    named: TimedSyllable | None = None
    for phone, syllable in zip(phones, _syllables_of(phones, syllables), strict=True):
        times = f"{phone.onset_s:9.3f}  {phone.duration_s:10.3f}"
        line = f"{times}  {phone.symbol:<5}  {phone.confidence:10.2f}"
        if syllable is not None and syllable is not named:  # its first phone
            line += f"  {syllable.spelling:<8}  {syllable.text}"
        named = syllable
        lines.append(line)
    return "\n".join(lines) + "\n"


def _format_csv(
    phones: Sequence[Phone], _total_s: float, syllables: Sequence[TimedSyllable]
) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*_COLUMNS, *(("syllable", "text") if syllables else ())))
    for phone, syllable in zip(phones, _syllables_of(phones, syllables), strict=True):
        words = ("", "") if syllable is None else (syllable.spelling, syllable.text)
        writer.writerow((*_cells(phone), *(words if syllables else ())))
    return text.getvalue()


def _syllables_of(
    phones: Sequence[Phone], syllables: Sequence[TimedSyllable]
) -> Iterator[TimedSyllable | None]:
    """Yield the syllable of each phone; both are in order."""
    for phone in phones:
        middle_s = phone.onset_s + phone.duration_s / 2
        index = bisect_right(syllables, middle_s, key=lambda syllable: syllable.onset_s) - 1
        is_inside = index >= 0 and middle_s < syllables[index].end_s
        yield syllables[index] if is_inside else None


def _format_json(
    phones: Sequence[Phone], total_s: float, syllables: Sequence[TimedSyllable]
) -> str:
    rows = [dict(zip(_COLUMNS, _cells(phone), strict=True)) for phone in phones]
    content: dict[str, object] = {"total_s": round(total_s, 4), "phones": rows}
    if syllables:
        content["syllables"] = [
            {
                "text": syllable.text,
                "spelling": syllable.spelling,
                "onset_s": round(syllable.onset_s, 4),
                "duration_s": round(syllable.duration_s, 4),
            }
            for syllable in syllables
        ]
    return json.dumps(content, indent=1, ensure_ascii=False) + "\n"


_Interval: TypeAlias = tuple[float, float, str]  # start and end in seconds, text


def _format_textgrid(
    phones: Sequence[Phone], total_s: float, syllables: Sequence[TimedSyllable]
) -> str:
    tiers = {"phones": [(p.onset_s, p.end_s, p.symbol) for p in phones]}
    if syllables:
        tiers = {
            "characters": [(s.onset_s, s.end_s, s.text) for s in syllables],
            "syllables": [(s.onset_s, s.end_s, s.spelling) for s in syllables],
        } | tiers
    lines = [
        'File type = "ooTextFile"',
        'Object class = "TextGrid"',
        "",
        "xmin = 0",
        f"xmax = {total_s:.4f}",
        "tiers? <exists>",
        f"size = {len(tiers)}",
        "item []:",
    ]
    for number, (name, intervals) in enumerate(tiers.items(), start=1):
        lines += _format_tier(number, name, _fill_gaps(intervals, total_s), total_s)
    return "\n".join(lines) + "\n"


def _format_tier(number: int, name: str, intervals: list[_Interval], total_s: float) -> list[str]:
    lines = [
        f"    item [{number}]:",
        '        class = "IntervalTier"',
        f'        name = "{name}"',
        "        xmin = 0",
        f"        xmax = {total_s:.4f}",
        f"        intervals: size = {len(intervals)}",
    ]
    for position, (start_s, end_s, text) in enumerate(intervals, start=1):
        quoted = text.replace('"', '""')
        lines += [
            f"        intervals [{position}]:",
            f"            xmin = {start_s:.4f}",
            f"            xmax = {end_s:.4f}",
            f'            text = "{quoted}"',
        ]
    return lines


def _fill_gaps(unfilled: Sequence[_Interval], total_s: float) -> list[_Interval]:
    """Fill gaps with empty intervals and cut overlaps, so that intervals cover the whole time."""
    intervals: list[_Interval] = []
    now_s = 0.0
    for (onset_s, offset_s, text), (next_s, *_) in pairwise([*unfilled, (total_s, total_s, "")]):
        start_s = max(now_s, onset_s)
        end_s = min(offset_s, next_s, total_s)
        if round(end_s, 4) <= round(start_s, 4):
            continue
        if round(start_s, 4) > round(now_s, 4):
            intervals.append((now_s, start_s, ""))
        else:
            start_s = now_s
        intervals.append((start_s, end_s, text))
        now_s = end_s
    if round(total_s, 4) > round(now_s, 4):
        intervals.append((now_s, total_s, ""))
    return intervals


_STYLES: dict[str, Callable[[Sequence[Phone], float, Sequence[TimedSyllable]], str]] = {
    "table": _format_table,
    "csv": _format_csv,
    "json": _format_json,
    "textgrid": _format_textgrid,
}
