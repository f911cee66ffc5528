"""Points, FAPs and drawings of the Ferguson contour."""

from __future__ import annotations

from xml.etree import ElementTree

import pytest

from kouxing.services.synthesizer.lips.ferguson import drawing
from kouxing.services.synthesizer.lips.ferguson.contour import (
    LINES,
    faps_of,
    lip_lines,
    lip_points,
)
from kouxing.shared.face.faps import FAPS, MOUTH_FAPS

pytestmark = pytest.mark.unit


@pytest.mark.parametrize("opening", [0.0, 1.7, 5.0])
def test_feature_points_travel_as_measured(opening: float) -> None:
    lines, points = lip_lines(), lip_points()
    faps = dict(zip(MOUTH_FAPS, faps_of([opening])[0], strict=True))
    for name, members in LINES.items():
        for member in members:
            point = points[member]
            assert point.fap is not None
            assert member in FAPS[point.fap - 1].feature_points
            sign = 1.0 if FAPS[point.fap - 1].direction == "up" else -1.0
            rise = sign * faps[point.fap] * 0.39 / 1024.0  # mouth widths
            assert lines[name].heights([point.x], [opening])[0, 0] == pytest.approx(point.y + rise)


def test_curves_have_two_continuous_derivatives() -> None:
    for line in lip_lines().values():
        for curve in (line.closed, line.travel):
            for knot in curve.x[1:-1]:
                for order in range(3):
                    before, after = curve([knot - 1e-9, knot + 1e-9], order)
                    assert before == pytest.approx(after, abs=1e-4)


def test_svg_and_picture_agree() -> None:
    mouths = [drawing.LabeledMouth(0.1 * number, 2.5 * number, "a<", "ba") for number in range(3)]
    strip = drawing.strip(mouths, max_columns=2, mouth_px=60.0)
    root = ElementTree.fromstring(drawing.svg(strip))  # noqa: S314 - our own
    assert [element.text for element in root if element.tag.endswith("text")].count("a<") == 3
    picture = drawing.rasterize(strip)
    assert picture.shape == (strip.height_px, strip.width_px, 3)

    def dark_rows(moment: drawing.LabeledMouth) -> int:
        """Return the rows of the middle column that show the inside of the mouth."""
        column = drawing.rasterize(drawing.image(moment, 320, 240))[:200, 160].astype(int)
        return int((column.sum(axis=1) < 200).sum())

    assert dark_rows(mouths[0]) <= 2 < dark_rows(mouths[2])
