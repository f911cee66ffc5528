"""GLBs with ARKit, Oculus or FAP morph targets are heads; damaged files are rejected."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kouxing.services.driver.head.glb_export import export_glb
from kouxing.services.driver.head.glb_head import read_glb
from kouxing.services.driver.head.head import Head
from kouxing.services.driver.render.renderer import Renderer
from kouxing.services.driver.render.scene import load_head, place_camera
from kouxing.shared.errors import UserError
from kouxing.shared.face.faps import FAPS, NUM_FAPS
from kouxing.shared.face.shapes import ARKIT, OCULUS
from tests.glb_writer import Mesh, add_skeleton, edit, wrap_scene, write_glb
from tests.heads import neutral_faps
from tests.meshes import ORIGINAL, meshes, shape_error

SHAPES = {name: ARKIT.basis[row] for row, name in enumerate(ARKIT.names)}
VISEME_SHAPES = dict(zip(OCULUS.names, OCULUS.basis, strict=True))
SHUFFLED = np.random.default_rng(3).permutation(52)


def test_reads_an_exported_head_unchanged(tmp_path: Path) -> None:
    export_glb(ORIGINAL, tmp_path / "original.glb")
    head = load_head(str(tmp_path / "original.glb"))
    assert [part.name for part in head.parts] == [part.name for part in ORIGINAL.parts]
    rng = np.random.default_rng(0)
    faps = rng.uniform(-200, 200, NUM_FAPS)
    faps[22:26] = faps[47:50] = 10_000
    assert shape_error(head, faps) < 0.01
    pictures = []
    for model in (ORIGINAL, head):
        renderer = Renderer(model, 96, 72, samples=0, camera=place_camera(model))
        pictures.append(renderer.draw(faps.astype(np.float32)).astype(float))
        renderer.close()
    assert np.abs(pictures[0] - pictures[1]).mean() < 3


@pytest.mark.parametrize(
    ("rename", "unit"),
    [
        (lambda n: n, (1, 1, 1)),
        (lambda n: "Face_BS." + n, (-250, 250, -250)),  # turned around, with other units
        (lambda n: n.replace("Left", "_L").replace("Right", "_R"), (1, 1, 1)),
    ],
    ids=["plain", "prefixed", "sides"],
)
def test_reads_arkit_shapes_in_any_order_unit_and_position(
    tmp_path: Path, rename: Callable[[str], str], unit: tuple[int, int, int]
) -> None:
    shapes = {rename(ARKIT.names[row]): ARKIT.basis[row] for row in SHUFFLED}
    parts = meshes(shapes | {"somethingElse": ARKIT.basis[0]})
    for part in parts:
        part.vertices = (part.vertices + np.array([0.01, 6, -0.2])) * unit
        part.targets = {name: shift * unit for name, shift in part.targets.items()}
    head = read_glb(write_glb(tmp_path / "my.glb", parts))
    same_place(head)
    for name in ("jawOpen", "mouthPucker", "mouthSmileLeft", "eyeBlinkRight", "browInnerUp"):
        assert shape_error(head, SHAPES[name]) < 0.25, name
    for viseme in ("PP", "aa", "ou", "ih"):
        assert shape_error(head, VISEME_SHAPES[viseme]) < 0.5, viseme


@pytest.mark.parametrize("short", [False, True], ids=["oculus", "ready player me"])
def test_reads_oculus_visemes(tmp_path: Path, short: bool) -> None:
    names = {"ih": "I", "oh": "O", "ou": "U"} if short else {}
    shapes = {f"viseme_{names.get(n, n)}": faps for n, faps in VISEME_SHAPES.items()}
    shapes |= {name: SHAPES[name] for name in ("eyeBlinkLeft", "eyeBlinkRight")}
    head = read_glb(write_glb(tmp_path / "my.glb", meshes(shapes)))
    for viseme in ("PP", "FF", "kk", "aa", "ih", "oh", "ou"):
        assert shape_error(head, VISEME_SHAPES[viseme]) < 0.15, viseme
    assert shape_error(head, neutral_faps(close_t_l_eyelid=700, close_t_r_eyelid=700)) < 0.4


@pytest.mark.parametrize("num_faps", [1, 30])
def test_fap_names_without_a_jaw_do_not_hide_arkit_shapes(tmp_path: Path, num_faps: int) -> None:
    nose = neutral_faps(stretch_l_nose=400)
    others = [fap.name for fap in FAPS if fap.name not in ("open_jaw", *SHAPES)][-num_faps:]
    head = read_glb(write_glb(tmp_path / "my.glb", meshes(SHAPES | dict.fromkeys(others, nose))))
    for name in ("jawOpen", "mouthPucker", "eyeBlinkRight"):
        assert shape_error(head, SHAPES[name]) < 0.25, name


def same_place(head: Head) -> None:
    """Compare the vertices of the parts in the GLB, except for their size and pivot."""
    rows = [ORIGINAL.vertices[ORIGINAL.part(part.name).vertices] for part in head.parts]
    first, second = np.concatenate(rows), head.vertices
    shift = second - first * np.ptp(second[:, 1]) / np.ptp(first[:, 1])
    assert np.ptp(shift, axis=0).max() < 1e-4
    assert np.abs(shift).max() < 0.01


def test_skeleton_rotates_the_head_but_not_the_shoulders(tmp_path: Path) -> None:
    path = write_glb(tmp_path / "my.glb", meshes(SHAPES))
    bones = [
        {"name": "Hips", "translation": [0, -1, 0], "children": [1]},
        {"name": "Neck", "translation": [0, 0.9, 0], "children": [2]},
        {"name": "Head", "translation": [0, 0.1, 0]},
    ]
    bind = np.tile(np.eye(4, dtype="<f4"), (3, 1, 1))
    bind[0, 3, 1] = 1.0  # column-major: the bind pose cancels the position of the hips
    add_skeleton(path, bones, lambda name: 0 if name == "garment" else 2, bind)
    head = read_glb(path)
    same_place(head)
    moved = np.abs(head.deform(neutral_faps(head_yaw=40_000)) - head.vertices).max(axis=1)
    assert moved[head.part("garment").vertices].max() == 0
    assert moved[head.part("hair").vertices].max() > 0.02


@pytest.mark.parametrize("rotation", [(0, 0, 0, 1), (0, 1, 0, 0)], ids=["z", "-z"])
def test_a_jaw_bone_moves_teeth_without_shapes(tmp_path: Path, rotation: tuple[int, ...]) -> None:
    head_meshes = meshes(SHAPES)
    for mesh in head_meshes:
        if mesh.name.startswith("teeth"):
            mesh.targets = {}
    path = write_glb(tmp_path / "cc4.glb", head_meshes)
    bones: list[dict[str, Any]] = [
        {"name": "CC_Base_Head", "children": [1]},
        {"name": "CC_Base_JawRoot", "children": [2]},
        {"name": "CC_Base_Teeth02"},
    ]
    add_skeleton(path, bones, lambda name: 2 if name == "teeth_lower" else 0)
    head = read_glb(edit(path, lambda document, _: wrap_scene(document, rotation=rotation)))
    moved = head.deform(neutral_faps(open_jaw=400)) - head.vertices
    assert moved[head.part("teeth_lower").vertices, 1].mean() < -0.003
    assert np.abs(moved[head.part("teeth_upper").vertices]).max() == 0


# --- broken files ---------------------------------------------------------------------------------


@pytest.fixture
def small(tmp_path: Path) -> Path:
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]])
    targets = {name: np.full((4, 3), 0.001 * row) for row, name in enumerate(ARKIT.names, start=1)}
    targets["eyeBlinkLeft"], targets["eyeBlinkRight"] = np.zeros((2, 4, 3))
    targets["eyeBlinkLeft"][1], targets["eyeBlinkRight"][0] = 0.01, 0.01
    mesh = Mesh("face", vertices, np.array([[0, 1, 2], [1, 3, 2]]), targets)
    return write_glb(tmp_path / "small.glb", [mesh])


def change(key: str, index: int, **values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document[key][index].update(values)


def sparse(document: dict[str, Any]) -> None:
    part = {"bufferView": 0, "componentType": 5125, "byteOffset": 12}
    document["accessors"][0]["sparse"] = {"count": 1, "indices": part, "values": part}


def primitive(**values: Any) -> Callable[[dict[str, Any]], None]:
    return lambda document: document["meshes"][0]["primitives"][0].update(values)


TOO_MANY = [{"attributes": {"POSITION": 0}}] * 2001


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (change("accessors", 0, count=10**9), "more than 300000 vertices"),
        (change("accessors", 1, count=10**9), "an accessor has 1000000000 elements"),
        (change("accessors", 0, count=-1), "an accessor has -1"),
        (change("meshes", 0, primitives=TOO_MANY), "more than 2000 meshes"),
        (change("nodes", 0, translation=[1e300, 0, 0]), "not finite or very large"),
        (change("nodes", 0, translation=[float("nan"), 0, 0]), "NaN is not valid JSON"),
        (change("nodes", 0, scale=[0, 0, 0]), "cannot speak: it has no shape jawOpen"),
        (change("accessors", 0, count=5), "larger than its buffer view"),
        (change("accessors", 0, byteOffset=-4), "larger than its buffer view"),
        (change("accessors", 0, bufferView=999), "bufferViews has no item 999"),
        (change("bufferViews", 0, byteLength=10**9), "outside the file"),
        (change("nodes", 0, children=[0]), "do not form a tree"),
        (change("nodes", 0, matrix=[1, 2]), "is damaged or is not a GLB"),
        (sparse, "index out of range"),
        (primitive(indices=0), "refers to a missing vertex"),
        (primitive(mode=0), "no triangles"),
        (lambda d: d["meshes"][0].pop("extras"), "cannot speak: it has no shape jawOpen"),
        (lambda d: d.update(extensionsRequired=["KHR_texture_basisu"]), "KHR_texture_basisu"),
    ],
)
def test_rejects_bad_descriptions(
    small: Path, damage: Callable[[dict[str, Any]], None], message: str
) -> None:
    edit(small, lambda document, _: damage(document))
    with pytest.raises(UserError, match=message):
        read_glb(small)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "not a binary glTF"),
        (struct.pack("<4sII", b"glTF", 1, 20) + b"\0" * 8, "version 1"),
        (struct.pack("<4sII", b"glTF", 2, 99) + b"\0" * 8, "cut off after 20 of 99 bytes"),
        (struct.pack("<4sIII4s", b"glTF", 2, 20, 50, b"JSON"), "cut off"),
        (struct.pack("<4sIII4s", b"glTF", 2, 22, 2, b"JSON") + b"{x", "file is damaged"),
    ],
)
def test_rejects_bad_bytes(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "my.glb").write_bytes(data)
    with pytest.raises(UserError, match=message):
        read_glb(tmp_path / "my.glb")


def test_any_flipped_byte_is_handled(small: Path) -> None:
    data = small.read_bytes()
    rng = np.random.default_rng(1)
    for place in rng.integers(0, len(data), 150):
        broken = bytearray(data)
        broken[place] ^= 1 << rng.integers(0, 8)
        small.write_bytes(broken)
        try:
            head = read_glb(small)
        except UserError:
            continue
        assert np.isfinite(head.vertices).all()


PNG = b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("texture", "message"),
    [
        (b"#EXTM3U\n/etc/hostname\n", "not PNG, JPEG or WebP"),
        (PNG + bytes(50), "damaged"),
        (PNG + b"\0\0\0\rIHDR" + struct.pack(">IIB", 30_000, 30_000, 8), "million pixels"),
    ],
)
def test_rejects_bad_textures(tmp_path: Path, texture: bytes, message: str) -> None:
    parts = meshes(SHAPES)
    parts[0].texture = texture
    with pytest.raises(UserError, match=message):
        read_glb(write_glb(tmp_path / "my.glb", parts))
