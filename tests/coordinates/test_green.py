"""Green kernels against the pseudo-code of Lipman et al. in float64, and that against quadrature."""

import functools

import numpy as np
import oracles
import pytest
import test_closed_forms
import trimesh
from test_closed_forms import error_to, reproduction_error

from warpcage import Cage, deform_points, green_coordinates
from warpcage.coordinates import stretched_normals

weigh = functools.partial(test_closed_forms.weigh, "green")


def test_references_match_quadrature():
    vertices, faces = oracles.icosphere(1)
    points = 0.4 * vertices
    wanted = oracles.green_weights_by_quadrature(points, vertices, faces)
    assert error_to(oracles.green_weights(points, vertices, faces), wanted) < 1e-10
    assert error_to(oracles.green_weights_in_closed_form(points, vertices, faces), wanted) < 1e-10


@pytest.mark.parametrize("distance", [1e-6, 1e-5, 1e-4, 1e-3, 1e-2])
@pytest.mark.parametrize("kind", ["face", "edge", "vertex"])
@pytest.mark.parametrize("name", ["icosphere", "box"])
def test_weights_match_oracle_up_to_the_cage(name, kind, distance, device):
    vertices, faces = oracles.cage(name)
    points, _ = oracles.points_by_the_cage(vertices, faces, kind, distance)
    points = oracles.single(points)
    weights = weigh(points, vertices, faces, device)
    assert error_to(weights, oracles.green_weights_in_closed_form(points, vertices, faces)) < 1e-5
    assert reproduction_error(weights, points, vertices, faces) < 1e-5


@pytest.mark.parametrize("distance", [0.0, 1e-7, 1e-6, 9e-6])
@pytest.mark.parametrize("kind", ["face", "edge", "vertex"])
@pytest.mark.parametrize("name", ["icosphere", "concave", "box"])
def test_points_on_the_cage_take_the_limit_from_inside(name, kind, distance, device):
    vertices, faces = oracles.cage(name)
    inside, _ = oracles.points_by_the_cage(vertices, faces, kind, 1e-6)
    wanted = oracles.green_weights_in_closed_form(inside, vertices, faces)
    for side in (1, -1):
        points, _ = oracles.points_by_the_cage(vertices, faces, kind, side * distance)
        weights = weigh(points, vertices, faces, device)
        assert reproduction_error(weights, points, vertices, faces) < 3e-5
        # the weights leave the cage like d log d
        assert error_to(weights, wanted) < 4e-5 + 40 * distance


def test_overlapping_parts_keep_the_limit_from_inside(device):
    """On a box that lies inside another one the sum of phi goes from one to two."""
    vertices, faces = oracles.cage("box")
    both = np.concatenate([2 * vertices, vertices])
    more = np.concatenate([faces, faces + len(vertices)])
    on, _ = oracles.points_by_the_cage(vertices, faces, "edge", 0.0)
    within, _ = oracles.points_by_the_cage(vertices, faces, "edge", 1e-4)
    weights, wanted = weigh(on, both, more, device), weigh(within, both, more, device)
    assert np.abs(wanted[0].sum(axis=1) - 2).max() < 1e-5
    assert error_to(weights, wanted) < 1e-3


def test_far_outside_sums_to_zero(device):
    vertices, faces = oracles.cage("box")
    phi, psi = weigh(1.5 * vertices, vertices, faces, device)
    assert np.abs(phi.sum(axis=1)).max() < 1e-5 and np.isfinite(psi).all()


def test_boundary_elements_solve_laplace():
    """The oracle of harmonic coordinates. Linear data are exact; with those of 1 / |x - source|, linear on ever finer
    faces, it tends to that function."""
    vertices, faces = oracles.concave_l()
    points = oracles.inside_points(vertices, faces, 200)
    slope, source = np.array([1.0, 2.0, -1.0]), np.array([1.0, 1.0, 1.0])
    linear = oracles.harmonic_oracle(vertices, faces, (vertices @ slope + 3.0)[:, None], points, 1)
    assert np.abs(linear[:, 0] - points @ slope - 3.0).max() < 1e-10

    def error(cuts):
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        for _ in range(cuts):
            mesh = mesh.subdivide()
        data = 1 / np.linalg.norm(mesh.vertices - source, axis=1, keepdims=True)
        found = oracles.harmonic_oracle(mesh.vertices, mesh.faces, data, points, 0)[:, 0]
        return np.abs(found - 1 / np.linalg.norm(points - source, axis=1)).mean()

    assert error(2) < 1e-3
    assert error(3) < 0.4 * error(2)


@pytest.mark.parametrize("gap", [0.0, 3e-6])
def test_parts_that_touch_do_not_know_of_each_other(gap, device):
    """A small box stands on a large one: points next to both belong to the one that they are in."""
    large, small = Cage.box((0, 0, 0), (1, 1, 1)), Cage.box((0.2, 0.2, 1 + gap), (0.7, 0.8, 1.6))
    cage = Cage(np.concatenate([large.vertices, small.vertices]), np.concatenate([large.faces, small.faces + 8]))
    lifted = cage.with_vertices(cage.vertices + np.repeat([[0, 0, 0], [0, 0, 5.0]], 8, axis=0))
    places = np.random.default_rng(0).uniform((0.21, 0.21), (0.69, 0.79), (20, 2))
    for depth in (1e-6, 5e-6, 1e-5, 1e-4):
        below = np.column_stack([places, np.full(20, 1 - depth)])
        above = np.column_stack([places, np.full(20, 1 + gap + depth)])
        for points, offset in ((below, 0.0), (above, 5.0)):
            phi, psi = green_coordinates(points, cage, device=device)
            assert np.abs(phi.sum(axis=1) - 1).max() < 1e-5
            assert np.abs(phi @ cage.vertices + psi @ stretched_normals(cage, cage) - points).max() < 2e-5
            moved = deform_points(points, cage, lifted, "green", device=device)
            assert np.abs(moved - points - [0, 0, offset]).max() < 2e-5
