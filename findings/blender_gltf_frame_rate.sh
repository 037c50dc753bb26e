#!/bin/sh
# Finding: Blender's glTF multiplies the frames a second by the base of the rate, by which they are to be divided
# Software: Blender 5.0.1 (bpy, PyPI; needs Python 3.11, 400 MB)
# Expected: at 24 frames a second with base 1.001, key 24 is at 1.001 s, as Blender itself counts (24 / 23.976)
# Seen: it is at 0.999 s, 24 / 24.024: a minute is 0.12 s short against the footage; USD has the right rate
# Meets: who animates a cage over footage at 23.976, 29.97 or 59.94 frames a second and brings it as .glb
# Here: times are read as the file has them (docs/blender.md): write USD, or set the base to 1.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3.11 -m venv venv
venv/bin/pip install -q --disable-pip-version-check bpy==5.0.1 numpy==1.26.4
venv/bin/python - <<'END'
import json
import struct
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_cube_add()
scene, cube = bpy.context.scene, bpy.context.object
scene.render.fps, scene.render.fps_base = 24, 1.001
scene.frame_start, scene.frame_end = 0, 24
for frame, height in ((0, 0.0), (24, 1.0)):
    cube.location.z = height
    cube.keyframe_insert("location", frame=frame)
bpy.ops.export_scene.gltf(filepath="cube.glb")
with open("cube.glb", "rb") as file:
    data = file.read()
document = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
last = document["accessors"][document["animations"][0]["samplers"][0]["input"]]["max"][0]
bpy.ops.wm.usd_export(filepath="cube.usda", export_animation=True)
with open("cube.usda") as file:
    rate = next(float(line.split("=")[1]) for line in file if "timeCodesPerSecond" in line)
print(f"key 24 is at {24 / (24 / 1.001):.4f} s, in glTF at {last:.4f} s, in USD at {24 / rate:.4f} s")
sys.exit(0 if abs(last - 24 / 24.024) < 1e-4 and abs(rate - 24 / 1.001) < 1e-3 else "the behaviour has changed")
END
