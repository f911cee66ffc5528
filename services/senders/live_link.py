"""Live Link Face over UDP, version 6: what Epic's iPhone app sends to Unreal Engine.

Big-endian: u8 version; i32 length and device id; i32 length and subject's name; i32 frame, f32 part
of a frame, i32 frames per second, i32 denominator; u8 number of values; as many f32. Values are
ARKit's 52 weights from 0 to 1, then yaw, pitch and roll of the head and of each eye as ARKit's
face anchor turns: radians to the subject's left, down, and tilted to its right. Unreal hands the
numbers on as they are. In the app's own recordings each eye has roll = yaw * tan(pitch), as turns
in radians have, ``eyeLookDown`` comes with a positive pitch and ``eyeLookInRight`` with a positive
yaw. (Unreal's ARKit plugin, where it runs on the phone in place of the app, sends degrees / 180.)
"""

from __future__ import annotations

import math
import struct
import uuid

from kouxing.services.senders.face import Face
from kouxing.services.senders.target import Target

VERSION = 6
FRAME_RATE_HZ = 50  # of the time code
_EYE = "eyeBlink eyeLookDown eyeLookIn eyeLookOut eyeLookUp eyeSquint eyeWide"
_PAIRS = (
    "mouthSmile mouthFrown mouthDimple mouthStretch",
    "mouthPress mouthLowerDown mouthUpperUp",
)
ORDER = (
    *(f"{name}{side}" for side in ("Left", "Right") for name in _EYE.split()),
    *"jawForward jawLeft jawRight jawOpen".split(),
    *"mouthClose mouthFunnel mouthPucker mouthLeft mouthRight".split(),
    *(f"{name}{side}" for name in _PAIRS[0].split() for side in ("Left", "Right")),
    *"mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper".split(),
    *(f"{name}{side}" for name in _PAIRS[1].split() for side in ("Left", "Right")),
    *"browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight".split(),
    *"cheekPuff cheekSquintLeft cheekSquintRight noseSneerLeft noseSneerRight tongueOut".split(),
)  # (52,), as the protocol numbers them
_DEVICE = str(uuid.uuid5(uuid.NAMESPACE_DNS, "kouxing")).upper().encode()  # 36 characters


def encode(face: Face, target: Target, clock_s: float) -> bytes:
    """Return the datagram of a frame.

    Parameters
    ----------
    clock_s
        Seconds since midnight, for the time code.
    """
    weights = face.weights("arkit", is_mouth_only=target.is_mouth_only)
    turns = [0.0] * 9
    if not target.is_mouth_only:
        (pitch, yaw, roll), eyes = face.head, face.eyes
        turns = [yaw, pitch, roll, *eyes[:2], 0.0, *eyes[2:], 0.0]
    values = [*(weights.get(name, 0.0) for name in ORDER), *turns]
    part, frame = math.modf(clock_s * FRAME_RATE_HZ)
    name = target.name.encode()
    return (
        struct.pack(">Bi", VERSION, len(_DEVICE))
        + _DEVICE
        + struct.pack(">i", len(name))
        + name
        + struct.pack(
            f">ifiiB{len(values)}f", int(frame), part, FRAME_RATE_HZ, 1, len(values), *values
        )
    )
