"""Loads lip models by name."""

from functools import lru_cache

from kouxing.services.lip_models import lip_model_info
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory


@lru_cache
def load_lip_model(language: str = DEFAULT_LANGUAGE, name: str = DEFAULT_LIP_MODEL) -> LipModel:
    """Load a lip model for the phones of a language.

    Raises ``UserError`` if the lip model or the language is not installed, or the lip model does
    not support it.
    """
    lip_model: LipModel = lip_model_info(name).load(load_inventory(language))
    return lip_model
