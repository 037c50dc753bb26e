#!/bin/sh
# Finding: PyMeshLab takes colours above 1 modulo 256, so that what is too bright becomes dark
# Software: PyMeshLab 2025.7.post1 (PyPI)
# Expected: vertex colours of 1.5, brighter than white, are held at white or refused
# Seen: 1.5 is read back as 0.49, 1.01 as 0.004: bytes that ran over
# Meets: who hands colours of a field's harmonics, or of light, which pass 1 in highlights, to PyMeshLab
# Here: colours of surfaces are held to 0 to 1 (`warpcage/field/surface.py`); PyMeshLab gets none.
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

corners, faces = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])
found = {}
for value in (1.0, 1.01, 1.5):
    mesh = pymeshlab.Mesh(corners, faces, v_color_matrix=np.full((3, 4), value))
    found[value] = round(float(mesh.vertex_color_matrix()[0, 0]), 3)
print("colours, and what they are read back as:", found)
sys.exit(0 if found[1.0] == 1 and found[1.01] < 0.1 and found[1.5] < 0.5 else "the behaviour has changed")
END
