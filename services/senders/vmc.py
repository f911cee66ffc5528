"""Virtual Motion Capture Protocol 3.1 (https://protocol.vmc.info): a face for VRM avatars.

A face-only sender is an *Assistant* of a *Performer* such as VirtualMotionCapture, which listens at
port 39540; a *Marionette*, which only draws, listens at 39539 and takes the same messages. VRM 0
names its expressions A, I, U, E, O, Blink, Blink_L, Blink_R, VRM 1 aa, ih, ou, ee, oh, blink, ...;
both are sent, and receivers ignore what they do not know. ``shapes=arkit`` sends the 52 names of
Perfect Sync instead, since a model that has both would open its mouth twice. Models call them as
Apple (jawOpen) or as Unity does (JawOpen), and case may count, so both are sent, too.

Unity's axes are x to the model's right, y up, z to the front, and left-handed. A bone's message
also carries its place, which only the model knows: here 0, which the receivers ignore that take
turns alone. So the head's turn is sent only if it is asked for (``head=on``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from kouxing.services.senders.face import Angles, Face
from kouxing.services.senders.osc import bundles, message
from kouxing.services.senders.target import Target

_VRM_0 = {
    "aa": "A",
    "ih": "I",
    "ou": "U",
    "ee": "E",
    "oh": "O",
    "blink": "Blink",
    "blinkLeft": "Blink_L",
    "blinkRight": "Blink_R",
    "lookUp": "LookUp",
    "lookDown": "LookDown",
    "lookLeft": "LookLeft",
    "lookRight": "LookRight",
}


def encode(face: Face, target: Target) -> Iterator[bytes]:
    """Yield the datagrams of a frame; the last of them applies its shapes."""
    weights = face.weights(target.shapes, is_mouth_only=target.is_mouth_only)
    others = {
        _VRM_0.get(name) or name[0].upper() + name[1:]: value for name, value in weights.items()
    }
    messages = [message("/VMC/Ext/OK", 1), message("/VMC/Ext/T", face.time_s)]
    if target.has_head:
        turn = _quaternion(face.head)
        messages.append(message("/VMC/Ext/Bone/Pos", "Head", 0.0, 0.0, 0.0, *turn))
    messages += [
        message("/VMC/Ext/Blend/Val", name, value) for name, value in {**others, **weights}.items()
    ]
    messages.append(message("/VMC/Ext/Blend/Apply"))
    return bundles(messages)


def _quaternion(turn: Angles) -> tuple[float, float, float, float]:
    """Return x, y, z, w in Unity's axes of yaw * pitch * roll."""
    pitch, yaw, roll = (angle / 2 for angle in turn)
    cp, sp, cy, sy, cr, sr = (
        part for angle in (pitch, -yaw, -roll) for part in (math.cos(angle), math.sin(angle))
    )
    return (
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
        cy * cp * sr - sy * sp * cr,
        cy * cp * cr + sy * sp * sr,
    )
