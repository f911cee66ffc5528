"""Blender add-on: a face with shape keys speaks, live or from a recording. Blender 4.2 to 5.0.

It moves all shape keys of the scene that have one of ARKit's 52 names. Live weights arrive by UDP
in the format of the Live Link Face app (`kouxing send livelink://127.0.0.1:11111`). A recording is
a file of `kouxing render my.wav my.csv --as arkit`, or a .jsonl file; for a take of the app, run
`kouxing render take.csv my.csv --as arkit` first. Install this file with "Edit
> Preferences > Add-ons > Install from Disk". The panel is in the sidebar (N) of the 3-D view.
"""

import codecs
import csv
import json
import math
import re
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
    "description": "Speech moves a face with shape keys",
    "category": "Animation",
}

PORT = 11111
POLL_S = 1 / 60
MAX_WEIGHT = 10.0  # percentages are larger
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


# shared/face/shape_names.txt, explained in shared/face/shape_names.py
SHAPE_NAMES = """
arkit *jawOpen=mouthOpen jawForward jawLeft jawRight mouthClose mouthLeft mouthRight tongueOut
 *mouthPucker=Mouth_Pucker_Up_L+Mouth_Pucker_Up_R+Mouth_Pucker_Down_L+Mouth_Pucker_Down_R
 mouthFunnel=Mouth_Funnel_Up_L+Mouth_Funnel_Up_R+Mouth_Funnel_Down_L+Mouth_Funnel_Down_R
 mouthRollLower=Mouth_Roll_In_Lower_L+Mouth_Roll_In_Lower_R mouthShrugLower mouthShrugUpper
 mouthRollUpper=Mouth_Roll_In_Upper_L+Mouth_Roll_In_Upper_R mouthPressLeft mouthPressRight
 mouthLowerDownLeft=Mouth_Down_Lower_L mouthLowerDownRight=Mouth_Down_Lower_R
 mouthUpperUpLeft=Mouth_Up_Upper_L mouthUpperUpRight=Mouth_Up_Upper_R
 mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft
 mouthDimpleRight mouthStretchLeft mouthStretchRight noseSneerLeft noseSneerRight
 browInnerUp=Brow_Raise_Inner_L+Brow_Raise_Inner_R cheekPuff=Cheek_Puff_L+Cheek_Puff_R
 browOuterUpLeft=Brow_Raise_Outer_L browOuterUpRight=Brow_Raise_Outer_R
 browDownLeft=Brow_Drop_L browDownRight=Brow_Drop_R
 cheekSquintLeft=Cheek_Raise_L cheekSquintRight=Cheek_Raise_R
 eyeBlinkLeft=Eyes_Closed_L eyeBlinkRight=Eyes_Closed_R
 eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight
 eyeLookUpLeft=Eye_L_Look_Up eyeLookUpRight=Eye_R_Look_Up
 eyeLookDownLeft=Eye_L_Look_Down eyeLookDownRight=Eye_R_Look_Down
 eyeLookInLeft=Eye_L_Look_R eyeLookInRight=Eye_R_Look_L
 eyeLookOutLeft=Eye_L_Look_L eyeLookOutRight=Eye_R_Look_R
oculus *aa=V_Open=vAA *PP=V_Explosive=vM FF=V_Dental_Lip=vF TH=vTH DD=V_Tongue_Up=vT kk=vK
 CH=V_Affricate=vSH SS=vS nn=vL RR=vER sil E=viseme_E=v_E=vEH
 *ih=viseme_I=V_Wide=vIH *oh=viseme_O=V_Tight_O=vOW *ou=viseme_U=V_Tight=vUW
vrm *aa=A=MTH_A=Mouth_A=Vowel_A=Lip_A=Ah=あ=ア=ｱ *ih=I=MTH_I=Mouth_I=Vowel_I=Lip_I=い=イ=ｲ
 *ou=U=MTH_U=Mouth_U=Vowel_U=Lip_U=Oo=う=ウ=ｳ *ee=E=MTH_E=Mouth_E=Vowel_E=Lip_E=Eh=え=エ=ｴ
 *oh=O=MTH_O=Mouth_O=Vowel_O=Lip_O=お=オ=ｵ blink=EYE_Close=EYE_DEF_C=Eyes_Closed=まばたき=瞬き
 blinkLeft=EYE_Close_L=Wink_L=ウィンク２=ウィンク2=ｳｨﾝｸ２=ｳｨﾝｸ2=ウィンク=ウインク=ｳｨﾝｸ
 blinkRight=EYE_Close_R=Wink_R=ウィンク２右=ウィンク2右=ｳｨﾝｸ２右=ｳｨﾝｸ2右=ウィンク右=ウインク右=ｳｨﾝｸ右
 lookUp lookDown lookLeft lookRight
"""
TITLES = {"arkit": "ARKit", "oculus": "Oculus", "vrm": "VRM"}
SEPARATOR = re.compile(r"[._:|/\- ]|eCTRL|(?<=[a-z])(?=[A-Z])")


