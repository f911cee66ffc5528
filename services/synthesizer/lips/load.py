"""Loads lip models by name."""

from functools import lru_cache

from kouxing.services.lip_models import lip_model_info
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_constants import DEFAULT_LIP_MODEL
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, load_inventory


@lru_cache
def load_lip_model(language: str = DEFAULT_LANGUAGE, name: str = DEFAULT_LIP_MODEL) -> LipModel:
    """Load a lip model for the phones of a language.

    Raises ``UserError`` if the lip model or the language is not installed, or the lip model is
    faulty or does not support the language.
    """
    info, inventory = lip_model_info(name), load_inventory(language)
    try:
        lip_model = info.load(inventory)
    except UserError:
        raise
    except Exception as error:  # code of another distribution may raise any exception
        raise UserError(f"cannot load the lip model {name} for {language}: {error!r}") from error
    if not isinstance(lip_model, LipModel):
        raise UserError(
            f"lip model {name}: load returned {type(lip_model).__name__}, which is not a LipModel;"
            " it needs the attributes stream and amplitude_applies"
        )
    return lip_model
