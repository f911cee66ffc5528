"""Names of the blendshape sets, and the names that avatars give to their shapes.

``shape_names.txt`` is the only table of names. The JavaScript client and Blender contain the same
table; Unity and Godot send the names of their avatar to the gateway. Each line or continuation
belongs to a set. An entry is a shape and its other names, ``shape=OTHER=PART+PART``; a sum of parts
also forms the shape. An avatar can speak if it has the first shape of a set, and speaks well if it
has all shapes with ``*``.

Names match in any case, after any prefix, before a number (``.001``), and with ``_L``, ``.L`` or
``Left`` at the end. A name of one letter matches only without a prefix or after ``.``, ``:``, ``|``
or ``/``. After a prefix without a separator (``bsJawOpen``), only names of 7 or more letters match.
"""

import re
from collections.abc import Iterable
from enum import StrEnum
from functools import lru_cache
from pathlib import Path

from kouxing.shared.errors import UserError


class ShapeSetName(StrEnum):
    """A set of blendshapes."""

    ARKIT = "arkit"  # ARKit's 52 blendshapes
    OCULUS = "oculus"  # Oculus' 15 visemes
    VRM = "vrm"  # VRM 1's expressions


TABLE = Path(__file__).with_name("shape_names.txt").read_text(encoding="utf-8")
_TITLES = {"arkit": "ARKit", "oculus": "Oculus", "vrm": "VRM"}
_SEPARATOR = re.compile(r"[._:|/\- ]|eCTRL|(?<=[a-z])(?=[A-Z])")
_SIDES = {"L": "Left", "R": "Right"}


def find_shapes(set_name: str, names: Iterable[str]) -> dict[str, str]:
    """Return the shapes of the recognized names of a mesh, by name.

    If a mesh has a shape under several names, only the first name of the table counts.
    """
    entries = _TABLE[set_name]
    keys = {key for choices in entries.values() for parts in choices for key in parts}
    by_key: dict[str, str] = {}
    for name in names:
        key = next((key for key in _candidates(name) if key in keys), "")
        by_key.setdefault(key, name)
    shape_of: dict[str, str] = {}
    for shape, choices in entries.items():
        parts = next((parts for parts in choices if not by_key.keys().isdisjoint(parts)), [])
        shape_of |= {by_key[key]: shape for key in parts if key in by_key}
    return shape_of


def choose_set(names: Iterable[str]) -> ShapeSetName:
    """Return the set that moves an avatar: the first complete set, or the most complete one.

    Raises ``UserError`` if the avatar cannot speak; the text names what the nearest set lacks.
    """
    names = list(names)
    missing, penalty = {}, {}
    for set_name, needed in _NEEDED.items():
        known = set(find_shapes(set_name, names).values())
        missing[set_name] = [shape for shape in needed if shape not in known]
        # between equals, the number of known shapes decides
        penalty[set_name] = len(missing[set_name]) / len(needed) - len(known) / 1000
    speaking = [name for name in missing if _NEEDED[name][0] not in missing[name]]
    if speaking:
        complete = [name for name in speaking if not missing[name]]
        return ShapeSetName((complete or [min(reversed(speaking), key=penalty.__getitem__)])[0])
    nearest = min(missing, key=penalty.__getitem__)
    raise UserError(
        f"the avatar cannot speak: it has no shape {', '.join(missing[nearest])} of"
        f" {_TITLES[nearest]}; use an avatar with the shapes of ARKit, Oculus or VRM"
    )


def _key(name: str) -> str:
    return _SEPARATOR.sub("", name).lower()


def _spell_out_side(name: str) -> str:
    """Remove a number at the end of a name, and spell out the side before it."""
    name = re.sub(r"[._ ](div)?\d+$", "", name)  # Blender appends .001, Daz _div2
    return re.sub(
        r"(?:[._\- ]([LRlr])|(?<=[a-z])([LR]))$",
        lambda match: _SIDES[(match[1] or match[2]).upper()],
        name,
    )


@lru_cache(maxsize=1024)
def _candidates(name: str) -> list[str]:
    """Return a name's keys: one for all its words, and one for those after each separator."""
    name = _spell_out_side(name)
    keys = [_key(name)]
    for separator in _SEPARATOR.finditer(name):
        key = _key(name[separator.end() :])
        mark = separator[0]
        if len(key) > (1 if mark else 6) or mark in tuple(".:|/"):
            keys.append(key)
    return keys


def _read_table() -> tuple[dict[str, dict[str, list[list[str]]]], dict[str, list[str]]]:
    """Return the names of each set's shapes, as keys, and the shapes that an avatar needs."""
    table: dict[str, dict[str, list[list[str]]]] = {}
    needed: dict[str, list[str]] = {}
    set_name = ""
    for line in TABLE.splitlines():
        words = line.split()
        if not line.startswith(" "):
            set_name = words.pop(0)
            table[set_name], needed[set_name] = {}, []
        for word in words:
            choices = word.lstrip("*").split("=")
            table[set_name][choices[0]] = [
                [_key(_spell_out_side(part)) for part in choice.split("+")] for choice in choices
            ]
            if word.startswith("*"):
                needed[set_name].append(choices[0])
    return table, needed


_TABLE, _NEEDED = _read_table()
