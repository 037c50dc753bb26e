#!/bin/sh
# Finding: Blender splits the vertices of a PLY file along the seams of texture coordinates
# Software: Blender 5.0.1 (bpy, PyPI; needs Python 3.11, 400 MB)
# Expected: a cube of 8 vertices is written with 8 vertices, as to OBJ
# Seen: PLY has 14, one more for each other texture coordinate at a corner; without texture coordinates there are 8
# Meets: who poses a cage in Blender and gives it back: it no longer has the vertices of the cage at rest
# Here: vertices at one place that differ in texture coordinates and normals alone are joined again (docs/blender.md,
#   `warpcage/mesh/io/ply.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3.11 -m venv venv
venv/bin/pip install -q --disable-pip-version-check bpy==5.0.1 numpy==1.26.4
venv/bin/python - <<'END'
import sys

import bpy

counts = {}
for seams in (True, False):
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_cube_add(calc_uvs=seams)
    bpy.ops.wm.ply_export(filepath="cube.ply", ascii_format=True)
    bpy.ops.wm.obj_export(filepath="cube.obj")
    with open("cube.ply") as file:
        ply = next(int(line.split()[-1]) for line in file if line.startswith("element vertex"))
    with open("cube.obj") as file:
        counts[seams] = (ply, sum(line.startswith("v ") for line in file))
    print(f"texture coordinates {seams}: {counts[seams][0]} vertices in PLY, {counts[seams][1]} in OBJ")
sys.exit(0 if counts == {True: (14, 8), False: (8, 8)} else "the behaviour has changed")
END
