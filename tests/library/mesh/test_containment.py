"""Winding number and distance of kernels/mesh/containment.py against float64 references."""

import numpy as np
import oracles
import pytest
import warp as wp

from warpcage import Cage
from warpcage.core import launch
from warpcage.kernels.mesh.containment import measure_distance, measure_winding_number


def measure(kernel, points, vertices, faces, device):
    result = wp.empty(len(points), dtype=float, device=device)
    arrays = [
        wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(vertices.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(faces.astype(np.int32), dtype=wp.vec3i, device=device),
    ]
    launch(kernel, len(points), arrays, [result], device=device)
    return result.numpy()


def points_around(vertices, count=2000):
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return oracles.single(np.random.default_rng(3).uniform(low - 0.3, high + 0.3, (count, 3)))


@pytest.mark.parametrize("name", ["icosphere", "box", "concave", "two boxes"])
def test_winding_number_is_that_of_the_dihedral_angles(name, device):
    vertices, faces = oracles.cage(name)
    points = points_around(vertices)
    winding = measure(measure_winding_number, points, vertices, faces, device)
    expected = oracles.winding_numbers(points, vertices, faces)
    assert 0.05 < (expected > 0.5).mean() < 0.95
    assert np.abs(winding - expected).max() < 1e-5


@pytest.mark.parametrize("name", ["icosphere", "box", "concave", "two boxes"])
def test_distance_is_to_the_nearest_triangle(name, device):
    vertices, faces = oracles.cage(name)
    points = points_around(vertices)
    distance = measure(measure_distance, points, vertices, faces, device)
    assert np.abs(distance - oracles.reference_distance(points, vertices, faces)).max() < 1e-6


def test_distance_is_zero_on_faces_edges_and_vertices(device):
    vertices, faces = oracles.cage("concave")
    corners = vertices[faces]
    on_cage = np.concatenate([corners.mean(axis=1), corners[:, :2].mean(axis=1), vertices])
    assert measure(measure_distance, on_cage, vertices, faces, device).max() < 1e-7


def test_winding_number_on_the_cage_is_finite_and_counts_the_solid_angle_inside(device):
    vertices, faces = oracles.cage("box")
    faces_of_box = vertices[faces].mean(axis=1)
    winding = measure(measure_winding_number, np.concatenate([faces_of_box, vertices]), vertices, faces, device)
    assert np.isfinite(winding).all()
    # the angle of the own face is a matter of rounding: half a sphere either way, or none
    assert np.all(np.min(np.abs(winding[: len(faces), None] - [0.0, 0.5, 1.0]), axis=1) < 1e-3)


def test_inward_cage_has_winding_number_minus_one(device):
    vertices, faces = oracles.cage("box")
    winding = measure(measure_winding_number, np.zeros((1, 3)), vertices, faces[:, ::-1], device)
    assert winding[0] == pytest.approx(-1.0, abs=1e-6)


@pytest.mark.parametrize("scale", [1e-30, 1e-16, 1e-15, 1e13, 1e16, 1e30])
def test_cages_of_any_size_contain_the_same(scale, device):
    vertices, faces = oracles.cage("concave")
    points = points_around(vertices)
    expected = oracles.winding_numbers(points, vertices, faces) > 0.5
    assert np.array_equal(Cage(scale * vertices, faces).contains(scale * points, device=device), expected)
