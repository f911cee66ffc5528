"""The installed lip models.

Each lip model is a package whose ``__init__`` defines ``LIP_MODEL``, a ``LipModelInfo``. Packages
in the synthesizer's folder ``lips`` are built in. Other distributions add lip models by entry
points of the group ``kouxing.lip_models``: the entry point has the name of the lip model, and its
value is the package.
"""

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from kouxing.shared.errors import UserError
from kouxing.shared.monitoring.logs import LOG
from kouxing.shared.phones.inventory import PhoneInventory
from kouxing.shared.plugins import plugins

ENTRY_POINTS = "kouxing.lip_models"
_BUILT_IN = "synthesizer", "lips"


@dataclass(frozen=True, slots=True, kw_only=True)
class LipModelInfo:
    """Description of a lip model, available without loading it."""

    delay_ms: float
    """default delay: how much later than its audio a frame is made"""
    titles: Mapping[str, str]
    """name for users by the languages ``en`` and ``zh``"""
    load: Callable[[PhoneInventory], Any]
    """loads the lip model, a ``LipModel``, for a language; only this imports its modules"""


def lip_models() -> dict[str, LipModelInfo]:
    """Return the installed lip models by name. Faulty ones are logged and left out."""
    models = {}
    for name in _packages():
        try:
            models[name] = lip_model_info(name)
        except UserError as error:
            LOG.warning("%s", error)
    return models


def lip_model_names() -> list[str]:
    """Return the names of the installed lip models, without importing them."""
    return list(_packages())


@lru_cache
def _packages() -> dict[str, str]:
    """Return the packages of the installed lip models by name, sorted."""
    folder = Path(__file__).parent.joinpath(*_BUILT_IN)
    packages = {
        module.name.replace("_", "-"): ".".join((__package__, *_BUILT_IN, module.name))
        for module in pkgutil.iter_modules([str(folder)])
        if module.ispkg
    }
    return dict(sorted((packages | plugins(ENTRY_POINTS)).items()))


def lip_model_info(name: str) -> LipModelInfo:
    """Return the description of an installed lip model.

    Raises ``UserError`` if the lip model is not installed, cannot be imported, or has no
    ``LipModelInfo``.
    """
    package = _packages().get(name)
    if package is None:
        raise UserError(f"unknown lip model {name!r}; use one of {', '.join(_packages())}")
    try:
        info = importlib.import_module(package).LIP_MODEL
    except Exception as error:  # code of another distribution may raise any exception
        raise UserError(f"cannot import the lip model {name} from {package}: {error}") from error
    if not isinstance(info, LipModelInfo):
        raise UserError(f"lip model {name} (package {package}): LIP_MODEL is not a LipModelInfo")
    return info
