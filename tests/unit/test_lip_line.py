"""Lips of the head beside those of plain zones of influence."""

from __future__ import annotations

import numpy as np
import pytest

from kouxing.evaluation.lips.lip_line import PlainZones, away_from_spline, with_fields
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.head.import_fields import INNER, OUTER, FaceFields
from kouxing.services.synthesizer.lips.ferguson.contour import faps_of
from kouxing.shared.face.faps import MOUTH_FAPS, NUM_FAPS

pytestmark = pytest.mark.unit


def test_plain_zones_move_the_points_alike_but_not_what_lies_between() -> None:
    head = Head.load(detail="coarse")
    faps = np.zeros(NUM_FAPS, dtype=np.float32)
    faps[np.array(MOUTH_FAPS) - 1] = faps_of([5.0])[0]
    shown = {kind: with_fields(head, kind) for kind in (FaceFields, PlainZones)}
    moved = {kind: one.deform(faps) - head.vertices for kind, one in shown.items()}
    points = [head.feature_points[name] for name in INNER + OUTER]
    millimetre = 1e-3
    apart = np.abs(moved[PlainZones] - moved[FaceFields]).max(axis=1)
    assert apart[points].max() < 0.05 * millimetre
    assert apart[head.part("skin").vertices].max() > millimetre
    bumps = {kind: away_from_spline(one, faps).mean() for kind, one in shown.items()}
    assert bumps[FaceFields] < 0.7 * bumps[PlainZones]
