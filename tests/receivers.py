"""Reads sent faces like other programs, by their specifications."""

import json
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pythonosc.osc_bundle import OscBundle

from kouxing.services.senders.face_frame import FaceFrame
from kouxing.services.senders.live_link import LiveLinkConnection
from kouxing.services.senders.osc import OscConnection
from kouxing.services.senders.protocols import parse_target
from kouxing.services.senders.target import Target
from kouxing.services.senders.vmc import VmcConnection
from kouxing.services.senders.vtube_studio import VTubeStudioProtocol, tracking_parameters
from kouxing.shared.face.faps import FAP_NUMBER, NUM_FAPS
from kouxing.shared.face.shapes import SHAPE_SETS

# addresses of all protocols and shape sets
SENT = (
    "vmc://", "vmc://?shapes=arkit", "livelink://", "osc://", "osc://?shapes=oculus", "vts://",
)  # fmt: skip
# order of the weights in Live Link Face
LIVE_LINK_ORDER = """
    eyeBlinkLeft eyeLookDownLeft eyeLookInLeft eyeLookOutLeft eyeLookUpLeft eyeSquintLeft
    eyeWideLeft eyeBlinkRight eyeLookDownRight eyeLookInRight eyeLookOutRight eyeLookUpRight
    eyeSquintRight eyeWideRight jawForward jawLeft jawRight jawOpen mouthClose mouthFunnel
    mouthPucker mouthLeft mouthRight mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight
    mouthDimpleLeft mouthDimpleRight mouthStretchLeft mouthStretchRight mouthRollLower
    mouthRollUpper mouthShrugLower mouthShrugUpper mouthPressLeft mouthPressRight
    mouthLowerDownLeft mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight browDownLeft
    browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft
    cheekSquintRight noseSneerLeft noseSneerRight tongueOut
""".split()
Messages = list[tuple[str, list[Any]]]


def frame_of(shapes: str = "arkit", time_s: float = 0.0, /, **weights: float) -> FaceFrame:
    """Return a frame with some shapes or FAPs, by name."""
    faps = np.zeros(NUM_FAPS, np.float32)
    for name, weight in weights.items():
        if name in FAP_NUMBER:
            faps[FAP_NUMBER[name] - 1] = weight
        else:
            row = np.zeros(len(SHAPE_SETS[shapes].names), np.float32)
            row[SHAPE_SETS[shapes].names.index(name)] = weight
            faps += SHAPE_SETS[shapes].faps(row)
    return FaceFrame(faps, time_s)


def received(url: str, faps: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the values that a program receives for FAPs (68,)."""
    target = parse_target(url)
    return np.array(_READERS[target.protocol](FaceFrame(faps, 0.0), target), np.float32)


def _read_vmc(frame: FaceFrame, target: Target) -> list[float]:
    messages = read_osc(list(VmcConnection(target).encode(frame)))
    return [params[1] for address, params in messages if address == "/VMC/Ext/Blend/Val"]


def _read_plain_osc(frame: FaceFrame, target: Target) -> list[float]:
    connection = OscConnection(target)
    messages = dict(read_osc(list(connection.encode(frame))))
    for other in ("time", "head"):
        del messages[f"/kouxing/{other}"]
    return [value for (value,) in messages.values()]


def _read_live_link(frame: FaceFrame, target: Target) -> list[float]:
    return list(read_live_link(LiveLinkConnection(target).encode_at(frame, 0.0))["values"])


def _read_vtube_studio(frame: FaceFrame, _target: Target) -> list[float]:
    dialogue = VTubeStudioProtocol("token", lambda _: None)
    known = [{"name": name} for name in tracking_parameters(frame, is_mouth_only=True)]
    listed = {"defaultParameters": known, "customParameters": []}
    dialogue.reply(json.dumps({"messageType": "InputParameterListResponse", "data": listed}))
    message = json.loads(dialogue.frame_message(frame, is_mouth_only=True))
    return [parameter["value"] for parameter in message["data"]["parameterValues"]]


_READERS = {
    "vmc": _read_vmc,
    "osc": _read_plain_osc,
    "livelink": _read_live_link,
    "vts": _read_vtube_studio,
}


def read_osc(datagrams: list[bytes]) -> Messages:
    """Return addresses and arguments of bundles that fit in one packet each."""
    assert all(len(datagram) <= 1500 - 28 for datagram in datagrams)
    return [
        (message.address, message.params)
        for datagram in datagrams
        for message in OscBundle(datagram)
    ]


def read_live_link(datagram: bytes) -> dict[str, Any]:
    """Return the fields of a datagram of version 6, as Unreal reads them."""
    version, id_length = struct.unpack_from(">Bi", datagram)
    offset = 5 + id_length
    device = datagram[5:offset].decode()
    (name_length,) = struct.unpack_from(">i", datagram, offset)
    offset += 4 + name_length
    name = datagram[offset - name_length : offset].decode()
    frame, part, rate_hz, denominator, num_values = struct.unpack_from(">ifiiB", datagram, offset)
    offset += 17
    values = struct.unpack_from(f">{num_values}f", datagram, offset)
    assert offset + 4 * num_values == len(datagram), "unread bytes"
    return {
        "version": version,
        "device": device,
        "name": name,
        "frame": (frame, part),
        "rate_hz": rate_hz / denominator,
        "values": values,
    }
