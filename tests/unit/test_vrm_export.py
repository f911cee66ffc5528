"""Bones and expressions of a head exported as a VRM 1.0 avatar."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np
import pytest

from kouxing.services.driver.head.glb_export import export_glb
from kouxing.services.driver.head.morphs import AVATAR_MORPHS
from kouxing.shared.face.shapes import ARKIT, VRM
from tests import heads

pytestmark = pytest.mark.unit

NEEDED_BONES = set(
    "hips spine head leftUpperLeg leftLowerLeg leftFoot rightUpperLeg rightLowerLeg rightFoot"
    " leftUpperArm leftLowerArm leftHand rightUpperArm rightLowerArm rightHand".split()
)
EMOTIONS = {"happy", "angry", "sad", "surprised"}


@pytest.fixture(scope="module")
def document(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("vrm") / "woman.vrm"
    export_glb(heads.load("woman", "coarse"), path)
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    read: dict[str, Any] = json.loads(data[20 : 20 + size])
    return read


@pytest.fixture(scope="module")
def avatar(document: dict[str, Any]) -> dict[str, Any]:
    assert document["extensionsUsed"] == ["VRMC_vrm"]
    found: dict[str, Any] = document["extensions"]["VRMC_vrm"]
    assert found["specVersion"] == "1.0"
    return found


def test_bones_are_in_t_pose(document: dict[str, Any], avatar: dict[str, Any]) -> None:
    nodes = document["nodes"]
    parents = {
        child: number for number, node in enumerate(nodes) for child in node.get("children", ())
    }

    def place(number: int | None) -> np.ndarray:
        if number is None:
            return np.zeros(3)
        own = nodes[number].get("translation", (0, 0, 0))
        found: np.ndarray = place(parents.get(number)) + np.array(own)
        return found

    bones = {name: place(each["node"]) for name, each in avatar["humanoid"]["humanBones"].items()}
    assert set(bones) == NEEDED_BONES
    assert bones["head"][1] == pytest.approx(1.5)
    assert bones["leftFoot"][1] == pytest.approx(0.08)
    assert bones["leftHand"][1] == bones["leftUpperArm"][1] == bones["rightHand"][1]
    assert bones["leftHand"][0] == pytest.approx(-bones["rightHand"][0])
    assert bones["leftHand"][0] > 0.6
    head = avatar["humanoid"]["humanBones"]["head"]["node"]
    assert {"eye_left", "hair"} <= {nodes[child]["name"] for child in nodes[head]["children"]}


def test_every_sent_weight_has_an_expression(avatar: dict[str, Any]) -> None:
    expressions = avatar["expressions"]
    assert set(expressions["preset"]) == set(VRM.names) | EMOTIONS
    assert set(expressions["custom"]) == set(ARKIT.names)


@pytest.mark.parametrize("name", [*VRM.names, *sorted(EMOTIONS), "jawOpen"])
def test_expressions_match_their_faps(
    name: str, document: dict[str, Any], avatar: dict[str, Any]
) -> None:
    every = avatar["expressions"]["preset"] | avatar["expressions"]["custom"]
    bound = set()
    for bind in every[name]["morphTargetBinds"]:
        mesh = document["meshes"][document["nodes"][bind["node"]]["mesh"]]
        bound.add(mesh["extras"]["targetNames"][bind["index"]])
    assert bound == {name}
    faps = {morph.name: morph.faps for morph in AVATAR_MORPHS}[name]
    if name in VRM.names:
        assert np.array_equal(faps, VRM.basis[VRM.names.index(name)])
