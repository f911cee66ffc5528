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
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import PhoneInventory

ENTRY_POINTS = "kouxing.lip_models"
_BUILT_IN = "synthesizer", "lips"


@dataclass(frozen=True, slots=True, kw_only=True)
class LipModelInfo:
    """Description of a lip model, available without loading it.

    Attributes
    ----------
    delay_ms
        Default delay: how much later than its audio a frame is made.
    titles
        Name for users by language, "en" and "zh".
    load
        Loads the lip model, a ``LipModel``, for a language. Only this imports its modules.
    """

    delay_ms: float
    titles: Mapping[str, str]
    load: Callable[[PhoneInventory], Any]


@lru_cache
def lip_models() -> dict[str, LipModelInfo]:
    """Return the installed lip models by name.

    Raises ``UserError`` if an installed lip model cannot be imported.
    """
    folder = Path(__file__).parent.joinpath(*_BUILT_IN)
    packages = {
        module.name.replace("_", "-"): ".".join((__package__, *_BUILT_IN, module.name))
        for module in pkgutil.iter_modules([str(folder)])
        if module.ispkg
    }
    packages |= {entry.name: entry.value for entry in entry_points(group=ENTRY_POINTS)}
    models = {}
    for name, package in sorted(packages.items()):
        try:
            models[name] = importlib.import_module(package).LIP_MODEL
        except (ImportError, AttributeError) as error:
            text = f"cannot import the lip model {name} from {package}: {error}"
            raise UserError(text) from error
    return models


def lip_model_info(name: str) -> LipModelInfo:
    """Return the description of an installed lip model.

    Raises ``UserError`` if the lip model is not installed.
    """
    if name not in lip_models():
        raise UserError(f"unknown lip model {name!r}; use one of {', '.join(lip_models())}")
    return lip_models()[name]
