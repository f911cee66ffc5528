"""A mesh and its feature points become a head; errors name the problem."""

from collections.abc import Callable
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from kouxing.services.driver.head.head import Head
from kouxing.services.driver.head.import_head import import_head
from kouxing.services.driver.head.mesh_file import numbered_vertices, read_mesh
from kouxing.shared.errors import UserError
from tests import heads
from tests.glb_writer import write_glb
from tests.heads import OPEN_MOUTH, neutral_faps
from tests.meshes import ORIGINAL, meshes, write_obj

HALF_TURN = np.array([-1.0, 1.0, -1.0])  # by 180 degrees about y


def import_points(mesh: Path, points: str, name: str = "points.tsv") -> tuple[Head, list[str]]:
    """Import a mesh with its feature points; return the head and the warnings."""
    path, output = mesh.with_name(name), mesh.with_name("out.npz")
    path.write_text(points, encoding="utf-8")
    warnings = import_head(mesh, path, output)
    return Head.load(output), warnings


def point_lines(head: Head, place: Callable[[np.ndarray], np.ndarray]) -> str:
    rows = []
    for name, vertex in head.feature_points.items():
        x, y, z = place(head.vertices[vertex].astype(float))
        rows.append(f"{name}\t{x:.6f}\t{y:.6f}\t{z:.6f}\n")
    return "point\tx\ty\tz\n" + "".join(rows)


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Head:
    """Return a longer face in centimeters, moved and facing backwards."""

    def place(points: np.ndarray) -> np.ndarray:
        return points * [100, 112, 100] * HALF_TURN + [30, 150, -7]  # type: ignore[no-any-return]

    parts = meshes()
    for part in parts:
        part.vertices = place(part.vertices)
    face = write_glb(tmp_path_factory.mktemp("import") / "face.glb", parts)
    head, warnings = import_points(face, point_lines(ORIGINAL, place))
    assert warnings == [
        "no points for these FAPs, so they have no effect: dilate_l_pupil, dilate_r_pupil"
    ]
    return head


def displacement(head: Head, faps: np.ndarray) -> np.ndarray:
    return head.deform(np.asarray(faps, np.float32)) - head.vertices


def test_parts_textures_and_units(imported: Head) -> None:
    assert {"skin", "eye_left", "eye_right", "teeth_lower", "tongue"} <= {
        part.name for part in imported.parts
    }
    skin, other = imported.part("skin"), ORIGINAL.part("skin")
    assert imported.textures[skin.texture] == ORIGINAL.textures["skin"]
    np.testing.assert_allclose(
        imported.colors[skin.vertices], ORIGINAL.colors[other.vertices], atol=0.01
    )
    ratios = [head.fapu["MNS"] / head.fapu["MW"] for head in (imported, ORIGINAL)]
    assert ratios[0] == pytest.approx(1.12 * ratios[1], rel=0.01)


def test_feature_points_move_as_defined(imported: Head) -> None:
    for fap, value in product(heads.DISPLACING_FAPS, (300.0, -120.0)):
        axis, expected = heads.travel_m(imported, fap, value)
        shift = displacement(imported, heads.single_fap(fap.number, value))
        for point in imported.feature_points.keys() & fap.feature_points:
            travel = shift[imported.feature_points[point], axis]
            assert travel == pytest.approx(expected, rel=0.05), (fap.name, point)


def test_jaw_eyes_head_and_shoulders(imported: Head) -> None:
    shift = displacement(imported, OPEN_MOUTH)
    unit = imported.fapu["MNS"]
    assert shift[imported.part("teeth_lower").vertices, 1].max() < -0.05 * unit
    assert np.abs(shift[imported.part("teeth_upper").vertices]).max() < 0.02 * unit
    turn = displacement(imported, neutral_faps(yaw_l_eyeball=30_000))
    left, right = (imported.part(name).vertices for name in ("eye_left", "eye_right"))
    assert np.abs(turn[left]).max() > 0.002
    assert not turn[right].any()
    nod = np.abs(displacement(imported, neutral_faps(head_yaw=30_000))).max(axis=1)
    assert nod[imported.feature_points["2.1"]] > 0.01
    assert nod[np.argmin(imported.vertices[:, 1])] < 0.001


def test_obj_with_vertex_numbers_and_seams(tmp_path: Path) -> None:
    parts = [part for part in meshes() if part.name in ("garment", "skin")][::-1]
    write_obj(tmp_path / "face.obj", parts)
    first = len(parts[0].vertices) if parts[0].name == "garment" else 0
    rows = [
        f"{name} {first + vertex}"
        for name, vertex in ORIGINAL.feature_points.items()
        if vertex < ORIGINAL.part("skin").vertices.stop
    ]
    eyes = {"3.5": ORIGINAL.eye_centers[0], "3.6": ORIGINAL.eye_centers[1]}
    rows += [f"{name} {' '.join(map(str, place))}  # inside" for name, place in eyes.items()]
    head, warnings = import_points(tmp_path / "face.obj", "\n".join(rows))
    assert "no eyeballs separate from the skin: the eyes do not rotate" in warnings
    shift = displacement(head, OPEN_MOUTH)
    assert shift[head.feature_points["2.3"], 1] < -0.4 * head.fapu["MNS"]
    # both vertices at a texture seam move and have the same normal
    skin = head.part("skin").vertices
    places = np.round(head.vertices[skin], 5)
    group = np.unique(places, axis=0, return_inverse=True)[1].ravel()
    assert len(places) > group.max() + 10
    for values in (shift[skin], head.pose(OPEN_MOUTH)[1][skin]):
        first_of = np.zeros((group.max() + 1, 3))
        first_of[group] = values
        assert np.abs(first_of[group] - values).max() < 1e-4


