"""Ferguson lips (Zhang et al. 2021): a single opening R, drawn as Ferguson curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kouxing.services.lip_models import LipModelInfo

if TYPE_CHECKING:  # importing NumPy would slow down every command
    from kouxing.services.synthesizer.lips.lip_model import LipModel
    from kouxing.shared.phones.inventory import PhoneInventory


def _load(inventory: PhoneInventory) -> LipModel:
    from kouxing.services.synthesizer.lips.ferguson.model import FergusonLips
    from kouxing.services.synthesizer.lips.ferguson.phone_table import load_table

    return FergusonLips(load_table(inventory), inventory)


LIP_MODEL = LipModelInfo(
    delay_ms=160.0,
    titles={"en": "from the phones, opening only (Ferguson)", "zh": "由单一开口（Ferguson）"},
    load=_load,
)
