#!/bin/sh
# Finding: PyMeshLab keeps the places of a PLY file of splats and nothing else
# Software: PyMeshLab 2025.7.post1 (PyPI)
# Expected: properties of vertices that are no mesh's (opacity, scale_0, rot_0, f_dc_0) are kept on saving, or their
#   loss is told
# Seen: the saved file has x, y and z: a cloud of points that no viewer of splats opens; nothing is said
# Meets: who cleans or crops a splat capture in MeshLab or by PyMeshLab
# Here: splats are cleaned and cut out here (docs/select.md, `warpcage/splats/clean.py`); a PLY file without a splat's
#   properties is refused.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check pymeshlab==2025.7.post1 numpy==2.4.6
venv/bin/python - <<'END'
import sys

import numpy as np
import pymeshlab

names = "x y z f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()
rows = np.random.default_rng(0).normal(size=(5, len(names))).astype("<f4")
head = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
head += "".join(f"property float {name}\n" for name in names) + "end_header\n"
with open("splats.ply", "wb") as file:
    file.write(head.encode() + rows.tobytes())
meshes = pymeshlab.MeshSet(verbose=False)
meshes.load_new_mesh("splats.ply")
meshes.save_current_mesh("saved.ply")
with open("saved.ply", "rb") as file:
    lines = file.read().split(b"end_header")[0].decode().splitlines()
saved = [line.split()[-1] for line in lines if line.startswith("property") and "list" not in line]
print("properties before:", *names)
print("properties after:", *saved)
sys.exit(0 if not {"opacity", "scale_0", "rot_0", "f_dc_0"} & set(saved) else "the behaviour has changed")
END
