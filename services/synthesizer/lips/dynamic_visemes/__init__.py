"""Dynamic visemes (Wang & Cai 2003; Li et al. 2011): lips from recognized phones."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kouxing.services.lip_models import LipModelInfo

if TYPE_CHECKING:  # importing NumPy would slow down every command
    from kouxing.services.synthesizer.lips.lip_model import LipModel
    from kouxing.shared.phones.inventory import PhoneInventory


def _load(inventory: PhoneInventory) -> LipModel:
    from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
    from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters

    return DynamicVisemes(load_parameters(), inventory)


LIP_MODEL = LipModelInfo(
    delay_ms=160.0,
    titles={"en": "from the phones (dynamic visemes)", "zh": "由音素（动态视位）"},
    load=_load,
)
