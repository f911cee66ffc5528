"""Blender add-on: a face with shape keys speaks, live or from a recording. Blender 4.2 to 5.0.

It moves all shape keys of the scene that have one of ARKit's 52 names. Live weights arrive by UDP
in the format of the app Live Link Face (`kouxing send livelink://127.0.0.1:11111`). A recording is
a file of `kouxing render my.wav my.csv --as arkit`, or a .jsonl file; for a take of the app, run
`kouxing render take.csv my.csv --as arkit` first. Install this file with "Edit
> Preferences > Add-ons > Install from Disk". The panel is in the sidebar (N) of the 3-D view.
"""

import csv
import json
import socket
import struct
from collections import defaultdict
from pathlib import Path

import bpy
from bpy_extras.io_utils import ImportHelper

bl_info = {
    "name": "kouxing face",
    "author": "the kouxing authors",
    "version": (1, 0, 0),
    "blender": (4, 2, 0),
    "location": "3D View > Sidebar > kouxing",
    "description": "Speech moves a face with ARKit shape keys",
    "category": "Animation",
}

PORT = 11111
POLL_S = 1 / 60
NUM_VALUES = 61  # in a packet; the first 52 are shapes
# fmt: off
LIVE_LINK_ORDER = (
    "eyeBlinkLeft", "eyeLookDownLeft", "eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft",
    "eyeSquintLeft", "eyeWideLeft", "eyeBlinkRight", "eyeLookDownRight", "eyeLookInRight",
    "eyeLookOutRight", "eyeLookUpRight", "eyeSquintRight", "eyeWideRight", "jawForward", "jawLeft",
    "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight",
    "mouthSmileLeft", "mouthSmileRight", "mouthFrownLeft", "mouthFrownRight", "mouthDimpleLeft",
    "mouthDimpleRight", "mouthStretchLeft", "mouthStretchRight", "mouthRollLower",
    "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "mouthPressLeft", "mouthPressRight",
    "mouthLowerDownLeft", "mouthLowerDownRight", "mouthUpperUpLeft", "mouthUpperUpRight",
    "browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight",
    "cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight",
    "tongueOut",
)
# fmt: on


def shape_keys():
    """Return the scene's shape keys: lists by name."""
    keys = defaultdict(list)
    for shapes in bpy.data.shape_keys:
        for key in shapes.key_blocks[1:]:  # the first is the face at rest
            keys[key.name].append(key)
    return keys


def read_live_link(packet):
    """Return the weights of a packet by name, or {} if it has another format."""
    size = 4 * NUM_VALUES
    if len(packet) <= size or packet[0] != 6 or packet[-size - 1] != NUM_VALUES:
        return {}
    values = struct.unpack(f">{NUM_VALUES}f", packet[-size:])
    return dict(zip(LIVE_LINK_ORDER, values, strict=False))


def read_recording(path):
    """Return the times in seconds and the weights by name of a .csv or .jsonl file."""
    with Path(path).open(encoding="utf-8") as file:
        if path.endswith(".csv"):
            rows = [
                {name: float(value) for name, value in row.items() if name != "phone"}
                for row in csv.DictReader(file)
            ]
            times_s = [row.pop("time_s") for row in rows]
        else:
            frames = [json.loads(line) for line in file]
            times_s = [frame["time_s"] for frame in frames]
            rows = [frame["arkit"] for frame in frames]
    return times_s, {name: [row[name] for row in rows] for name in rows[0]}


class Receiver:
    """Receives packets on a port and shows the newest."""

    def __init__(self):
        self.socket = None
        self.num_packets = 0

    def open(self, port):
        """Listen on this machine."""
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.num_packets = 0

    def close(self):
        """Stop receiving; the face keeps its pose."""
        if self.socket is not None:
            self.socket.close()
        self.socket = None

    def poll(self):
        """Show the newest packet; return when Blender's timer must call this again, seconds."""
        if self.socket is None:
            return None
        packet = b""
        while True:
            try:
                packet = self.socket.recv(2048)
            except BlockingIOError:
                break
            self.num_packets += 1
        keys = shape_keys() if packet else {}
        for name, weight in read_live_link(packet).items():
            for key in keys.get(name, ()):
                key.value = weight
        return POLL_S


RECEIVER = Receiver()


class KOUXING_OT_follow(bpy.types.Operator):
    """Start or stop following the stream."""

    bl_idname = "kouxing.follow"
    bl_label = "Follow the stream"

    def execute(self, context):
        """Open or close the port."""
        if RECEIVER.socket is not None:
            RECEIVER.close()
            return {"FINISHED"}
        try:
            RECEIVER.open(context.scene.kouxing_port)
        except OSError as error:
            RECEIVER.close()
            port = context.scene.kouxing_port
            self.report({"ERROR"}, f"cannot use port {port}: {error.strerror}; choose another")
            return {"CANCELLED"}
        bpy.app.timers.register(RECEIVER.poll)
        return {"FINISHED"}


class KOUXING_OT_insert(bpy.types.Operator, ImportHelper):
    """Insert a recording as key frames, starting at the current frame."""

    bl_idname = "kouxing.insert"
    bl_label = "Insert a recording"
    bl_options = {"REGISTER", "UNDO"}
    filter_glob: bpy.props.StringProperty(default="*.csv;*.jsonl", options={"HIDDEN"})

    def execute(self, context):
        """Set a key frame for every frame of the file."""
        try:
            times_s, weights = read_recording(self.filepath)
        except (OSError, KeyError, ValueError, IndexError) as error:
            self.report({"ERROR"}, f"{self.filepath} is not a file of ARKit weights: {error}")
            return {"CANCELLED"}
        keys = shape_keys()
        names = [name for name in weights if name in keys]
        if not names:
            self.report({"ERROR"}, "no shape key in the scene has an ARKit name (such as jawOpen)")
            return {"CANCELLED"}
        scene = context.scene
        rate_hz = scene.render.fps / scene.render.fps_base
        frames = [scene.frame_current + time_s * rate_hz for time_s in times_s]
        for name in names:
            for key in keys[name]:
                for frame, key.value in zip(frames, weights[name], strict=True):
                    key.keyframe_insert("value", frame=frame)
        scene.frame_end = max(scene.frame_end, int(frames[-1]) + 1)
        self.report({"INFO"}, f"{len(frames)} frames of {len(names)} shapes")
        return {"FINISHED"}


class KOUXING_PT_panel(bpy.types.Panel):
    """The panel in the sidebar."""

    bl_label = "kouxing"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "kouxing"

    def draw(self, context):
        """Draw the port, both commands and the number of packets."""
        is_following = RECEIVER.socket is not None
        self.layout.prop(context.scene, "kouxing_port")
        self.layout.operator(
            KOUXING_OT_follow.bl_idname, text="Stop" if is_following else "", depress=is_following
        )
        if is_following:
            self.layout.label(text=f"{RECEIVER.num_packets} packets")
        self.layout.operator(KOUXING_OT_insert.bl_idname)


CLASSES = (KOUXING_OT_follow, KOUXING_OT_insert, KOUXING_PT_panel)


def register():
    """Add commands and panel to Blender."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.kouxing_port = bpy.props.IntProperty(
        name="Port", default=PORT, min=1, max=65535, description="Port for Live Link Face packets"
    )


def unregister():
    """Remove commands and panel from Blender."""
    RECEIVER.close()
    del bpy.types.Scene.kouxing_port
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
