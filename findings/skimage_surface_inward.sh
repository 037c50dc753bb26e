#!/bin/sh
# Finding: marching_cubes of scikit-image winds the surface of a density inward
# Software: scikit-image 0.26.0 (PyPI)
# Expected: with gradient_direction='descent', the default, 'objects of interest' are greater than what is around
#   them, so the faces of a dense ball look outward
# Seen: they look inward (negative volume), against the normals that the same call returns, which look outward;
#   'ascent' winds them outward
# Meets: who takes the surface of a density, of a field's nodes as well, for a cage, for normals or for a test of
#   inside
# Here: the volume's sign decides (`warpcage/field/surface.py`, `warpcage/cage/generate/shell.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check scikit-image==0.26.0 numpy==2.4.6
venv/bin/python - <<'END'
import sys

import numpy as np
from skimage.measure import marching_cubes

middle = 15.5
offsets = np.stack(np.meshgrid(*[np.arange(32) - middle] * 3, indexing="ij"), axis=-1)
density = np.exp(-np.linalg.norm(offsets, axis=-1) / 5)  # most in the middle
found = []
for direction in ("descent", "ascent"):
    vertices, faces, normals, _ = marching_cubes(density, level=0.2, gradient_direction=direction)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    volume = np.einsum("fi,fi->", a, np.cross(b, c)) / 6
    outward = ((vertices - middle) * normals).sum(axis=1).mean() > 0
    print(f"{direction}: volume {volume:.0f}, normals look {'outward' if outward else 'inward'}")
    found.append((volume > 0, outward))
sys.exit(0 if found == [(False, True), (True, True)] else "the behaviour has changed")
END
