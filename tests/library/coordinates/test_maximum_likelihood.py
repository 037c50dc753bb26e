"""Maximum likelihood coordinates against the convex problem that defines them, solved by SciPy from integrals over the
faces, and what they are for: nothing negative in concave cages."""

import numpy as np
import oracles
import pytest
import warp as wp
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, PositionMap, deform_points, harmonic_coordinates, maximum_likelihood_coordinates
from warpcage.core import launch
from warpcage.kernels.coordinates.maximum_likelihood import map_maximum_likelihood, weigh_maximum_likelihood
from warpcage.mesh import prepared_fans

some_cages = pytest.mark.parametrize("name", oracles.CAGES)


def two_legs(gap=0.2, levels=3):
    """A body on two legs that stand `gap` apart, 1 x 0.5 x 1.2: vertices, faces."""
    xs, ys = (-0.5, -gap / 2, gap / 2, 0.5), (-0.25, 0.25)
    zs = [*np.linspace(-0.8, 0.0, levels + 1), 0.4]
    cells = {(i, k) for i in range(3) for k in range(levels + 1) if i != 1 or k == levels}
    sides = [
        ((1, 0), [(1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)]),
        ((-1, 0), [(0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)]),
        ((0, 1), [(0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]),
        ((0, -1), [(0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)]),
        (None, [(0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)]),
        (None, [(0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)]),
    ]
    numbers, faces = {}, []
    for i, k in sorted(cells):
        for away, corners in sides:
            if away is None or (i + away[0], k + away[1]) not in cells:
                a, b, c, d = (numbers.setdefault((i + p, q, k + r), len(numbers)) for p, q, r in corners)
                faces += [[a, b, c], [a, c, d]]
    return np.array([(xs[i], ys[j], zs[k]) for i, j, k in numbers]), np.array(faces)


def on_faces(vertices, faces, seed=5):
    """A point on each face, and the rows of weights that are linear there."""
    shares = np.random.default_rng(seed).dirichlet([1, 1, 1], len(faces))
    rows = np.zeros((len(faces), len(vertices)))
    for k in range(3):
        np.add.at(rows, (np.arange(len(faces)), faces[:, k]), shares[:, k])
    return rows @ vertices, rows


def test_reference_is_that_of_the_integrals():
    vertices, faces = oracles.icosphere(1)
    points = 0.4 * vertices[:6]
    closed, quadrature = (
        oracles.maximum_likelihood_weights(points, vertices, faces, seen)
        for seen in (oracles.seen_faces, oracles.seen_faces_by_quadrature)
    )
    assert np.abs(closed - quadrature).max() < 1e-10
    for ours, theirs in zip(
        oracles.seen_faces(points, vertices, faces),
        oracles.seen_faces_by_quadrature(points, vertices, faces),
        strict=True,
    ):
        assert np.abs(ours - theirs).max() < 1e-10


@some_cages
def test_weights_are_those_of_the_reference(name, device):
    vertices, faces = oracles.cage(name)
    points = oracles.single(oracles.inside_points(vertices, faces, 60))
    weights = maximum_likelihood_coordinates(points, Cage(vertices, faces), device=device)
    assert weights.dtype == np.float32
    assert np.abs(weights - oracles.maximum_likelihood_weights(points, vertices, faces)).max() < 2e-6


@some_cages
def test_they_are_coordinates_and_none_is_negative(name, device):
    vertices, faces = oracles.cage(name)
    points = oracles.inside_points(vertices, faces, 600)
    weights = maximum_likelihood_coordinates(points, Cage(vertices, faces), device=device).astype(np.float64)
    assert weights.min() > -1e-7
    assert np.abs(weights.sum(axis=1) - 1).max() < 3e-6 and np.abs(weights @ vertices - points).max() < 2e-6
    if name in ("concave", "two boxes"):
        assert oracles.mean_value_weights(points, vertices, faces).min() < -1e-3


@pytest.mark.parametrize("height", [1e-7, 1.5e-6, 1e-5, 1e-4, 9e-4, 1.1e-3, 3e-3])
def test_weights_hold_near_planes_of_far_faces(height, device):
    vertices, faces = oracles.cage("concave")
    points = oracles.points_near_planes(vertices, faces, height)[::5]
    weights = maximum_likelihood_coordinates(points, Cage(vertices, faces), device=device)
    assert np.abs(weights @ vertices - points).max() < 2e-6
    assert np.abs(weights - oracles.maximum_likelihood_weights(points, vertices, faces)).max() < 5e-6


@some_cages
def test_they_are_linear_on_faces_edges_and_one_at_vertices(name, device):
    vertices, faces = oracles.cage(name)
    cage = Cage(vertices, faces)
    points, rows = on_faces(vertices, faces)
    normals = oracles.unit_normals(vertices, faces)
    for away, bound in ((0.0, 1e-6), (9e-6, 2e-5), (-1e-6, 2e-5), (-1e-4, 2e-2)):  # outwards: counts as on the cage
        moved = points + away * cage.size * normals
        assert np.abs(maximum_likelihood_coordinates(moved, cage, device=device) - rows).max() < bound
    middles = vertices[faces[:, :2]].mean(axis=1)
    weights = maximum_likelihood_coordinates(np.concatenate([vertices, middles]), cage, device=device)
    assert np.abs(weights[: len(vertices)] - np.eye(len(vertices))).max() < 1e-6
    assert np.abs(weights[len(vertices) :].max(axis=1) - 0.5).max() < 1e-6


def test_slopes_are_continuous_where_a_face_turns_away(device):
    """Across the planes of the L's two reflex faces, where the prior of a face that turns away reaches zero."""
    vertices, faces = oracles.cage("concave")
    cage = Cage(vertices, faces)
    targets = np.random.default_rng(3).normal(size=vertices.shape)
    steps = 2e-2 * np.arange(-4, 5)
    line = np.array([-0.1, -0.3, 0.03]) + steps[:, None] * [1.0, 0.1, 0.0]
    exact = oracles.maximum_likelihood_weights(line + 1e-9, vertices, faces) @ targets
    found = deform_points(line, cage, targets, "maximum_likelihood", device=device)
    assert np.abs(found - exact).max() < 1e-5
    fine = line[4] + 1e-4 * np.array([-2, -1, 0, 1, 2])[:, None] * [1.0, 0.1, 0.0]
    values = oracles.maximum_likelihood_weights(fine + 1e-9, vertices, faces) @ targets
    slopes = np.diff(values, axis=0) / 1e-4
    assert np.abs(np.diff(slopes, axis=0)).max() < 2e-3 * np.abs(slopes).max()


def test_map_is_the_weighted_sum_and_affine_poses_are_exact(device):
    vertices, faces = two_legs()
    cage = Cage(vertices, faces)
    points = np.concatenate([oracles.inside_points(vertices, faces, 400), vertices[:4]])
    targets = vertices + np.random.default_rng(3).normal(0, 0.3, vertices.shape)
    weights = maximum_likelihood_coordinates(points, cage, device=device).astype(np.float64)
    moved = deform_points(points, cage, targets, "maximum_likelihood", device=device)
    assert np.abs(moved - weights @ targets).max() < 3e-6
    matrix = np.array([[0.9, -0.5, 0.1], [0.4, 1.2, 0.3], [-0.2, 0.1, 0.8]])
    moved = deform_points(points, cage, vertices @ matrix.T + 2.0, "maximum_likelihood", device=device)
    assert np.abs(moved - points @ matrix.T - 2.0).max() < 3e-6


@pytest.mark.parametrize("scale", [(1, 1, 1e-2), (1, 1e-2, 1e-2), (1, 1e-3, 1e-3)], ids=["leaf", "rod", "needle"])
@some_cages
def test_flat_and_long_cages_have_them(name, scale, device):
    """Where hardly any solid angle is left along some direction, y is far from p, and plain Newton steps go astray."""
    vertices, faces = oracles.cage(name)
    vertices = vertices * scale
    points = oracles.inside_points(vertices, faces, 200)
    weights = maximum_likelihood_coordinates(points, Cage(vertices, faces), device=device).astype(np.float64)
    assert weights.min() > -1e-7 and np.abs(weights @ vertices - points).max() < 3e-6


def test_a_leg_goes_with_the_other_less_than_by_mean_value(device):
    """Both legs stand a fifth of the width apart; one is lifted by 0.7."""
    vertices, faces = two_legs()
    cage = Cage(vertices, faces)
    random = np.random.default_rng(0)
    points = np.array([-0.3, 0.0, -0.55]) + random.uniform(-1, 1, (200, 3)) * [0.18, 0.2, 0.23]
    lift = np.where((vertices[:, :1] > 0) & (vertices[:, 2:] < -0.3), [0.5, 0.0, 0.5], 0.0)
    moved = {
        kind: deform_points(points, cage, vertices + lift, kind, device=device) - points
        for kind in ("mean_value", "maximum_likelihood")
    }
    reach = {kind: np.linalg.norm(each, axis=1) for kind, each in moved.items()}
    assert moved["mean_value"][:, 0].min() < -5e-3  # away from where the other leg goes
    assert moved["maximum_likelihood"][:, 0].min() > -1e-6
    assert reach["maximum_likelihood"].max() < 0.7 * reach["mean_value"].max() < 0.03
    harmonic = harmonic_coordinates(points, cage, 32, device=device) @ lift
    assert np.linalg.norm(harmonic, axis=1).max() < 1e-3


def test_points_without_a_solution_are_said_to_have_none(device):
    """Outside of the cage, where directions to the faces that are seen from inside lie on one side."""
    vertices, faces = oracles.cage("box")
    points, corners = (
        wp.array(np.float32(each), dtype=wp.vec3, device=device) for each in (np.full((3, 3), [0, 0, 2]), vertices)
    )
    triangles = wp.array(np.int32(faces), dtype=wp.vec3i, device=device)
    positions, weights = wp.empty(3, dtype=wp.vec3, device=device), wp.empty((3, 8), dtype=float, device=device)
    inputs = [points, corners, triangles, prepared_fans(corners, triangles, 1.0), corners, 1.0]
    launch(map_maximum_likelihood, 3, inputs, [positions], device=device)
    launch(weigh_maximum_likelihood, 3, [points, corners, triangles, 1.0], [weights], device=device)
    assert np.isnan(positions.numpy()).all() and np.isnan(weights.numpy()).all()


@pytest.mark.parametrize("store", ["map", "weights"])
def test_maps_without_a_solution_say_so(store, device):
    """Nodes inside a cage have one, so the cage is taken away from under its lattice."""
    cage = Cage(*oracles.cage("concave"))
    found = PositionMap(cage, coordinates="maximum_likelihood", resolution=16, store=store, device=device)
    launches = found.pose(cage.twist(20)).launches
    solver, vertices = launches.solver, launches.solver.lattice.constants.centered.array
    assert found.residual == 0.0
    vertices.assign(vertices.numpy() + [0, 0, 100])
    if store == "weights":
        refused(solver.weigh, match=MESSAGES["coordinates.no_solution"].format(what="weights"))
        return
    solver.clear(solver.sizes)
    solver.launch_solution(solver.sizes, launches.target)
    assert np.isfinite(solver.values.numpy()).all()
    with pytest.warns(UserWarning, match=MESSAGES["coordinates.no_solution"].format(what="coordinates")):
        solver.take_status(solver.status.numpy())
    assert solver.residual > 0.1
