"""Training of the Ferguson lips' table."""

from dataclasses import replace

import numpy as np
import pytest

from kouxing.services.synthesizer.lips.ferguson.contour import faps_of
from kouxing.services.synthesizer.lips.ferguson.key_frames import key_frames_of
from kouxing.services.synthesizer.lips.ferguson.table import load_table
from kouxing.shared.face.faps import MOUTH_FAPS
from kouxing.shared.phones.inventory import load_inventory
from kouxing.training.ferguson.recipe import fit_openings, relative_openings, travel_of
from tests.lips import clip_of, utterance

INVENTORY = load_inventory()
TABLE = load_table(INVENTORY)


def test_recovers_openings() -> None:
    phones = utterance(0, 200)
    time_s = np.arange(0.0, phones[-1].onset_s + 0.5, 0.04)
    true = replace(TABLE, opening={**TABLE.opening, "b": 0.0, "a": 5.0, "i": 1.5, "d": 2.5})
    opening = key_frames_of(phones, true, INVENTORY.silence).openings_at(time_s)
    clip = clip_of(time_s, faps_of(opening))
    relative = relative_openings([clip])[0]
    scale = 5.0 / np.percentile(opening, 98)  # the speaker's widest opening is 5
    np.testing.assert_allclose(relative, np.minimum(scale * opening, 5.0), atol=0.01)
    found = fit_openings([clip], [phones], INVENTORY)
    for symbol in ("a", "i", "u", "d", "b", "sh"):
        expected = min(scale * true.opening[symbol], 5.0)
        assert found[symbol] == pytest.approx(expected, abs=0.3)
    assert found["sil"] == found["b"] == 0.0
    # a phone without data follows its visemes
    assert found["ang"] == pytest.approx(found["a"], abs=0.3)
    travel = faps_of([5.0])[0] / scale
    np.testing.assert_allclose(travel_of([clip]), travel, rtol=0.05, atol=1e-9)
    assert len(travel_of([clip])) == len(MOUTH_FAPS)
