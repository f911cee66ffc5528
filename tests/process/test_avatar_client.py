"""Avatars in the JavaScript client: the shapes that move them, and the place of their face."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.glb_writer import (
    BONES,
    TRANSFORMS,
    Mesh,
    add_skeleton,
    add_vrm,
    read_chunks,
    wrap_scene,
    write_chunks,
    write_glb,
)
from tests.system import NODE, ROOT

CLIENT = ROOT / "clients" / "javascript"
ARKIT = ["jawOpen", "mouthPucker", "eyeBlinkLeft", "eyeBlinkRight"]
VRCHAT = [f"vrc.v_{viseme}" for viseme in ("sil", "pp", "aa", "ih", "oh", "ou")]
VOWELS = ["A", "I", "U", "E", "O"]
DAMAGED = "it is not a GLB or VRM file, or it is damaged; export it again"
CANNOT_SPEAK = (
    "the avatar cannot speak: it has no shape jawOpen, mouthPucker of ARKit; use an avatar"
)
LOOK_SCRIPT = """
import { readFileSync } from "node:fs";
globalThis.self = globalThis;
globalThis.ProgressEvent = Event;
console.warn = console.error = () => {};
const THREE = await import("three");
const { loadPuppet } = await import("./puppet.js");
for (const file of process.argv.slice(2)) {
  try {
    const url = "data:;base64," + readFileSync(file).toString("base64");
    const { scene, set, view, pose } = await loadPuppet(url);
    const teeth = scene.getObjectByName("Teeth");
    const depth = () => {
      scene.updateMatrixWorld(true);
      return teeth?.getVertexPosition(0, new THREE.Vector3()).applyMatrix4(teeth.matrixWorld).z;
    };
    const before = depth();
    pose([1], [set === "arkit" ? "jawOpen" : "aa"]);
    const forward = depth() - before;
    const jaw = 2 * Math.acos(scene.getObjectByName("CC_Base_JawRoot")?.quaternion.w ?? 1);
    const eyes = new THREE.Box3();
    for (const side of ["EyeL", "EyeR"]) eyes.expandByObject(scene.getObjectByName(side) ?? scene);
    const center = eyes.getCenter(new THREE.Vector3()).sub(view.target).toArray();
    let opening = 0;
    scene.traverse((node) => {
      opening = Math.max(opening, ...(node.morphTargetInfluences ?? []));
    });
    const [target, height] = [view.target.toArray(), view.height];
    console.log(JSON.stringify({ set, target, height, jaw, forward, eyes: center, opening }));
  } catch (error) {
    console.log(JSON.stringify({ error: error.message.replace(/^data:[^:]*: /, "") }));
  }
}
process.exit(0);
"""


def box(name: str, center: tuple[float, float, float], size: float, shapes: list[str]) -> Mesh:
    """Make a box whose lower half each shape lowers; blinks move the upper left or right edge."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2
    triangles = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [2, 3, 7]])
    targets = {}
    for shape in shapes:
        side = 1 if "Left" in shape else -1
        moved = corners[:, 1] < 0
        if "Blink" in shape:
            moved = (corners[:, 1] > 0) & (corners[:, 0] * side > 0)
        targets[shape] = np.outer(moved, [0, -size / 4, 0])
    return Mesh(name, corners * size + center, triangles, targets)


def face(shapes: list[str]) -> list[Mesh]:
    """Make a head behind its eyes, which have all shapes too, as in Ready Player Me's avatars."""
    eyes = [
        box(f"Eye{side}", (x, 1.7, 0.09), 0.024, shapes)
        for side, x in (("L", 0.032), ("R", -0.032))
    ]
    return [*eyes, box("Head", (0, 1.65, 0), 0.2, shapes)]


def column(shapes: list[str]) -> Mesh:
    """Make a body from the floor to the top of its head, whose chin and mouth each shape lowers."""
    heights = np.repeat([0, 1.55, 1.6, 1.75], 3)
    points = np.stack([np.tile([-0.1, 0.1, 0], 4), heights, np.tile([0, 0, 0.1], 4)], axis=1)
    moved = np.outer((heights > 0) & (heights < 1.7), [0, -0.02, 0])
    return Mesh("Body", points, np.arange(12).reshape(4, 3), dict.fromkeys(shapes, moved))


