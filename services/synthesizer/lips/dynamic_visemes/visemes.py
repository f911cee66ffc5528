"""The visemes of this lip model; converts phones to visemes.

The language's inventory lists the visemes of each phone. The visemes follow Li et al. 2011,
table 1, each named after a phone. The rounded variants of consonants before rounded vowels, and the
static targets in ``targets.tsv``, are from Crystal.TTVS (Tsinghua University, Apache-2.0). Sounds
of other languages have visemes that are derived from these (``derived_visemes``).
"""

import numpy as np

from kouxing.services.synthesizer.lips.dynamic_visemes.derived_visemes import (
    compute_derived_targets,
    load_derived_visemes,
)
from kouxing.shared.arrays import Doubles
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import LIP_HEIGHT_FAPS, LOWER_LIP_FAPS
from kouxing.shared.files.tsv_tables import read_table
from kouxing.shared.phones.inventory import PhoneInventory, VisemeFractions

REST = "rest"
TRAINED_VISEMES = (
    REST,
    *"b f d d_rounded l l_rounded g g_rounded j j_rounded zh zh_rounded z z_rounded".split(),
    *"a ai ao o ou e ei er i u v".split(),
)
VISEMES = (*TRAINED_VISEMES, *(viseme.name for viseme in load_derived_visemes()))
VISEME_INDEX = {viseme: index for index, viseme in enumerate(VISEMES)}

# lips meet; lower lip meets the teeth
CLOSURE_FAPS = {"b": LIP_HEIGHT_FAPS, "f": LOWER_LIP_FAPS}

ROUNDED_VISEMES = frozenset({"u", "v", "w", "oe"})


def visemes_of(phone: str, next_phone: str | None, inventory: PhoneInventory) -> VisemeFractions:
    """Return the visemes of a phone in order, each with its fraction of the phone's duration.

    ``next_phone`` is the phone that follows without a pause, if known. Some phones have another
    viseme before a rounded phone.
    """
    rounded = inventory.before_rounded.get(phone)
    if (
        rounded is not None
        and next_phone is not None
        and inventory.visemes[next_phone][0][0] in ROUNDED_VISEMES
    ):
        return ((rounded, 1.0),)
    return inventory.visemes[phone]


def check_visemes(inventory: PhoneInventory) -> None:
    """Check that a language uses only visemes of this model.

    Raises ``UserError`` if a viseme is unknown.
    """
    named = {viseme for visemes in inventory.visemes.values() for viseme, _ in visemes}
    unknown = sorted({*named, *inventory.before_rounded.values()} - VISEME_INDEX.keys())
    if unknown:
        raise UserError(
            f"language {inventory.language}: phones.tsv contains the unknown visemes "
            f"{', '.join(unknown)}; use {', '.join(VISEMES)}"
        )


def static_targets() -> Doubles:
    """Return the static targets T (num_visemes, num_mouth_faps), FAP units, as MOUTH_FAPS."""
    table = (list(row.values()) for row in read_table(__package__, "targets.tsv"))
    rows = {viseme: [float(value) for value in values] for viseme, *values in table}
    trained = np.array([rows[viseme] for viseme in TRAINED_VISEMES])
    return np.concatenate([trained, compute_derived_targets(trained, VISEME_INDEX)])
