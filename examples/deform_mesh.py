"""Deform a triangle mesh by posing a cage around it: points in, points out, no radiance field.

    python examples/deform_mesh.py

`deform_points` moves any array of points (NumPy, or on a GPU through DLPack). Faces, colours and texture coordinates of
a mesh stay as they are. The checks at the end are properties of the coordinates.
"""

import argparse

import numpy as np
import trimesh
import warp as wp

from warpcage import Cage, deform_points, mean_value_coordinates

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads

# A model to deform: a ring, and a cage of about forty vertices around it.
mesh = trimesh.creation.torus(major_radius=1.0, minor_radius=0.3, major_sections=96, minor_sections=32)
rest = Cage.box(mesh.bounds * 1.05, segments=(3, 3, 1))

# Pose the cage and let the model follow, once for each kind of coordinates.
posed = rest.bend(70, axis="x", towards="z").twist(25, axis="x")
for kind in ("mean_value", "green", "harmonic", "maximum_likelihood", "biharmonic"):
    moved = mesh.copy()
    moved.vertices = deform_points(mesh.vertices, rest, posed, coordinates=kind)
    size = np.ptp(moved.vertices, axis=0)
    print(f"{kind:18s} {len(moved.vertices)} vertices, box {np.round(size, 2)}, volume {moved.volume:.3f}")
    assert np.isfinite(moved.vertices).all() and moved.is_watertight
    assert 0.5 * mesh.volume < moved.volume < 2.0 * mesh.volume

# The same with weights, for many poses of one model: points = weights @ vertices of the posed cage.
weights = mean_value_coordinates(mesh.vertices, rest)
by_weights = weights @ posed.vertices
assert np.abs(by_weights - deform_points(mesh.vertices, rest, posed)).max() < 1e-4 * posed.size

# Turning the cage turns the model.
turned = rest.rotate(40, axis="z")
expected = trimesh.transform_points(
    mesh.vertices, trimesh.transformations.rotation_matrix(np.radians(40), (0, 0, 1), rest.bounds.mean(axis=0))
)
for kind in ("mean_value", "green", "harmonic", "maximum_likelihood", "biharmonic"):
    moved = deform_points(mesh.vertices, rest, turned, coordinates=kind)
    assert np.abs(moved - expected).max() < 1e-4 * rest.size
print("turned cages turn the model")
