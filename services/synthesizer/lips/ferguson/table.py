"""The table of this lip model: what is usual of each phone.

One file for each language stands beside this one, ``mandarin.tsv``; ``kouxing train ferguson``
makes it, and its first lines say from what.

=============== ===================================================================================
column          meaning
=============== ===================================================================================
phone           symbol; each of the language's phones once
opening         R, 0 (closed) to 5; 0 for silence
duration_s      usual length, seconds
crossings       greatest zero-crossing rate, 0 to 1, where a syllable begins with the phone
level           vowels: level of influence, 1 (strongest) to 4; else empty
influence       vowels: influence factor D of the level, 0 to 1; else empty
=============== ===================================================================================
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

from kouxing.services.synthesizer.lips.ferguson.motion import MAX_OPENING
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory

COLUMNS = ("phone", "opening", "duration_s", "crossings", "level", "influence")


@dataclass(frozen=True, slots=True, kw_only=True)
class PhoneTable:
    """What is usual of each phone, by its symbol."""

    opening: Mapping[str, float]  # R, 0 to 5
    duration_s: Mapping[str, float]
    crossings: Mapping[str, float]  # where a syllable begins
    level: Mapping[str, int]  # of influence, 1 to 4, of each vowel
    influence: Mapping[str, float]  # D of each vowel


def load_table(inventory: PhoneInventory) -> PhoneTable:
    """Read the table of a language.

    Raises
    ------
    UserError
        If there is none, or it is damaged.
    """
    file = (
        resources.files("kouxing.services.synthesizer.lips.ferguson") / f"{inventory.language}.tsv"
    )
    if not file.is_file():
        raise UserError(
            f"the ferguson lips have no table for {inventory.language}; choose another lip model"
        )
    return parse_table(file.read_text("utf-8"), inventory)


def parse_table(text: str, inventory: PhoneInventory) -> PhoneTable:
    """Read a table from its text.

    Raises
    ------
    UserError
        If phones are missing, or a value is no number or out of range.
    """
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    rows = {row["phone"]: row for row in csv.DictReader(lines, delimiter="\t") if "phone" in row}
    try:
        table = PhoneTable(
            opening={phone: float(rows[phone]["opening"]) for phone in inventory.phones},
            duration_s={phone: float(rows[phone]["duration_s"]) for phone in inventory.phones},
            crossings={phone: float(rows[phone]["crossings"]) for phone in inventory.phones},
            level={phone: int(rows[phone]["level"]) for phone in sorted(inventory.vowels)},
            influence={
                phone: float(rows[phone]["influence"]) for phone in sorted(inventory.vowels)
            },
        )
    except (KeyError, ValueError, TypeError) as error:
        raise UserError(f"the table of the ferguson lips is damaged: {error}") from None
    is_right = (
        all(0.0 <= one <= MAX_OPENING for one in table.opening.values())
        and all(0.0 < one < 10.0 for one in table.duration_s.values())
        and all(0.0 <= one <= 1.0 for one in (*table.crossings.values(), *table.influence.values()))
    )
    if not is_right:
        raise UserError("the table of the ferguson lips is damaged: a value is out of range")
    return table


def format_table(table: PhoneTable, inventory: PhoneInventory, about: list[str]) -> str:
    """Write a table as text, below lines that say how it was made."""
    rows = [
        (
            phone,
            f"{table.opening[phone]:.2f}",
            f"{table.duration_s[phone]:.3f}",
            f"{table.crossings[phone]:.2f}",
            str(table.level.get(phone, "")),
            f"{table.influence[phone]:.2f}" if phone in table.influence else "",
        )
        for phone in inventory.phones
    ]
    lines = [*(f"# {line}" for line in about), *("\t".join(row) for row in (COLUMNS, *rows))]
    return "\n".join(lines) + "\n"