def spell_out_side(name):
    """Remove a number at the end of a name, and write the side before it as a word."""
    name = re.sub(r"[._ ](div)?\d+$", "", name)  # Blender appends .001, Daz _div2
    name = re.sub(r"([._\- ][Ll]|(?<=[a-z])L)$", "Left", name)
    return re.sub(r"([._\- ][Rr]|(?<=[a-z])R)$", "Right", name)


def to_key(name):
    """Return a name without separators and case."""
    return SEPARATOR.sub("", name).lower()


def candidates(name):
    """Return a name's keys: one for all its words, and one for those after each separator."""
    name = spell_out_side(name)
    endings = [(match[0], to_key(name[match.end() :])) for match in SEPARATOR.finditer(name)]
    min_letters = {"": 7, **dict.fromkeys(".:|/", 0)}  # letters of a name after this separator
    return [to_key(name), *(key for mark, key in endings if len(key) >= min_letters.get(mark, 2))]


def read_table():
    """Return the entries of each set: shape, its names as lists of parts, whether it is needed."""
    sets = {}
    for line in SHAPE_NAMES.strip().splitlines():
        words = line.split()
        if not line.startswith(" "):
            entries = sets[words.pop(0)] = []
        for word in words:
            choices = [choice.split("+") for choice in word.lstrip("*").split("=")]
            keys = [[to_key(spell_out_side(part)) for part in parts] for parts in choices]
            entries.append((choices[0][0], keys, word.startswith("*")))
    return sets


SETS = read_table()


def find_shapes(set_name, names):
    """Return the shapes of the recognized names of a mesh, by name."""
    known = {key for _, choices, _ in SETS[set_name] for parts in choices for key in parts}
    by_key = {}
    for name in names:
        by_key.setdefault(next((key for key in candidates(name) if key in known), ""), name)
    shapes = {}
    for shape, choices, _ in SETS[set_name]:
        parts = next((parts for parts in choices if any(key in by_key for key in parts)), [])
        shapes.update({by_key[key]: shape for key in parts if key in by_key})
    return shapes


def shape_keys(set_name):
    """Return the shape keys of the scene that form a shape of the set: lists by shape."""
    keys = defaultdict(list)
    for shapes in bpy.data.shape_keys:
        blocks = {key.name: key for key in shapes.key_blocks[1:]}  # the first is the face at rest
        for name, shape in find_shapes(set_name, blocks).items():
            keys[shape].append(blocks[name])
    return keys


def find_problem(set_name):
    """Return why weights of a set cannot move the scene, or an empty text."""
    missing, penalty, speaking = {}, {}, []
    for name, entries in SETS.items():
        keys = shape_keys(name)
        needed = [shape for shape, _, is_needed in entries if is_needed]
        missing[name] = [shape for shape in needed if shape not in keys]
        # between equals, the number of known shapes decides
        penalty[name] = len(missing[name]) / len(needed) - len(keys) / 1000
        if needed[0] in keys:
            speaking.append(name)
    if set_name in speaking:
        return ""
    if speaking:
        name = min(reversed(speaking), key=penalty.get)
        return f"the avatar has shapes of {TITLES[name]}; insert a recording made with --as {name}"
    nearest = min(penalty, key=penalty.get)
    return (
        f"the avatar cannot speak: it has no shape {', '.join(missing[nearest])} of"
        f" {TITLES[nearest]}; use an avatar with the shapes of ARKit, Oculus or VRM"
    )


