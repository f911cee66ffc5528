"""Loads the acoustic model for a language."""

import copy
from dataclasses import replace
from functools import cache

import numpy as np

from kouxing.services.recognizer.acoustic.acoustic_model import AcousticModel
from kouxing.services.recognizer.acoustic.load import DEFAULT_MODEL, load_model
from kouxing.shared.errors import UserError
from kouxing.shared.phones.inventory import (
    DEFAULT_LANGUAGE,
    TABLE_LANGUAGES,
    UNIVERSAL,
    load_inventory,
)

MODEL_LANGUAGES = (DEFAULT_LANGUAGE, UNIVERSAL, *TABLE_LANGUAGES)  # shipped models
_EXCLUDED_LOG_PROB = np.float32(-1e3)  # log-probability of a phone that the language lacks


@cache
def load_model_for_language(
    language: str | None = None, acoustic: str | None = None
) -> AcousticModel:
    """Return the acoustic model with the phones of a language; by default Mandarin.

    Mandarin has its own model. For other languages, the universal model is restricted to the phones
    of the language. ``acoustic`` names another model, or its file. Without a language, all phones
    of the model are used.

    Raises ``UserError`` if the language is not installed, or the model has other phones.
    """
    is_default = language in (None, DEFAULT_LANGUAGE)
    model = load_model(acoustic or (DEFAULT_MODEL if is_default else UNIVERSAL))
    model_language = model.inventory.language
    if language in (None, model_language):
        return model
    inventory = load_inventory(language)
    if model_language != UNIVERSAL or not inventory.has_universal_phones:
        raise UserError(
            f"the acoustic model {acoustic or UNIVERSAL} has the phones of {model_language}; use"
            f" that language, or a model for {language}"
        )
    return restrict_phones(model, inventory.phones)


def restrict_phones(model: AcousticModel, phones: tuple[str, ...]) -> AcousticModel:
    """Return a copy of a model that recognizes only these phones. Both share the network."""
    language_model = model.topology.phone_lm
    is_spoken = np.array([phone in phones for phone in model.inventory.phones])
    log_prob = np.where(
        is_spoken[language_model.phone], language_model.log_prob, _EXCLUDED_LOG_PROB
    )
    limited = copy.copy(model)
    topology = replace(model.topology, phone_lm=replace(language_model, log_prob=log_prob))
    object.__setattr__(limited, "topology", topology)
    return limited
