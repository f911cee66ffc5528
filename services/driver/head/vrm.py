"""Additions that make a GLB a VRM 1.0 avatar: a skeleton and the extension ``VRMC_vrm``.

VRM Consortium, "VRMC_vrm-1.0". Each expression is a morph target: the shape set "vrm", four
emotions, and ARKit's 52 shapes for programs with "perfect sync". The format requires a whole body,
so the head gets the bones of a body in T-pose without a mesh.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from kouxing.services.driver.head.morph_targets import EMOTIONS
from kouxing.shared.face.shapes import ARKIT, VRM

Position = tuple[float, float, float]
Bindings = Mapping[str, Sequence[tuple[int, int]]]  # morph: pairs of node and target index

_LOOK_DEGREES = {  # eye rotation of ARKit's shapes
    "rangeMapHorizontalInner": 24.6,
    "rangeMapHorizontalOuter": 24.6,
    "rangeMapVerticalDown": 17.8,
    "rangeMapVerticalUp": 12.0,
}

_LIMBS: tuple[tuple[str, str, Position], ...] = (
    ("UpperLeg", "hips", (0.09, -0.05, 0)),
    ("LowerLeg", "UpperLeg", (0, -0.4, 0)),
    ("Foot", "LowerLeg", (0, -0.4, 0)),
    ("UpperArm", "spine", (0.16, 0.33, 0)),
    ("LowerArm", "UpperArm", (0.26, 0, 0)),
    ("Hand", "LowerArm", (0.24, 0, 0)),
)
# Each bone with its parent and its position relative to the parent, m; parents first, the floor at
# 0.
BONES: tuple[tuple[str, str, Position], ...] = (
    ("hips", "", (0, 0.93, 0)),
    ("spine", "hips", (0, 0.12, 0)),
    ("body", "spine", (0, 0.45, 0)),  # the head's pivot; not a bone of the format
    *(
        (side + name, side + parent if parent[0].isupper() else parent, (sign * x, y, z))
        for side, sign in (("left", 1), ("right", -1))
        for name, parent, (x, y, z) in _LIMBS
    ),
)


def build_extension(
    name: str, nodes: Mapping[str, int], bindings: Bindings, eyes: Position, *, is_free: bool
) -> dict[str, Any]:
    """Return the contents of the extension for an avatar.

    ``nodes`` are the bones' nodes, ``bindings`` are the locations of the morph targets, and
    ``eyes`` is the offset from the head's pivot to the point between the eyes, m. An avatar that
    ``is_free`` is under CC0; otherwise only its author may use it.
    """
    bones = ["head", *(bone for bone, _, _ in BONES if bone != "body")]
    return {
        "specVersion": "1.0",
        "meta": _meta(name, is_free=is_free),
        "humanoid": {"humanBones": {bone: {"node": nodes[bone]} for bone in bones}},
        "expressions": {
            "preset": {name: _expression(bindings[name]) for name in (*VRM.names, *EMOTIONS)},
            "custom": {name: _expression(bindings[name]) for name in ARKIT.names},
        },
        "lookAt": {
            "type": "expression",
            "offsetFromHeadBone": eyes,
            **{
                name: {"inputMaxValue": degrees, "outputScale": 1.0}
                for name, degrees in _LOOK_DEGREES.items()
            },
        },
    }


def _expression(targets: Sequence[tuple[int, int]]) -> dict[str, Any]:
    binds = [{"node": node, "index": index, "weight": 1.0} for node, index in targets]
    return {"morphTargetBinds": binds}


def _meta(name: str, *, is_free: bool) -> dict[str, Any]:
    meta = {"name": name, "licenseUrl": "https://vrm.dev/licenses/1.0/", "authors": ["unknown"]}
    if not is_free:
        return meta
    return meta | {
        "authors": ["the kouxing authors"],
        "otherLicenseUrl": "https://creativecommons.org/publicdomain/zero/1.0/",
        "avatarPermission": "everyone",
        "allowExcessivelyViolentUsage": True,
        "allowExcessivelySexualUsage": True,
        "commercialUsage": "corporation",
        "allowPoliticalOrReligiousUsage": True,
        "allowAntisocialOrHateUsage": True,
        "creditNotation": "unnecessary",
        "allowRedistribution": True,
        "modification": "allowModificationRedistribution",
    }
