"""The Blender add-on moves an exported head in Blender itself, from a recording and live."""

import csv
import subprocess
from pathlib import Path

import pytest

from kouxing.services.driver.head.glb_export import export_glb
from kouxing.shared.face.shapes import ARKIT
from tests import heads
from tests.system import ROOT, free_udp_port

FOLDER = ROOT / "examples" / "blender"
BLENDER = FOLDER / ".venv"  # `make blender` puts Blender there, as a Python module


SCRIPT = """
import math, os, socket, struct, sys
import bpy

glb, table, port, folder = sys.argv[1:]
sys.path.insert(0, folder)
import kouxing_face

bpy.ops.wm.read_factory_settings(use_empty=True)
kouxing_face.register()
bpy.ops.import_scene.gltf(filepath=glb)

def depth():
    skin = bpy.data.objects["skin"].evaluated_get(bpy.context.evaluated_depsgraph_get())
    mesh = skin.to_mesh()
    lowest = sum(vertex.co.z for vertex in mesh.vertices)
    skin.to_mesh_clear()
    return lowest

def jaw():
    return bpy.data.objects["skin"].data.shape_keys.key_blocks["jawOpen"].value

scene = bpy.context.scene
scene.render.fps = 25
scene.frame_set(1)
shut = depth()
assert bpy.ops.kouxing.insert(filepath=table) == {"FINISHED"}
scene.frame_set(2)  # 0.04 s later
assert math.isclose(jaw(), 0.5, abs_tol=1e-6), jaw()
assert depth() < shut - 0.1, "the chin is lower"
scene.frame_set(3)
assert math.isclose(jaw(), 1.0, abs_tol=1e-6), jaw()

for shapes in bpy.data.shape_keys:
    shapes.animation_data_clear()
scene.kouxing_port = int(port)
assert bpy.ops.kouxing.follow() == {"FINISHED"}
values = [0.0] * 61
sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for value in (0.2, 0.7):
    values[17] = value  # JawOpen
    names = b"".join(struct.pack(">i", len(text)) + text for text in (b"0" * 36, b"kouxing"))
    head = struct.pack(">B", 6) + names + struct.pack(">ifiiB", 1, 0, 50, 1, 61)
    sender.sendto(head + struct.pack(">61f", *values), ("127.0.0.1", int(port)))
assert kouxing_face.RECEIVER.poll() > 0
assert kouxing_face.RECEIVER.num_packets == 2
assert math.isclose(jaw(), 0.7, abs_tol=1e-6), jaw()
sender.sendto(b"nonsense", ("127.0.0.1", int(port)))
kouxing_face.RECEIVER.poll()
assert math.isclose(jaw(), 0.7, abs_tol=1e-6), jaw()
assert bpy.ops.kouxing.follow() == {"FINISHED"}
assert kouxing_face.RECEIVER.poll() is None, "the timer ends"
kouxing_face.unregister()
print("all is well", flush=True)
os._exit(0)  # Blender's own threads may hold it
"""


def test_the_add_on_plays_a_recording_and_follows_a_stream(tmp_path: Path) -> None:
    if not list(BLENDER.glob("lib/python*/site-packages/bpy")):
        pytest.skip(f"no Blender in {BLENDER}: type make blender (373 MB, Python 3.11)")
    glb, table = tmp_path / "head.glb", tmp_path / "speech.csv"
    export_glb(heads.load("woman", "coarse"), glb)
    with table.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["time_s", *ARKIT.names])
        for number, weight in enumerate((0.0, 0.5, 1.0)):
            row = [weight * (name == "jawOpen") for name in ARKIT.names]
            rows.writerow([number * 0.04, *row])
    arguments = [str(glb), str(table), str(free_udp_port()), str(FOLDER)]
    result = subprocess.run(
        [BLENDER / "bin" / "python", "-c", SCRIPT, *arguments],
        capture_output=True,
        text=True,
        timeout=100,
        check=False,
    )
    assert "all is well" in result.stdout, result.stdout + result.stderr