def chibi() -> Mesh:
    """Make a figure with a large head, from the floor to the top of the head at 1 m."""
    heights = np.repeat([0, 0.42, 0.85, 1.0], 3)
    points = np.stack([np.tile([-0.1, 0.1, 0], 4), heights, np.tile([0, 0, 0.1], 4)], axis=1)
    targets = {
        name: np.outer(heights == height, [0, -0.02, 0])
        for name, height in zip(ARKIT, (0.42, 0.42, 0.85, 0.85), strict=True)
    }
    return Mesh("Body", points, np.arange(12).reshape(4, 3), targets)


def change(path: Path, kind: str) -> None:
    if kind.startswith("jaw bone"):
        bones: list[dict[str, Any]] = [
            {"name": "CC_Base_Head", "children": [1]},
            {"name": "CC_Base_JawRoot"},
        ]
        add_skeleton(path, bones, lambda name: int(name in ("Teeth", "Chin")))
        if kind == "jaw bone":
            return
        kind = "turned"
    document, binary = read_chunks(path)
    nodes = document["scenes"][0]["nodes"]
    if kind in TRANSFORMS:
        wrap_scene(document, **TRANSFORMS[kind])
        del document["scene"], document["scenes"]  # a file without scenes has one with all nodes
    elif kind == "no effect":
        binary[:] = bytes(len(binary))
    elif kind in ("empty expressions", "expressions"):
        add_humanoid(document, num_expressions=5 if kind == "expressions" else 0)
    elif kind == "cut off":
        path.write_bytes(path.read_bytes()[:-100])
        return
    elif kind == "texture":
        texture = {"extensions": {"KHR_texture_basisu": {"source": 0}}}
        document |= {"textures": [texture], "images": [{"bufferView": 0, "mimeType": "image/ktx2"}]}
        document["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": 0}
    elif kind == "twice":
        document["nodes"].append(document["nodes"][2] | {"translation": [1, 0, 0]})
        nodes.append(len(document["nodes"]) - 1)
    elif kind in ("primitives", "unnamed"):
        for mesh in document["meshes"]:
            extras = mesh.pop("extras")
            if kind == "primitives":
                mesh["primitives"][0]["extras"] = extras
    else:
        document["extensionsUsed"] = document["extensionsRequired"] = [kind]
        extension = {kind: {"bufferView": 0, "attributes": {"POSITION": 0}}}
        document["meshes"][0]["primitives"][0]["extensions"] = extension
    write_chunks(path, document, binary)


def add_humanoid(document: dict[str, Any], num_expressions: int) -> None:
    """Make a VRM in centimeters. Without expressions, "aa" moves nothing, as in some files."""
    first = len(document["nodes"])
    bones = {bone: first + index for index, bone in enumerate(BONES)}
    document["nodes"] += [{"translation": [0, 1.6, 0]} if bone == "head" else {} for bone in BONES]
    document["scenes"][0]["nodes"] += bones.values()
    wrap_scene(document, scale=[100, 100, 100])
    names = ("aa", "ih", "ou", "ee", "oh")[:num_expressions]
    expressions: dict[str, list[tuple[int, int]]] = {"aa": []}
    expressions |= {name: [(0, index)] for index, name in enumerate(names)}
    add_vrm(document, 1, expressions, bones)


FILES: dict[str, tuple[list[Mesh], str]] = {
    "rpm": (face(ARKIT), ""),
    "head first": (face(ARKIT)[::-1], ""),
    "primitives": (face(ARKIT), "primitives"),
    "vrchat": (face(VRCHAT), ""),
    "vowels": (face(VOWELS), ""),
    **{kind: (face(ARKIT), kind) for kind in TRANSFORMS},
    "vrm": (face(VOWELS), "empty expressions"),
    "large head": ([box("Head", (0, 0.7, 0), 0.6, VOWELS)], "expressions"),
    "chibi": ([chibi()], ""),
    "body": ([column(VOWELS)], ""),
    "no effect": (face(ARKIT), "no effect"),
    "cut off": (face(ARKIT), "cut off"),
    "texture": (face(ARKIT), "texture"),
    "twice": (face(ARKIT), "twice"),
    "turned teeth": ([*face(ARKIT), box("Teeth", (0, 1.6, 0.05), 0.04, [])], "jaw bone, turned"),
    "teeth": ([*face(ARKIT), box("Teeth", (0, 1.6, 0.05), 0.04, [])], "jaw bone"),
    "chin": ([*face(ARKIT), box("Chin", (0, 1.6, 0.05), 0.04, ["jawOpen"])], "jaw bone"),
    "unnamed": (face(ARKIT), "unnamed"),
    "no face": ([box("Box", (0, 0, 0), 1, [])], ""),
    "blink": (face(ARKIT[2:]), ""),
    "draco": (face(ARKIT), "KHR_draco_mesh_compression"),
}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    folder = tmp_path_factory.mktemp("client")
    for file in CLIENT.glob("*.js"):
        shutil.copy(file, folder)
    (folder / "package.json").write_text('{"type": "module"}', encoding="utf-8")
    (folder / "node_modules").symlink_to(CLIENT / "node_modules")
    (folder / "page").symlink_to(ROOT / "services" / "gateway" / "page")
    (folder / "look.js").write_text(LOOK_SCRIPT, encoding="utf-8")
    paths = []
    for name, (meshes, kind) in FILES.items():
        paths.append(write_glb(folder / f"{name}.glb", meshes))
        if kind:
            change(paths[-1], kind)
    result = subprocess.run(
        [NODE, "look.js", *paths], cwd=folder, capture_output=True, text=True, check=True
    )
    return dict(zip(FILES, map(json.loads, result.stdout.splitlines()), strict=True))


