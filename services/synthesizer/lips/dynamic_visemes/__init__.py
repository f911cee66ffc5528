"""Dynamic visemes (Wang & Cai 2003; Li et al. 2011): lips from recognized phones."""

from typing import Any

from kouxing.services.lip_models import LipModelInfo
from kouxing.shared.phones.inventory import PhoneInventory


def _load(inventory: PhoneInventory) -> Any:  # importing NumPy would slow down every command
    from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
    from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters

    return DynamicVisemes(load_parameters(), inventory)


LIP_MODEL = LipModelInfo(
    delay_ms=160.0,
    titles={"en": "from the phones (dynamic visemes)", "zh": "由音素（动态视位）"},
    load=_load,
)
