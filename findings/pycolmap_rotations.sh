#!/bin/sh
# Finding: pycolmap takes matrices that mirror for the identity, and quaternions of any length as they are
# Software: pycolmap 4.2.1 (PyPI)
# Expected: a matrix with determinant -1, as a y-up export with one axis flipped has, is refused; a quaternion of
#   length 2 in images.txt is made a unit one, as COLMAP itself wrote such files
# Seen: the matrix becomes no turn at all; the quaternion stays, so that the camera's matrix scales and shears
# Meets: who turns cameras of another program into COLMAP's, or edits images.txt: cameras look elsewhere, nothing is
#   said
# Here: quaternions are made unit ones on reading (`warpcage/scene/formats/colmap.py`), cameras that mirror are
#   refused (`warpcage/view/camera.py`).
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install -q --disable-pip-version-check pycolmap==4.2.1 numpy==2.4.6
venv/bin/python - <<'END'
import pathlib
import sys

import numpy as np
import pycolmap

turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # a quarter about z
mirrored = turned @ np.diag([1.0, 1, -1])
for name, matrix in {"turned": turned, "mirrored": mirrored}.items():
    kept = np.allclose(pycolmap.Rotation3d(matrix).matrix(), matrix)
    print(f"{name}: kept {kept}, quaternion {np.round(pycolmap.Rotation3d(matrix).quat, 3).tolist()}")
lost = bool(np.allclose(pycolmap.Rotation3d(mirrored).quat[:3], 0))

folder = pathlib.Path("model")
folder.mkdir()
(folder / "cameras.txt").write_text("1 PINHOLE 64 48 50 50 32 24\n")
(folder / "images.txt").write_text("1 1.9 0 0 0.6 0 0 0 1 a.png\n\n")
(folder / "points3D.txt").write_text("")
matrix = pycolmap.Reconstruction(folder).images[1].cam_from_world().rotation.matrix()
print("of a quaternion of length 1.99, the lengths of the matrix' columns:", np.linalg.norm(matrix, axis=0).round(3).tolist())
scaled = not np.allclose(np.linalg.norm(matrix, axis=0), 1)
sys.exit(0 if lost and scaled else "the behaviour has changed")
END
