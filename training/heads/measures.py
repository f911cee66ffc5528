"""Measures places and sizes on a head's mesh."""

import numpy as np

from kouxing.shared.arrays import Doubles, Integers, Mask
from kouxing.training.heads.makehuman import FEATURE_POINTS, NUM_BASE_VERTICES, BaseMesh, MakeHuman
from kouxing.training.heads.zones import Skin

# the left half of the lips' outline, from 8.1 over 8.3 to 8.2
LIP_OUTLINE = (
    455, 7214, 7210, 7215, 7169, 11956, 7170, 7171, 7168, 7167, 10405, 7162, 7163, 10370, 7164,
    7165, 7166, 7235, 7241, 492,
)  # fmt: skip
_TORSO = ("spine", "clavicle", "shoulder", "upperarm", "breast", "root", "pelvis")


def eye_centers(vertices: Doubles, mesh: BaseMesh) -> Doubles:
    """Find the centers of the left and the right eyeball (2, 3)."""
    centers = []
    for group in ("helper-l-eye", "helper-r-eye"):
        helper = vertices[np.unique(mesh.quads[mesh.group(group)])]
        centers.append((helper.max(axis=0) + helper.min(axis=0)) / 2)
    return np.array(centers)


def eye_radius(vertices: Doubles, mesh: BaseMesh) -> float:
    """Find the radius of an eyeball that stays behind the eyelids, dm."""
    helper = vertices[np.unique(mesh.quads[mesh.group("helper-l-eye")])]
    return 0.988 * float(np.ptp(helper[:, 0])) / 2


def measure_fapu(skin: Skin, vertices: Doubles, mesh: BaseMesh) -> dict[str, float]:
    """Measure the FAPU of the face, dm."""

    def at(name: str) -> Doubles:
        return np.asarray(skin.vertices[skin.point(name)])

    left, right = eye_centers(vertices, mesh)
    return {
        "MNS": at("9.15")[1] - at("2.2")[1],
        "MW": at("8.3")[0] - at("8.4")[0],
        "ENS": left[1] - at("9.15")[1],
        "ES": left[0] - right[0],
        "IRISD": at("3.1")[1] - at("3.3")[1],
    }


def mouth_cavity(mesh: BaseMesh, skin: Skin) -> Mask:
    """Find the vertices that line the mouth, by their texture island."""
    islands = mesh.uv[mesh.uv_quads].max(axis=1)
    lining = mesh.group("body") & (islands[:, 1] < 0.137) & (islands[:, 0] > 0.7)
    is_lining = np.zeros(len(mesh.vertices))
    is_lining[mesh.quads[lining]] = 1.0
    return np.asarray(skin.matrix @ is_lining[skin.base] > 0.5)


def eye_sockets(mesh: BaseMesh) -> Integers:
    """Find the vertices of the bags behind the eyelids, by their texture islands."""
    islands = mesh.uv_quads[mesh.group("body")]
    inside = (mesh.uv[islands].max(axis=(1, 2)) < 0.64) & (mesh.uv[islands][..., 0].max(1) < 0.152)
    return np.unique(mesh.quads[mesh.group("body")][inside])


def neckline_height(z: Doubles) -> Doubles:
    """Return the height of the garment's edge around the neck."""
    return 4.66 - 0.47 * z


def head_weight(source: MakeHuman) -> Doubles:
    """Return how far each vertex of the base mesh follows the head; it fades down the neck."""
    weight = np.ones(NUM_BASE_VERTICES)
    for bone, fraction in (("neck03", 0.25), ("neck02", 0.55), ("neck01", 0.85)):
        weight -= fraction * source.bone_weights(bone)
    for bone in source.bones():
        if bone.startswith(_TORSO):
            weight -= source.bone_weights(bone)
    np.clip(weight, 0, 1, out=weight)
    return weight


def lip_outline(skin: Skin) -> Doubles:
    """Return the outlines of the lips (N, 3), outward: x, upper and lower height, dm."""
    corner = LIP_OUTLINE.index(FEATURE_POINTS["8.3"])
    upper, lower = (
        skin.vertices[skin.number[np.array(half)]]
        for half in (LIP_OUTLINE[: corner + 1], LIP_OUTLINE[: corner - 1 : -1])
    )
    x = upper[:, 0]
    order = np.argsort(lower[:, 0])
    return np.stack([x, upper[:, 1], np.interp(x, lower[order, 0], lower[order, 1])], axis=1)
