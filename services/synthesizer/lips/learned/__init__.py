"""Learned lips: predicted from the audio; recognized phones add closures and the tongue."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kouxing.services.lip_models import LipModelInfo

if TYPE_CHECKING:  # importing NumPy would slow down every command
    from kouxing.services.synthesizer.lips.lip_model import LipModel
    from kouxing.shared.phones.inventory import PhoneInventory


def _load(inventory: PhoneInventory) -> LipModel:
    from kouxing.services.synthesizer.lips.dynamic_visemes.model import DynamicVisemes
    from kouxing.services.synthesizer.lips.dynamic_visemes.parameters import load_parameters
    from kouxing.services.synthesizer.lips.learned.model import LearnedLips

    return LearnedLips(DynamicVisemes(load_parameters(), inventory))


LIP_MODEL = LipModelInfo(
    delay_ms=60.0, titles={"en": "from the audio (learned)", "zh": "由声音（学得）"}, load=_load
)
