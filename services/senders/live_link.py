"""Live Link Face over UDP, version 6: the protocol of Epic's iPhone app for Unreal Engine.

Layout, big-endian: u8 version; i32 length and device id; i32 length and subject name; i32 frame,
f32 sub-frame, i32 frames per second, i32 denominator; u8 number of values; that number of f32. The
values are ARKit's 52 weights, 0 to 1, then yaw, pitch and roll of the head and of each eye.

Angles follow ARKit's face anchor: radians to the subject's left, down, and tilted to its
right. Unreal passes them on unchanged. In the app's own recordings each eye has roll = yaw *
tan(pitch), as radians would; ``eyeLookDown`` has a positive pitch, ``eyeLookInRight`` a positive
yaw. (Unreal's own ARKit plugin on the phone sends degrees / 180 instead.)

The package PyLiveLinkFace is not used; its only release was in 2022.
"""

import math
import struct
import uuid
from collections.abc import Iterable
from datetime import datetime
from typing import ClassVar

from kouxing.services.senders.connection import COMMON_OPTIONS, DatagramConnection, Option, Options
from kouxing.services.senders.face_frame import FaceFrame
from kouxing.shared.face.high_level_faps import fap_table

VERSION = 6
FRAME_RATE_HZ = 50  # rate of the time code
ORDER = tuple(
    row["shape"] for row in sorted(fap_table("arkit.tsv")[0], key=lambda row: int(row["live_link"]))
)
ANGLES = (
    "HeadYaw", "HeadPitch", "HeadRoll", "LeftEyeYaw", "LeftEyePitch", "LeftEyeRoll", "RightEyeYaw",
    "RightEyePitch", "RightEyeRoll",
)  # fmt: skip
_DEVICE = str(uuid.uuid5(uuid.NAMESPACE_DNS, "kouxing")).upper().encode()  # 36 characters


def face_angles(frame: FaceFrame) -> list[float]:
    """Return ``ANGLES`` (9) in radians; the eyes do not roll."""
    (pitch, yaw, roll), eyes = frame.head, frame.eyes
    return [yaw, pitch, roll, *eyes[:2], 0.0, *eyes[2:], 0.0]


class LiveLinkConnection(DatagramConnection):
    """Sends to Unreal Engine."""

    default_port = 11111
    options: ClassVar[Options] = {**COMMON_OPTIONS, "name": Option(), "camera": Option()}

    def encode(self, frame: FaceFrame) -> Iterable[bytes]:
        """Return the datagram of a frame, with the time of day as its time code."""
        now = datetime.now().astimezone()
        midnight = now.replace(hour=0, minute=0, second=0, microsecond=0)
        return [self.encode_at(frame, (now - midnight).total_seconds())]

    def encode_at(self, frame: FaceFrame, clock_s: float) -> bytes:
        """Return the datagram of a frame at a time code, seconds since midnight."""
        weights = frame.weights("arkit", is_mouth_only=self.target.is_mouth_only)
        angles = [0.0] * len(ANGLES) if self.target.is_mouth_only else face_angles(frame)
        values = [*(weights.get(name, 0.0) for name in ORDER), *angles]
        sub_frame, number = math.modf(clock_s * FRAME_RATE_HZ)
        name = (self.target.options["name"] or "kouxing").encode()
        layout = f">Bi{len(_DEVICE)}si{len(name)}sifiiB{len(values)}f"
        time_code = (int(number), sub_frame, FRAME_RATE_HZ, 1)
        ids = (len(_DEVICE), _DEVICE, len(name), name)
        return struct.pack(layout, VERSION, *ids, *time_code, len(values), *values)

    def with_mouth(self, packet: bytes, frame: FaceFrame) -> tuple[Iterable[bytes], bool]:
        """Replace the mouth's values; rotations and names stay. Raises ``ValueError``."""
        start = _values_offset(packet)
        changed = bytearray(packet)
        for name, value in frame.weights("arkit", is_mouth_only=True).items():
            struct.pack_into(">f", changed, start + 4 * ORDER.index(name), value)
        return [bytes(changed)], True


def _values_offset(packet: bytes) -> int:
    """Return the offset of the values in a packet.

    Raises ``ValueError`` if the packet is malformed.
    """
    try:
        start = 1
        for _ in ("device", "subject"):
            (length,) = struct.unpack_from(">i", packet, start)
            if not 0 <= length <= len(packet):
                raise ValueError("a name is longer than its packet")
            start += 4 + length
        start += struct.calcsize(">ifii")
        num_values = packet[start]
    except (struct.error, IndexError):
        raise ValueError("the packet is too short") from None
    is_complete = len(packet) == start + 1 + 4 * num_values
    if packet[0] != VERSION or num_values < len(ORDER) or not is_complete:
        raise ValueError("not a packet of Live Link Face")
    return start + 1
