"""Virtual Motion Capture Protocol 3.1 (https://protocol.vmc.info): a face for VRM avatars.

A sender of faces is an *Assistant* of a *Performer* such as VirtualMotionCapture, which listens on
port 39540. A *Marionette*, which only renders, listens on 39539 and accepts the same messages.

Expressions are sent under their VRM 0 names (A, I, U, E, O, Blink, Blink_L, ...) and under their
VRM 1 names (aa, ih, ou, ee, oh, blink, ...); receivers ignore unknown names. ``shapes=arkit`` sends
the 52 names of Perfect Sync instead, because a model with both would open its mouth twice. Models
name these as Apple (jawOpen) or as Unity does (JawOpen), and case may matter, so both are sent.

Unity's axes are x to the model's right, y up, z to the front, left-handed. A bone message also
contains a position that is unknown here. It is sent as 0, and only some receivers ignore it.
Therefore head rotation is off unless ``head=on``.
"""

from collections.abc import Iterator
from typing import ClassVar

from kouxing.services.senders.connection import COMMON_OPTIONS, DatagramConnection, Options
from kouxing.services.senders.face_frame import Angles, FaceFrame
from kouxing.services.senders.osc import bundles, message

_VRM_0 = {  # where it is not only the capital of VRM 1
    "aa": "A", "ih": "I", "ou": "U", "ee": "E", "oh": "O",
    "blinkLeft": "Blink_L", "blinkRight": "Blink_R",
}  # fmt: skip


class VmcConnection(DatagramConnection):
    """Sends to a VMC performer or marionette."""

    default_port = 39540
    options: ClassVar[Options] = {
        **COMMON_OPTIONS,
        "shapes": ("vrm", "arkit"),
        "head": ("off", "on"),
    }

    def encode(self, frame: FaceFrame) -> Iterator[bytes]:
        """Yield the datagrams of a frame; the last message applies the shapes."""
        weights = frame.weights(self.target.shapes, is_mouth_only=self.target.is_mouth_only)
        alternatives = {
            _VRM_0.get(name) or name[0].upper() + name[1:]: value for name, value in weights.items()
        }
        messages = [message("/VMC/Ext/OK", 1), message("/VMC/Ext/T", frame.time_s)]
        if self.target.options["head"] == "on":
            rotation = _quaternion(frame.head)
            messages.append(message("/VMC/Ext/Bone/Pos", "Head", 0.0, 0.0, 0.0, *rotation))
        messages += [
            message("/VMC/Ext/Blend/Val", name, value)
            for name, value in {**alternatives, **weights}.items()
        ]
        messages.append(message("/VMC/Ext/Blend/Apply"))
        return bundles(messages)


def _quaternion(angles: Angles) -> tuple[float, float, float, float]:
    """Return x, y, z, w of yaw * pitch * roll in Unity's axes."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow, and the gateway imports us

    pitch, yaw, roll = angles
    x, y, z, w = Rotation.from_euler("YXZ", [-yaw, pitch, -roll]).as_quat().tolist()
    return x, y, z, w