@pytest.mark.parametrize(
    ("name", "shapes"),
    [
        ("rpm", "arkit"),
        ("head first", "arkit"),
        ("primitives", "arkit"),
        ("vrchat", "oculus"),
        ("vowels", "vrm"),
    ],
)
def test_the_camera_frames_the_head_and_not_an_eye(
    results: dict[str, dict[str, Any]], name: str, shapes: str
) -> None:
    assert results[name]["set"] == shapes
    assert results[name]["target"] == pytest.approx([0, 1.65, 0], abs=0.01)
    assert results[name]["height"] == pytest.approx(0.48, abs=0.05)


def test_the_camera_frames_the_large_head_of_a_small_figure(
    results: dict[str, dict[str, Any]],
) -> None:
    vrm, chibi = results["large head"], results["chibi"]
    assert vrm["set"] == "vrm"
    assert vrm["target"] == pytest.approx([0, 70, 0], abs=1)  # it is in centimeters
    assert vrm["height"] == pytest.approx(1.6 * 90, abs=1)  # with the moved chin
    assert chibi["target"] == pytest.approx([0, 0.71, 0.05], abs=0.01)
    assert chibi["height"] == pytest.approx(1.6 * 0.6, abs=0.01)


def test_the_jaw_bone_turns_only_for_parts_without_shapes(
    results: dict[str, dict[str, Any]],
) -> None:
    assert results["teeth"]["jaw"] == pytest.approx(0.3, abs=0.01)
    assert results["chin"]["jaw"] == 0
    for name in ("teeth", "turned teeth"):  # far above the bone, so they move forward
        assert results[name]["forward"] > 0.1


def test_the_camera_frames_the_head_if_only_the_mouth_of_a_body_moves(
    results: dict[str, dict[str, Any]],
) -> None:
    assert results["body"]["target"][:2] == pytest.approx([0, 1.65], abs=0.01)
    assert results["body"]["height"] == pytest.approx(0.35, abs=0.01)  # above 1.55 m


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_a_face_is_turned_upright(results: dict[str, dict[str, Any]], kind: str) -> None:
    assert results[kind]["eyes"] == pytest.approx([0, 5, 9], abs=1)


def test_a_vrm_speaks_by_morph_targets_if_its_expressions_move_nothing(
    results: dict[str, dict[str, Any]],
) -> None:
    assert results["vrm"]["set"] == "vrm"
    assert results["vrm"]["opening"] == 1
    assert results["vrm"]["height"] == pytest.approx(48.0)  # in centimeters


@pytest.mark.parametrize(
    ("name", "error_text"),
    [
        ("unnamed", CANNOT_SPEAK),
        ("no face", CANNOT_SPEAK),
        ("blink", CANNOT_SPEAK),
        ("no effect", CANNOT_SPEAK),
        ("cut off", DAMAGED),
        ("texture", "it needs KHR_texture_basisu, which kouxing does not support"),
        ("twice", "it has several faces; export only one avatar"),
        ("draco", "it needs KHR_draco_mesh_compression, which kouxing does not support"),
    ],
)
def test_the_error_says_why_an_avatar_cannot_be_shown(
    results: dict[str, dict[str, Any]], name: str, error_text: str
) -> None:
    assert error_text in results[name]["error"]