def read_live_link(packet):
    """Return the weights of a packet by name, or {} if it has another format."""
    size = 4 * NUM_VALUES
    if len(packet) <= size or packet[0] != 6 or packet[-size - 1] != NUM_VALUES:
        return {}
    values = struct.unpack(f">{NUM_VALUES}f", packet[-size:])
    return dict(zip(LIVE_LINK_ORDER, values, strict=False))


def read_recording(path):
    """Return the times in seconds, the set and the weights by shape of a .csv or .jsonl file."""
    content = Path(path).read_bytes()
    is_utf16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = content.decode("utf-16" if is_utf16 else "utf-8-sig")
    lines = [line for line in re.split(r"\r\n|\r|\n", text) if line.strip(" ,;\t")]
    rows = read_csv(lines) if path.lower().endswith(".csv") else read_json_lines(lines)
    if not rows or "time_s" not in rows[0]:
        raise ValueError(
            "it has no column time_s; for a take, run: kouxing render take.csv my.csv --as arkit"
        )
    shapes = {name: find_shapes(name, rows[0]) for name in SETS}
    set_name = max(shapes, key=lambda name: len(shapes[name]))
    if not shapes[set_name]:
        raise ValueError("its columns are not the shapes of ARKit, Oculus or VRM")
    times_s = read_numbers(rows, "time_s")
    if times_s != sorted(times_s):
        raise ValueError("its times are not in order; sort the rows by time_s")
    columns = defaultdict(list)  # by shape; several may form one
    for column, shape in shapes[set_name].items():
        columns[shape].append(read_numbers(rows, column, MAX_WEIGHT))
    weights = {
        shape: [sum(parts) / len(parts) for parts in zip(*lists, strict=True)]
        for shape, lists in columns.items()
    }
    return times_s, set_name, weights


def read_csv(lines):
    """Return the rows of a table with commas, semicolons or tabs."""
    lines = [line for line in lines if not line.startswith("sep=")]  # from Excel
    delimiter = max(",;\t", key=lines[0].count) if lines else ","
    rows = csv.reader(lines, delimiter=delimiter)
    titles = [re.sub("(?i)^time_s$", "time_s", title.strip()) for title in next(rows, ())]
    return [dict(zip(titles, row, strict=False)) for row in rows]


def read_json_lines(lines):
    """Return the time and the weights of each frame."""
    frames = [json.loads(line) for line in lines]
    name = next((name for name in SETS if frames and name in frames[0]), "")
    return [{"time_s": frame.get("time_s"), **frame.get(name, {})} for frame in frames]


def read_numbers(rows, column, limit=math.inf):
    """Return the numbers of a column, also with decimal commas."""
    try:
        numbers = [float(str(row.get(column)).replace(",", ".")) for row in rows]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise ValueError(f"a value of {column} is missing or not a number")
    if max(map(abs, numbers)) > limit:
        raise ValueError(f"{column} must be from 0 to 1; divide percentages by 100")
    return numbers


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
            except OSError:  # no packet is left, or one is too large
                break
            self.num_packets += 1
        keys = shape_keys("arkit") if packet else {}
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
        if text := find_problem("arkit"):
            self.report({"ERROR"}, text)
            return {"CANCELLED"}
        try:
            RECEIVER.open(context.scene.kouxing_port)
        except OSError as error:
            RECEIVER.close()
            port = context.scene.kouxing_port
            self.report({"ERROR"}, f"cannot use port {port}: {error.strerror}; choose another")
            return {"CANCELLED"}
        bpy.app.timers.register(RECEIVER.poll, persistent=True)  # also in the next file
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
            times_s, set_name, weights = read_recording(self.filepath)
        except (OSError, AttributeError, ValueError, TypeError, csv.Error) as error:
            self.report({"ERROR"}, f"{self.filepath} is not a file of weights: {error}")
            return {"CANCELLED"}
        if text := find_problem(set_name):
            self.report({"ERROR"}, text)
            return {"CANCELLED"}
        keys = shape_keys(set_name)
        names = [name for name in weights if name in keys]
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