def test_reads_an_fdp_file(face: Path) -> None:
    skin = ORIGINAL.part("skin").vertices
    entries = "".join(
        f'<fdp name="{name}" affects="skin" index="{vertex}"><indices>1 2 3</indices></fdp>'
        for name, vertex in ORIGINAL.feature_points.items()
        if skin.start <= vertex < skin.stop and name != "9.15"
    )
    mns = ORIGINAL.fapu["MNS"]
    text = f'<?xml version="1.0"?><xfdp><head><fapu MNS0="{mns}" MW0="1"/></head>{entries}</xfdp>'
    head, _ = import_points(face, text, "face.fdp")
    scale = head.fapu["ES"] / ORIGINAL.fapu["ES"]
    assert head.fapu["MNS"] == pytest.approx(mns * scale, rel=0.02)
    assert displacement(head, OPEN_MOUTH)[head.feature_points["2.1"], 1] < -0.3 * head.fapu["MNS"]


@pytest.fixture
def face(tmp_path: Path) -> Path:
    return write_glb(tmp_path / "face.glb", meshes())


GOOD_POINTS = point_lines(ORIGINAL, lambda place: place)


def swapped_points(*names: str) -> str:
    """Return feature points; each of the named points has the position of the next one."""
    places = dict(row.split("\t", 1) for row in GOOD_POINTS.splitlines()[1:])
    shifted = {name: places[names[(i + 1) % len(names)]] for i, name in enumerate(names)}
    return "".join(f"{name}\t{place}\n" for name, place in (places | shifted).items())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no feature points"),
        ("2.1 0 0", "line 1: expected 'point x y z' or 'point vertex'"),
        ("# good\n2.1 0 0 x", "line 2: .* invalid number"),
        ("2.1 nan 0 0", "line 1: expected"),
        ("2.1 inf", "line 1: expected"),
        ("99.1 0 0 0", "'99.1' is not an MPEG-4 feature point"),
        ("2.1 0 0 0\n2.1 0 0 0", "line 2: 2.1 occurs twice"),
        ("2.1 1000000", "vertex 1000000, but the last vertex is"),
        ("2.1 0 -0.07 0.07", r"points are missing: 2.2, .* 8.8, 3.5 \(or its eyelids\)"),
        ("<xfdp><fdp", "invalid XML"),
        ("<!DOCTYPE x><xfdp/>", "document type"),
        ("<xfdp><fdp name='2.1' affects='skin'/></xfdp>", "index is missing"),
        (GOOD_POINTS.replace("\n8.1\t", "\n8.1 1 0 0 #"), "too far from the mesh.*: 8.1 by"),
        (swapped_points("8.3", "8.4"), "MW is not positive"),
        (swapped_points("2.1", "3.5", "3.6", "8.1"), "is not below the eyes"),
    ],
)
def test_rejects_bad_points(face: Path, text: str, message: str) -> None:
    with pytest.raises(UserError, match=message):
        import_points(face, text)
    assert not face.with_name("out.npz").exists()


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"
PLY = (
    "ply\nformat ascii 1.0\nelement vertex 3\n"
    "property float x\nproperty float y\nproperty float z\n"
    "element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
)
LARGE = "".join(f"v {n} {n % 2} 0\n" for n in range(65_538)) + "".join(
    f"f {n} {n + 1} {n + 2}\n" for n in range(1, 65_538, 3)
)


@pytest.mark.parametrize(
    "change", [("\n", "\r\n"), ("\n", "\r"), ("v 1", "v \\\n1"), ("", "\ufeff")]
)
def test_reads_obj_files_of_other_programs(tmp_path: Path, change: tuple[str, str]) -> None:
    text, path = f"{TRIANGLE}f 1 2 3\n", tmp_path / "face.obj"
    path.write_bytes(text.replace(*change, 4 if change[0] else 1).encode())
    pieces = read_mesh(path)
    for vertices in (pieces[0].vertices, numbered_vertices(path, pieces)[0]):
        assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("no_faces.obj", TRIANGLE, "has no faces"),
        ("garbage.ply", "ply\nformat ascii 1.0\nelement vertex 9\n", "damaged or is not a mesh"),
        ("large.obj", LARGE, "65538 vertices; reduce it to at most 65535"),
        ("missing.ply", PLY + "3 0 1 3\n", "refers to a missing vertex"),
        ("negative.ply", PLY + "3 -1 0 1\n", "refers to a missing vertex"),
        ("words.obj", "f 1 " * 1_500_001, "more than 3000000 words"),
        ("nameless.obj", TRIANGLE + "f 1 2 3\n", "points are missing"),
        ("flat.OBJ", TRIANGLE + "f 1 2 3\nv 7 8\n", "not a (mesh|valid vertex)"),
        ("face.fbx", "", "one of the formats .obj, .glb, .ply"),
        ("", "", "no such file"),
    ],
)
def test_rejects_bad_meshes(tmp_path: Path, name: str, text: str, message: str) -> None:
    mesh = tmp_path / (name or "absent.obj")
    if name:
        mesh.write_text(text)
    with pytest.raises(UserError, match=message):
        import_points(mesh, "2.1 0\n")


def test_reports_joined_lips(tmp_path: Path) -> None:
    part = meshes()[0]
    points = {
        name: vertex
        for name, vertex in ORIGINAL.feature_points.items()
        if vertex < len(part.vertices)
    }
    strip = [[points["2.2"], points["2.3"], points["2.6"]]]  # from lip to lip
    part.triangles = np.concatenate([part.triangles, strip])
    rows = [f"{name} {' '.join(map(str, part.vertices[v]))}" for name, v in points.items()]
    _, warnings = import_points(write_glb(tmp_path / "face.glb", [part]), "\n".join(rows))
    assert any("the lips are joined" in warning for warning in warnings)
