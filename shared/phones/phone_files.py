"""Timed phones as text: a readable table, CSV, JSON, and TextGrid for Praat.

The TextGrid layout is Praat's long text format (Boersma and Weenink, Praat manual, "TextGrid file
formats"): intervals cover the whole time without gaps, so pauses are intervals with empty text.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence

from shared.errors import UserError
from shared.phones.events import Phone

_COLUMNS = ("index", "phone", "onset_s", "duration_s", "confidence")


def format_phones(phones: Sequence[Phone], style: str, total_s: float) -> str:
    """Write phones as text.

    Parameters
    ----------
    phones
        Phones in the order of their onsets.
    style
        ``table``, ``csv``, ``json`` or ``textgrid``.
    total_s
        Length of the recording, seconds.

    Returns
    -------
    str
        The whole file, ending with a newline.

    Raises
    ------
    UserError
        If there is no such style.
    """
    if style not in _STYLES:
        raise UserError(f"unknown format {style!r}; choose {', '.join(_STYLES)}")
    return _STYLES[style](phones, total_s)


def _cells(phone: Phone) -> tuple[int, str, float, float, float]:
    return (
        phone.index,
        phone.symbol,
        round(phone.onset_s, 4),
        round(phone.duration_s, 4),
        round(phone.confidence, 3),
    )


def _table(phones: Sequence[Phone], total_s: float) -> str:
    del total_s
    lines = ["  onset_s  duration_s  phone  confidence"]
    for phone in phones:
        times = f"{phone.onset_s:9.3f}  {phone.duration_s:10.3f}"
        lines.append(f"{times}  {phone.symbol:<5}  {phone.confidence:10.2f}")
    return "\n".join(lines) + "\n"


def _csv(phones: Sequence[Phone], total_s: float) -> str:
    del total_s
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    writer.writerows(_cells(phone) for phone in phones)
    return text.getvalue()


def _json(phones: Sequence[Phone], total_s: float) -> str:
    rows = [dict(zip(_COLUMNS, _cells(phone), strict=True)) for phone in phones]
    return json.dumps({"total_s": round(total_s, 4), "phones": rows}, indent=1) + "\n"


def _textgrid(phones: Sequence[Phone], total_s: float) -> str:
    intervals = _without_gaps(phones, total_s)
    lines = [
        'File type = "ooTextFile"',
        'Object class = "TextGrid"',
        "",
        "xmin = 0",
        f"xmax = {total_s:.4f}",
        "tiers? <exists>",
        "size = 1",
        "item []:",
        "    item [1]:",
        '        class = "IntervalTier"',
        '        name = "phones"',
        "        xmin = 0",
        f"        xmax = {total_s:.4f}",
        f"        intervals: size = {len(intervals)}",
    ]
    for number, (start_s, end_s, symbol) in enumerate(intervals, start=1):
        lines += [
            f"        intervals [{number}]:",
            f"            xmin = {start_s:.4f}",
            f"            xmax = {end_s:.4f}",
            f'            text = "{symbol}"',
        ]
    return "\n".join(lines) + "\n"


def _without_gaps(phones: Sequence[Phone], total_s: float) -> list[tuple[float, float, str]]:
    """Return intervals that cover the whole time: gaps become empty ones, overlaps are cut."""
    intervals: list[tuple[float, float, str]] = []
    now_s = 0.0
    for number, phone in enumerate(phones):
        next_s = phones[number + 1].onset_s if number + 1 < len(phones) else total_s
        start_s = max(now_s, phone.onset_s)
        end_s = min(phone.onset_s + phone.duration_s, next_s, total_s)
        if round(end_s, 4) <= round(start_s, 4):
            continue
        if round(start_s, 4) > round(now_s, 4):
            intervals.append((now_s, start_s, ""))
        else:
            start_s = now_s
        intervals.append((start_s, end_s, phone.symbol))
        now_s = end_s
    if round(total_s, 4) > round(now_s, 4):
        intervals.append((now_s, total_s, ""))
    return intervals


_STYLES: dict[str, Callable[[Sequence[Phone], float], str]] = {
    "table": _table,
    "csv": _csv,
    "json": _json,
    "textgrid": _textgrid,
}
