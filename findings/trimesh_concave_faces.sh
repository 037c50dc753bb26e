#!/bin/sh
# Finding: trimesh cuts concave polygons into fans that reach outside them
# Software: trimesh 5.2.0 (PyPI)
# Expected: a flat face of five corners with a notch, area 10, becomes triangles of area 10 that look one way
# Seen: a fan from its first corner: area 14, a triangle across the notch, another that looks backward
# Meets: who checks a cage with polygons, as Blender keeps them in OBJ, PLY and OFF: its volume and normals are wrong
# Here: cages are cut ear by ear (`warpcage/mesh/polygons.py`), as are objects beside fields
#   (`warpcage/render/surface_file.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check trimesh==5.2.0 numpy==2.4.6
venv/bin/python - <<'END'
import io
import sys

import trimesh

corners = [(0, 0), (4, 0), (4, 4), (2, 1), (0, 4)]
wavefront = "".join(f"v {x} {y} 0\n" for x, y in corners) + "f 1 2 3 4 5\n"
off = "OFF\n5 1 0\n" + "".join(f"{x} {y} 0\n" for x, y in corners) + "5 0 1 2 3 4\n"
following = corners[1:] + corners[:1]
area = 0.5 * sum(a * d - b * c for (a, b), (c, d) in zip(corners, following))
changed = False
for ending, text in (("obj", wavefront), ("off", off)):
    mesh = trimesh.load(io.BytesIO(text.encode()), file_type=ending, process=False)
    backward = int((mesh.face_normals[:, 2] < 0).sum())
    print(f"{ending}: area {mesh.area} of {area}, faces that look backward: {backward} of {len(mesh.faces)}")
    changed |= (mesh.area, backward) != (14.0, 1)
sys.exit("the behaviour has changed" if changed else 0)
END
