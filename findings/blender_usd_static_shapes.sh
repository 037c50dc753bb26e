#!/bin/sh
# Finding: Blender's USD has shape keys without their values where no animation is written
# Software: Blender 5.0.1 (bpy, PyPI; needs Python 3.11, 400 MB)
# Expected: a plane whose shape key lifts it to 0.75 is at 0.75 in a .usda file of one frame, as it is in glTF
# Seen: the points are those at rest, with a blend shape, and blendShapeWeights has no value: readers show the plane
#   at 0
# Meets: who poses a cage by a shape key's slider and exports USD: the pose is lost
# Here: shapes without any value are read as poses, each at 1, with a warning (docs/blender.md).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3.11 -m venv venv
venv/bin/pip install -q --disable-pip-version-check bpy==5.0.1 numpy==1.26.4
venv/bin/python - <<'END'
import re
import sys

import bpy

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.mesh.primitive_plane_add()
plane = bpy.context.object
plane.shape_key_add(name="Basis")
key = plane.shape_key_add(name="lift")
for point in key.data:
    point.co.z = 1.0
key.value = 0.75
found = {}
for name, options in {"as it is": {}, "without shape keys": {"export_shapekeys": False}}.items():
    bpy.ops.wm.usd_export(filepath="plane.usda", **options)
    with open("plane.usda") as file:
        text = file.read()
    height = float(re.search(r"points = \[\(\S+ \S+ ([\d.]+)\)", text)[1])
    found[name] = (height, re.findall(r"blendShapeWeights.*", text))
    print(f"{name}: height of the points {height}, weights {found[name][1]}")
expected = {"as it is": (0.0, ["blendShapeWeights"]), "without shape keys": (0.75, [])}
sys.exit(0 if found == expected else "the behaviour has changed")
END
