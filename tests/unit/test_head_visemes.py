"""The mouth in the 26 Mandarin visemes of Crystal TTVS (Tsinghua HCSI, Apache-2.0)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from services.driver.head import Head
from shared.faps import NUM_FAPS

pytestmark = pytest.mark.unit

# ruff: noqa: E501
# FAP numbers of the columns, and the FAPs of the other side of the mouth with the same values
COLUMNS = (3, 4, 5, 6, 8, 10, 12, 14, 16, 17, 44, 45, 46, 47, 51, 52, 53, 55, 57, 59)
MIRRORED = {6: 7, 8: 9, 10: 11, 12: 13, 53: 54, 55: 56, 57: 58, 59: 60}
TABLE = """\
NA      0     0     0     0     0     0     0     0     0     0     0     0     0     0     0     0     0     0     0     0
d1     90  -200  -250   -10  -170  -250     0    20     0    50  -250     0    90   200  -150  -210    20  -120  -210    10
d2    110  -150  -250  -170  -120  -210   -60    10    60   120  -250     0   -50     0  -120  -150  -120   -70  -120   100
l1     90  -220  -250   -20  -180  -250   -10    10     0    60     0     0     0     0   -70  -290    10   -90  -240    30
l2    100  -150  -200  -190  -100  -130   -60     0   190   190  -150  -150     0     0  -160  -120  -110  -150  -120    20
g1    150  -150  -300   -40  -150  -280   -30     0   -10    60  -200   -50     0   200  -190  -270    20  -180  -270    10
g2    110  -170  -230  -160  -100  -180   -30    20   190   130   -60   -60  -200     0  -160  -220  -160  -150  -180    10
j1     50  -210  -200   -20  -190  -200    30     0     0    60     0     0     0     0  -180  -110   -20  -180  -120     0
j2     90  -150  -200  -200  -120  -160   -60    20   140   180  -100     0  -100     0  -170  -120  -120  -130  -110    10
zh1     0  -260  -100   -50  -270  -120    10    70    30    60     0     0     0     0  -180   -80     0  -180   -80     0
zh2   110  -150  -200  -260   -90  -170   -30   120   110   180  -100     0  -110     0  -130  -130  -130  -100  -100    20
z1     40  -250  -170   -90  -210  -200     0   130    20    60   -50    50   -10     0  -190  -150   -40  -180  -150     0
z2    120  -120  -220  -180   -50  -170   -20   110   100   130  -110     0  -110     0  -150  -120  -100  -100  -120    10
b2      0     0     0   -50     0     0   -20     0    50    50  -120   -50  -120     0    10    80  -100    10    30   -30
f      80  -150     0   -70  -160     0    20   -10     0   -50   100   -50  -100    80  -170   -20   -40  -180   -50    50
a     450  -280  -600   -40  -220  -520   -70     0     0    70  -210  -100  -220   120  -260  -510   -40  -230  -520   -20
ai    440  -230  -610   -40  -190  -520   -60     0     0    70  -500  -100  -300   120  -230  -500   -10  -190  -520   -20
ao    450  -250  -500   -50  -190  -430   -50   -10     0    60  -350    50  -180    10  -240  -430   -10  -190  -410   -30
o     320  -200  -340  -190  -150  -280  -140     0   100   190  -150    50  -150     0  -230  -210  -110  -170  -220   -20
ou    400  -180  -510   -90  -150  -450  -210   -30   100   120  -320     0  -120     0  -170  -400   -60  -150  -340   -40
e     160  -200  -350   -60  -180  -280   -20    10     0    60   -50   -90  -100    80  -160  -250   -20  -150  -210    10
ei    160  -190  -300   -40  -170  -290   -20    10     0    60   -60   -40   -80   120  -180  -250   -20  -160  -230   -10
er    260  -220  -400   -30  -150  -340   -30     0     0    60  -130   -10  -130   280  -230  -300   -30  -190  -300   -30
i      90  -230  -230   -50  -160  -230   -90    30    10    60  -150  -100     0     0  -160  -200   -20  -110  -200   -30
u     160  -160  -240  -180   -80  -180   -50    60   170   180  -240     0     0     0  -190  -180  -120  -150  -150   -10
v     190  -100  -120  -150   -50  -100   -20    70   100   100   -50     0   -70     0  -180   -80  -100  -150   -70    10
"""


def read_table() -> dict[str, NDArray[np.float32]]:
    table = {}
    for line in TABLE.splitlines():
        name, *values = line.split()
        faps = np.zeros(NUM_FAPS, np.float32)
        for number, value in zip(COLUMNS, values, strict=True):
            faps[number - 1] = float(value)
            faps[MIRRORED.get(number, number) - 1] = float(value)
        table[name] = faps
    return table


VISEMES = read_table()
PAIRS = (("2.2", "2.3"), ("2.6", "2.8"), ("2.7", "2.9"))


@pytest.fixture(scope="module")
def head() -> Head:
    return Head.load()


def gaps_mm(head: Head, faps: NDArray[np.float32]) -> NDArray[np.float64]:
    """Height of the mouth's opening at its middle and halfway to both corners."""
    vertices = head.deform(faps)
    return np.array(
        [
            1000 * (vertices[head.feature_points[up]] - vertices[head.feature_points[low]])[1]
            for up, low in PAIRS
        ]
    )


@pytest.mark.parametrize("name", VISEMES)
def test_lips_do_not_cross(head: Head, name: str) -> None:
    # at rest they are pressed together by 0.4 mm
    assert gaps_mm(head, VISEMES[name]).min() > -0.6


def test_lips_are_closed_at_rest(head: Head) -> None:
    assert gaps_mm(head, VISEMES["NA"]).max() <= 0.0


def test_lips_are_closed_in_b_p_m(head: Head) -> None:
    assert gaps_mm(head, VISEMES["b2"]).max() <= 0.1


def test_mouth_is_open_in_a(head: Head) -> None:
    assert gaps_mm(head, VISEMES["a"]).min() > 8


def test_u_is_rounded_and_protruded(head: Head) -> None:
    rest, u = head.vertices, head.deform(VISEMES["u"])
    left, right = head.feature_points["2.4"], head.feature_points["2.5"]
    assert (u[left] - u[right])[0] < 0.7 * (rest[left] - rest[right])[0]
    for point in ("2.2", "2.3"):
        assert (u - rest)[head.feature_points[point], 2] > 0.002


def test_teeth_stay_behind_the_lips(head: Head) -> None:
    """The front teeth never come out between or through the lips' middle."""
    for name, faps in VISEMES.items():
        vertices = head.deform(faps)
        lips = min(vertices[head.feature_points[p], 2] for p in ("2.2", "2.3"))
        for row in ("teeth_upper", "teeth_lower"):
            assert vertices[head.part(row).vertices, 2].max() < lips, name


def test_tongue_stays_in_the_mouth(head: Head) -> None:
    for name, faps in VISEMES.items():
        vertices = head.deform(faps)
        tip = vertices[head.part("tongue").vertices, 2].max()
        assert tip < vertices[head.feature_points["2.3"], 2], name
