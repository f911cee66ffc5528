"""Find a lip model by its name."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
from kouxing.services.synthesizer.lips.learnt.model import LearntLips
from kouxing.services.synthesizer.lips.lip_model import LipModel
from kouxing.shared.errors import UserError
from kouxing.shared.face.lip_models import DEFAULT_LIP_MODEL, LipModelName
from kouxing.shared.phones.inventory import DEFAULT_LANGUAGE, PhoneInventory, load_inventory


def _ferguson(inventory: PhoneInventory) -> LipModel:
    # scipy.interpolate takes as long to import as all else: a synthesizer starts without it
    from kouxing.services.synthesizer.lips.ferguson.model import FergusonLips  # noqa: PLC0415
    from kouxing.services.synthesizer.lips.ferguson.table import load_table  # noqa: PLC0415

    return FergusonLips(load_table(inventory), inventory)


LIP_MODELS: dict[str, Callable[[PhoneInventory], LipModel]] = {
    LipModelName.DYNAMIC_VISEMES: lambda inventory: DynamicVisemes(load_parameters(), inventory),
    LipModelName.LEARNT: lambda inventory: LearntLips(DynamicVisemes(load_parameters(), inventory)),
    LipModelName.FERGUSON: _ferguson,
}


@lru_cache
def load_lip_model(language: str = DEFAULT_LANGUAGE, name: str = DEFAULT_LIP_MODEL) -> LipModel:
    """Load a lip model for the phones of a language.

    Parameters
    ----------
    language
        As ``load_inventory`` knows it.
    name
        A key of ``LIP_MODELS``.

    Raises
    ------
    UserError
        If there is no such lip model, the language is not installed, or the model lacks one of its
        visemes.
    """
    if name not in LIP_MODELS:
        raise UserError(f"there is no lip model {name!r}; choose one of {', '.join(LIP_MODELS)}")
    return LIP_MODELS[name](load_inventory(language))
