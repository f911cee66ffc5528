"""Virtual Motion Capture Protocol 3.1 (https://protocol.vmc.info): a face for VRM avatars.

A sender of faces is an *Assistant* of a *Performer* such as VirtualMotionCapture, which listens on
port 39540. A *Marionette*, which only renders, listens on 39539 and accepts the same messages.

Expressions are sent under their VRM 0 names (A, I, U, E, O, Blink, Blink_L, ...) and under their
VRM 1 names (aa, ih, ou, ee, oh, blink, ...); receivers ignore unknown names. ``shapes=arkit`` sends
the 52 names of Perfect Sync instead, because a model with both would open its mouth twice. Models
name these as Apple (jawOpen) or as Unity does (JawOpen), and case may matter, so both are sent.

Unity's axes are x to the model's right, y up, z to the front, left-handed. A bone message also
contains a position that is unknown here. It is sent as 0, and only some receivers ignore it.
Therefore head rotation is off unless ``head=on``. ``camera=`` receives a tracker's messages
(:mod:`kouxing.services.senders.tracker_input`).
"""

from collections.abc import Iterator
from itertools import islice
from typing import ClassVar

from kouxing.services.senders.connection import COMMON_OPTIONS, DatagramConnection, Option, Options
from kouxing.services.senders.face_frame import Angles, FaceFrame, mouth_shape_names
from kouxing.services.senders.osc import (
    bundle_messages,
    encode_message,
    parse_address,
    parse_first_text,
    split_packet,
)

_VRM_0 = {  # names that differ from VRM 1 by more than a capital letter
    "aa": "A", "ih": "I", "ou": "U", "ee": "E", "oh": "O",
    "blinkLeft": "Blink_L", "blinkRight": "Blink_R",
}  # fmt: skip
_MAX_MESSAGES = 200  # limit for a received packet
_MOUTH = {
    name.lower()
    for shapes in ("vrm", "arkit")
    for mouth in mouth_shape_names(shapes)
    for name in (mouth, _VRM_0.get(mouth, mouth))
}


class VmcConnection(DatagramConnection):
    """Sends to a VMC performer or marionette."""

    default_port = 39540
    options: ClassVar[Options] = {
        **COMMON_OPTIONS,
        "shapes": Option("vrm", ("vrm", "arkit")),
        "head": Option("off", ("off", "on")),
        "camera": Option(),
    }

    def encode(self, frame: FaceFrame) -> Iterator[bytes]:
        """Yield the datagrams of a frame; the last message applies the shapes."""
        messages = [encode_message("/VMC/Ext/OK", 1), encode_message("/VMC/Ext/T", frame.time_s)]
        if self.target.options["head"] == "on":
            rotation = _quaternion(frame.head)
            messages.append(encode_message("/VMC/Ext/Bone/Pos", "Head", 0.0, 0.0, 0.0, *rotation))
        messages += self._shape_messages(frame, is_mouth_only=self.target.is_mouth_only)
        messages.append(encode_message("/VMC/Ext/Blend/Apply"))
        return bundle_messages(messages)

    def with_mouth(self, packet: bytes, frame: FaceFrame) -> tuple[Iterator[bytes], bool]:
        """Insert the frame's mouth where the packet applies shapes; raises ``ValueError``."""
        received = list(islice(split_packet(packet), _MAX_MESSAGES + 1))
        if len(received) > _MAX_MESSAGES:
            raise ValueError("the packet has too many messages")
        messages: list[bytes] = []
        has_mouth = False
        for part in received:
            address = parse_address(part)
            if address == "/VMC/Ext/Blend/Apply":
                messages += self._shape_messages(frame, is_mouth_only=True)
                has_mouth = True
            if address != "/VMC/Ext/Blend/Val" or parse_first_text(part).lower() not in _MOUTH:
                messages.append(part)
        return bundle_messages(messages), has_mouth

    def _shape_messages(self, frame: FaceFrame, *, is_mouth_only: bool) -> list[bytes]:
        weights = frame.weights(self.target.shapes, is_mouth_only=is_mouth_only)
        alternatives = {
            _VRM_0.get(name) or name[0].upper() + name[1:]: value for name, value in weights.items()
        }
        return [
            encode_message("/VMC/Ext/Blend/Val", name, value)
            for name, value in {**alternatives, **weights}.items()
        ]


def _quaternion(angles: Angles) -> tuple[float, float, float, float]:
    """Return x, y, z, w of yaw * pitch * roll in Unity's axes."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow, and the gateway imports us

    pitch, yaw, roll = angles
    x, y, z, w = Rotation.from_euler("YXZ", [-yaw, pitch, -roll]).as_quat().tolist()
    return x, y, z, w
