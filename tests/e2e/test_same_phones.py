"""All commands and clients return the same spoken phones of a recording."""

from __future__ import annotations

import asyncio
import csv
import re
from pathlib import Path

from kouxing_client import AsyncClient, Phone

from tests.e2e.following import samples_of_file
from tests.system import DEMO, System, kouxing, start_python


async def speak_while_listening(system: System, path: Path) -> tuple[list[Phone], list[str]]:
    """Stream a file; return the phones of the client and of ``kouxing listen``."""
    async with AsyncClient(system.control) as client:
        async with await client.open_session(encoding="f32le", paced=False) as session:
            phones = await session.phones()
            command = ("-m", "kouxing", "listen", session.name, "--show", "phones")
            listener = start_python(*command, control=system.control)
            assert listener.stderr
            assert listener.stderr.readline() == f"following session {session.name}\n"
            await session.push(samples_of_file(path))
            await session.finish()
            spoken = [phone async for phone in phones if phone.is_spoken]
        printed, _ = listener.communicate(timeout=60)
    return spoken, [line.split()[-1] for line in printed.splitlines()]


def num_phones(report: str) -> int:
    match = re.search(r"(\d+) phones", report)
    assert match, report
    return int(match[1])


def test_all_outputs_have_the_same_phones(system: System, tmp_path: Path) -> None:
    path, table = DEMO / "fast-female.wav", tmp_path / "phones.csv"
    spoken, printed = asyncio.run(speak_while_listening(system, path))
    assert printed == [phone.symbol for phone in spoken]
    assert all(phone.duration > 0 for phone in spoken)
    starts = [phone.media_time for phone in spoken]
    assert starts == sorted(starts)
    said = kouxing("speak", path, "--fast", control=system.control)
    live = kouxing("render", path, tmp_path / "live.csv", "--live")
    assert num_phones(said.stderr) == num_phones(live.stderr) == len(spoken)

    kouxing("phones", path, "-o", table)
    rows = list(csv.DictReader(table.read_text(encoding="utf-8").splitlines()))
    whole = kouxing("render", path, tmp_path / "whole.csv")
    assert num_phones(whole.stderr) == len(rows)
    assert all(float(row["duration_s"]) > 0 for row in rows)
    onsets_s = [float(row["onset_s"]) for row in rows]
    assert onsets_s == sorted(onsets_s)
