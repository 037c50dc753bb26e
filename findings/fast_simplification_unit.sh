#!/bin/sh
# Finding: fast_simplification stops at errors in the mesh's own unit, so that large meshes stay as they are
# Software: fast_simplification 0.2.0 (PyPI)
# Expected: a ball of 5,120 faces becomes one of 200 in metres and in millimetres alike
# Seen: at radius 1 it has 200 faces, at radius 100 712, at radius 1000 all 5,120: the bounds on errors of its rounds
#   are numbers without regard to size (agg=5; larger values move the limit)
# Meets: who makes a light mesh or a first cage of a field that is measured in millimetres or in map units
# Here: meshes are brought to size 1 before, and back after (`warpcage/field/texture.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check fast_simplification==0.2.0 trimesh==5.2.0 numpy==2.4.6
venv/bin/python - <<'END'
import sys

import fast_simplification
import numpy as np
import trimesh

ball = trimesh.creation.icosphere(subdivisions=4)
counts = {}
for radius in (0.01, 1, 100, 1000):
    points = (radius * ball.vertices).astype(np.float32)
    _, faces = fast_simplification.simplify(points, ball.faces.astype(np.int32), target_count=200, agg=5)
    counts[radius] = len(faces)
print(f"{len(ball.faces)} faces, asked for 200, by radius:", counts)
sys.exit(0 if counts[1] == 200 and counts[1000] == len(ball.faces) else "the behaviour has changed")
END
