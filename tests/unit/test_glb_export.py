"""Exported GLBs and VRM 1.0 avatars are consistent and complete."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from kouxing.services.driver.head.glb_export import export_glb
from kouxing.shared.face.faps import FAP_NUMBER, FAPS
from kouxing.shared.face.shapes import ARKIT, VRM
from tests import heads
from tests.glb_writer import read_chunks


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("glb") / "head.glb"
    export_glb(heads.load("woman"), path)
    document, binary = read_chunks(path)
    assert document["buffers"][0]["byteLength"] == len(binary)
    return document


def test_every_fap_and_arkit_shape_is_a_target_or_a_rotation(document: dict[str, Any]) -> None:
    described = {fap["name"]: fap for fap in document["scenes"][0]["extras"]["kouxing"]["faps"]}
    assert list(described) == [fap.name for fap in FAPS[2:]]
    extras = [mesh.get("extras", {}) for mesh in document["meshes"]]
    targets = {name for extra in extras for name in extra.get("targetNames", [])}
    turned = {name for name, fap in described.items() if "rotation" in fap}
    assert (targets | turned) - set(ARKIT.names) == set(described)
    names = {node["name"] for node in document["nodes"]}
    assert {described[name]["rotation"]["node"] for name in turned} <= names
    shapes = document["scenes"][0]["extras"]["kouxing"]["arkit"]
    assert [shape["name"] for shape in shapes] == list(ARKIT.names)
    assert set(ARKIT.names) <= targets
    assert shapes[ARKIT.names.index("jawOpen")]["faps"]["open_jaw"] > 0


def read(document: dict[str, Any], binary: bytearray, accessor: int) -> np.ndarray:
    """Return the floats of an accessor, flat."""
    view = document["bufferViews"][document["accessors"][accessor]["bufferView"]]
    return np.frombuffer(binary, np.float32, view["byteLength"] // 4, view["byteOffset"])


@pytest.mark.parametrize("as_arkit", [False, True])
def test_animation_moves_the_head_like_its_faps(tmp_path: Path, *, as_arkit: bool) -> None:
    head = heads.load("woman", "coarse")
    faps = np.zeros((3, 68), np.float32)
    faps[1] = 0.5 * ARKIT.basis[ARKIT.names.index("jawOpen")]
    faps[2, 48] = 0.1 / 1e-5  # the head rotates by 0.1 rad
    path = tmp_path / "speaks.glb"
    export_glb(head, path, [(0.02 * k, row) for k, row in enumerate(faps)], as_arkit=as_arkit)
    document, binary = read_chunks(path)
    (animation,) = document["animations"]
    curves = {}
    for channel in animation["channels"]:
        sampler, target = animation["samplers"][channel["sampler"]], channel["target"]
        curve = read(document, binary, sampler["output"])
        curves[document["nodes"][target["node"]]["name"], target["path"]] = curve
        times_s = read(document, binary, sampler["input"])
        np.testing.assert_allclose(times_s, [0.0, 0.02, 0.04])
    turn = curves["head", "rotation"].reshape(3, 4)[2]
    np.testing.assert_allclose(turn, [0, np.sin(0.05), 0, np.cos(0.05)], atol=1e-6)
    targets = next(m for m in document["meshes"] if m["name"] == "skin")["extras"]["targetNames"]
    weights = curves["skin", "weights"].reshape(3, len(targets))
    assert not weights[0].any()
    shown = np.zeros(68, np.float32)
    for name, weight in zip(targets, weights[1], strict=True):
        if name in ARKIT.names:
            shown += weight * ARKIT.basis[ARKIT.names.index(name)]
        else:
            shown[FAP_NUMBER[name] - 1] += 1024 * weight
    moved, expected = (
        (head.deform(row) - head.vertices)[head.part("skin").vertices] for row in (shown, faps[1])
    )
    error_m = np.abs(moved - expected).max()
    assert error_m < (0.1 if as_arkit else 0.01) * np.abs(expected).max()


# --- VRM ---------------------------------------------------------------------------------------

NEEDED_BONES = set(
    "hips spine head leftUpperLeg leftLowerLeg leftFoot rightUpperLeg rightLowerLeg rightFoot"
    " leftUpperArm leftLowerArm leftHand rightUpperArm rightLowerArm rightHand".split()
)
EMOTIONS = {"happy", "angry", "sad", "surprised"}


@pytest.fixture(scope="module")
def vrm(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("vrm") / "woman.vrm"
    export_glb(heads.load("woman", "coarse"), path)
    document, _ = read_chunks(path)
    assert document["extensionsUsed"] == ["VRMC_vrm", "KHR_materials_clearcoat"]
    avatar = document["extensions"]["VRMC_vrm"]
    assert avatar["specVersion"] == "1.0"
    return {**document, "avatar": avatar}


def test_bones_are_in_t_pose(vrm: dict[str, Any]) -> None:
    nodes = vrm["nodes"]
    parents = {child: at for at, node in enumerate(nodes) for child in node.get("children", ())}

    def place(number: int) -> np.ndarray:
        shift = np.array(nodes[number].get("translation", (0, 0, 0)))
        return shift + place(parents[number]) if number in parents else shift

    humanoid = vrm["avatar"]["humanoid"]["humanBones"]
    assert set(humanoid) == NEEDED_BONES
    bones = {name: place(bone["node"]) for name, bone in humanoid.items()}
    assert (bones["head"][1], bones["leftFoot"][1]) == pytest.approx((1.5, 0.08))
    assert bones["leftHand"][1] == bones["leftUpperArm"][1] == bones["rightHand"][1]
    assert bones["leftHand"][0] == pytest.approx(-bones["rightHand"][0])
    children = nodes[humanoid["head"]["node"]]["children"]
    assert {"eye_left", "hair"} <= {nodes[child]["name"] for child in children}


def test_every_sent_weight_has_an_expression(vrm: dict[str, Any]) -> None:
    preset, custom = (vrm["avatar"]["expressions"][kind] for kind in ("preset", "custom"))
    assert set(preset) == set(VRM.names) | EMOTIONS
    assert set(custom) == set(ARKIT.names)
    for name, expression in (preset | custom).items():
        for bind in expression["morphTargetBinds"]:
            mesh = vrm["meshes"][vrm["nodes"][bind["node"]]["mesh"]]
            assert mesh["extras"]["targetNames"][bind["index"]] == name
        assert expression["morphTargetBinds"]


@pytest.mark.slow
@pytest.mark.parametrize("name", heads.NAMES)
def test_a_head_is_small_and_has_soft_hair_and_fine_skin(name: str, tmp_path: Path) -> None:
    path = tmp_path / "head.glb"
    export_glb(heads.load(name), path)
    assert path.stat().st_size < 5_000_000
    document, _ = read_chunks(path)
    materials = {material["name"]: material for material in document["materials"]}
    assert materials["hair"]["alphaMode"] == "MASK"
    assert materials["lashes"]["alphaMode"] == materials["brows"]["alphaMode"] == "BLEND"
    if heads.load(name).cel:
        assert "KHR_materials_unlit" in materials["skin"]["extensions"]
        assert "KHR_materials_unlit" not in materials["eye_left"]["extensions"]
        return
    relief = document["textures"][materials["skin"]["normalTexture"]["index"]]
    assert document["images"][relief["source"]]["name"] == "skin_normal"
