"""The installed lip models.

Each lip model is a package whose ``__init__`` defines ``LIP_MODEL``, a ``LipModelInfo``. Packages
next to this module are built in. Other distributions add lip models by entry points of the group
``kouxing.lip_models``: the entry point's name is that of the lip model, its value is the package.
"""

from __future__ import annotations

import importlib
import pkgutil
from functools import lru_cache
from importlib.metadata import entry_points
from pathlib import Path

from kouxing.services.synthesizer.lips.lip_model import LipModel, LipModelInfo
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_models import DEFAULT_LIP_MODEL
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory

ENTRY_POINTS = "kouxing.lip_models"


@lru_cache
def lip_models() -> dict[str, LipModelInfo]:
    """Return the installed lip models by name.

    Raises
    ------
    UserError
        If an installed lip model cannot be imported.
    """
    packages = {
        module.name.replace("_", "-"): f"{__package__}.{module.name}"
        for module in pkgutil.iter_modules([str(Path(__file__).parent)])
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
    """Return an installed lip model's description.

    Raises
    ------
    UserError
        If the lip model is not installed.
    """
    if name not in lip_models():
        raise UserError(f"unknown lip model {name!r}; use one of {', '.join(lip_models())}")
    return lip_models()[name]


@lru_cache
def load_lip_model(language: str = DEFAULT_LANGUAGE, name: str = DEFAULT_LIP_MODEL) -> LipModel:
    """Load a lip model for the phones of a language.

    Raises
    ------
    UserError
        If the lip model or the language is not installed, or the lip model does not support it.
    """
    return lip_model_info(name).load(load_inventory(language))
