"""Writes the table of the lip model ferguson."""

from __future__ import annotations

from kouxing.services.synthesizer.lips.ferguson.table import COLUMNS, PhoneTable
from kouxing.shared.phones.inventory import PhoneInventory


def format_table(table: PhoneTable, inventory: PhoneInventory, about: list[str]) -> str:
    """Return a table as text, after comment lines about its origin."""
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
