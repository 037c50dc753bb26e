#!/bin/sh
# Finding: what one call of a PyMeshLab filter was given is the default of the next, in another MeshSet too
# Software: PyMeshLab 2025.7.post1 (PyPI)
# Expected: a filter called without options has the defaults that print_filter_parameter_list shows, whatever was
#   called before
# Seen: after one call of the quadric decimation with optimalplacement=False, calls without options keep to it: the
#   same mesh becomes another one
# Meets: whose program decimates meshes in more than one place: a cage depends on what ran before it in the process
# Here: every parameter is given, so that cages are the same after any calls; calls of yours that follow a generated
#   cage meet its values: give all of yours (`warpcage/cage/generate/shell.py`).
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


def ball(count):
    """Vertices and triangles of an ellipsoid, rows of latitude of `count` vertices each and two poles."""
    angle, height = 2 * np.pi * np.arange(count) / count, np.linspace(-1, 1, count + 2)[1:-1]
    rows = [np.stack([np.cos(angle) * r, 2 * np.sin(angle) * r, np.full(count, h)], axis=1)
            for h, r in zip(height, np.sqrt(1 - height**2))]
    vertices = np.concatenate([*rows, [[0, 0, -1], [0, 0, 1]]])
    faces, low, high = [], count * count, count * count + 1
    for j in range(count):
        k = (j + 1) % count
        faces += [(low, k, j), (high, count * (count - 1) + j, count * (count - 1) + k)]
        for i in range(0, count * (count - 1), count):
            faces += [(i + j, i + k, i + count + k), (i + j, i + count + k, i + count + j)]
    return vertices, np.array(faces)


def decimated(**options):
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(*ball(30)))
    meshes.meshing_decimation_quadric_edge_collapse(targetfacenum=100, **options)
    return meshes.current_mesh().vertex_matrix()


first, again = decimated(), decimated()
decimated(optimalplacement=False)
after = decimated()
print("the same call twice gives the same:", np.array_equal(first, again))
print("after a call with optimalplacement=False in between:", np.array_equal(first, after))
sys.exit(0 if np.array_equal(first, again) and not np.array_equal(first, after) else "the behaviour has changed")
END
