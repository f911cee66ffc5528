"""The plug-ins that other distributions add by entry points, such as lip models and languages."""

from functools import lru_cache
from importlib.metadata import entry_points


@lru_cache
def plugins(group: str) -> dict[str, str]:
    """Return the plug-ins of a group of entry points by name, without importing them.

    A plug-in is a package, or ``package:object``.
    """
    return {entry.name: entry.value for entry in entry_points(group=group)}
