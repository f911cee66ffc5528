"""Reads the table of this lip model: typical values of each phone.

Each language has one file in this package, such as ``mandarin.tsv``. ``kouxing train ferguson``
writes this file; its first lines name the training data. Languages with universal phones share
``universal.tsv``.

=============== ===================================================================================
column          meaning
=============== ===================================================================================
phone           symbol; each of the language's phones once
opening         R, 0 (closed) to 5; 0 for silence
duration_s      typical duration, seconds
crossings       maximum zero-crossing rate, 0 to 1, at the start of a syllable with this phone
level           vowels: level of influence, 1 (strongest) to 4; else empty
influence       vowels: influence factor D of the level, 0 to 1; else empty
=============== ===================================================================================
"""

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources

from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import UNIVERSAL, PhoneInventory

MAX_OPENING = 5.0
COLUMNS = ("phone", "opening", "duration_s", "crossings", "level", "influence")


@dataclass(frozen=True, slots=True, kw_only=True)
class PhoneTable:
    """Typical values by phone symbol."""

    opening: Mapping[str, float]  # R, 0 to 5
    duration_s: Mapping[str, float]
    crossings: Mapping[str, float]  # at the start of a syllable
    level: Mapping[str, int]  # level of influence of each vowel, 1 to 4
    influence: Mapping[str, float]  # D of each vowel


def load_table(inventory: PhoneInventory) -> PhoneTable:
    """Read the table of a language.

    Raises ``UserError`` if the language has no table, or the table is damaged.
    """
    name = UNIVERSAL if inventory.has_universal_phones else inventory.language
    file = resources.files(__package__) / f"{name}.tsv"
    if not file.is_file():
        raise UserError(
            f"the lip model ferguson has no table for {inventory.language}; use another lip model"
        )
    return parse_table(file.read_text("utf-8"), inventory)


def parse_table(text: str, inventory: PhoneInventory) -> PhoneTable:
    """Read a table from its text.

    Raises ``UserError`` if phones are missing, or a value is invalid or out of range.
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
        raise UserError(f"the table of the lip model ferguson is damaged: {error}") from None
    fractions = (*table.crossings.values(), *table.influence.values())
    is_valid = (
        all(0.0 <= opening <= MAX_OPENING for opening in table.opening.values())
        and all(0.0 < duration_s < 10.0 for duration_s in table.duration_s.values())
        and all(0.0 <= fraction <= 1.0 for fraction in fractions)
    )
    if not is_valid:
        raise UserError("the table of the lip model ferguson is damaged: a value is out of range")
    return table
