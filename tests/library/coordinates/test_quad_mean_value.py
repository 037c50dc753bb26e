"""Mean value coordinates of cages of bilinear quads, against quadrature of their definition in float64."""

import numpy as np
import oracles
import pytest

from warpcage import Cage, deform_points, mean_value_coordinates

#: Cells along an edge of a cube, and by what of their side vertices are off: planar, bent, and many quads.
some_cages = pytest.mark.parametrize("cells, bend", [(1, 0.0), (1, 0.2), (2, 0.2), (4, 0.15)])


def cage(cells, bend):
    vertices, quads = oracles.quad_cage(cells, bend)
    return oracles.single(vertices), quads


def weights_of(points, vertices, faces, device):
    return mean_value_coordinates(np.asarray(points, np.float64), Cage(vertices, faces), device=device)


def error_to(weights, wanted):
    return np.abs(weights - wanted).max()


def cut(quads, corner=0):
    """Both triangles of each quad, cut from a corner."""
    a, b, c, d = np.roll(quads, -corner, axis=1).T
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


# -- Inside and around


@some_cages
def test_weights_are_the_integrals_over_bilinear_patches(cells, bend, device):
    vertices, quads = cage(cells, bend)
    points = oracles.single(np.random.default_rng(1).uniform(-0.4, 0.4, (100, 3)))
    weights = weights_of(points, vertices, quads, device)
    assert error_to(weights, oracles.quad_mean_value_weights(points, vertices, quads)) < 3e-6
    assert np.abs(weights @ vertices - points).max() < 1e-6 and np.abs(weights.sum(axis=1) - 1).max() < 1e-6


@pytest.mark.parametrize(
    "height",
    [
        pytest.param(1e-1, marks=pytest.mark.nightly),
        pytest.param(1e-2, marks=pytest.mark.nightly),
        pytest.param(1e-3, marks=pytest.mark.nightly),
        1e-5,
    ],
)
@some_cages
def test_weights_hold_up_to_the_patches(cells, bend, height, device):
    vertices, quads = cage(cells, bend)
    for side in (1, -1):
        places, normals, _ = oracles.on_quads(vertices, quads, 30)
        points = oracles.single(places - side * height * normals)
        wanted = oracles.quad_mean_value_weights(points, vertices, quads)
        assert error_to(weights_of(points, vertices, quads, device), wanted) < 3e-6


@pytest.mark.parametrize("distance", [0.0, 1e-7, 9e-7])
@some_cages
def test_on_the_patches_weights_are_bilinear(cells, bend, distance, device):
    vertices, quads = cage(cells, bend)
    places, normals, wanted = oracles.on_quads(vertices, quads, 200)
    weights = weights_of(places - distance * normals, vertices, quads, device)
    assert error_to(weights, wanted) < 1e-6 + 20 * cells * distance
    edges = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    for share in (0.0, 0.5, 0.9):
        points = (1 - share) * vertices[edges[:, 0]] + share * vertices[edges[:, 1]]
        wanted = (1 - share) * np.eye(len(vertices))[edges[:, 0]] + share * np.eye(len(vertices))[edges[:, 1]]
        assert error_to(weights_of(points, vertices, quads, device), wanted) < 2e-6


def test_sheared_and_bent_patches(device):
    """Quads of all shapes around the origin: long, with acute corners, strongly bent."""
    vertices, quads = oracles.quad_cage(2, 0.0)
    vertices = oracles.single(vertices @ [[3.0, 0.8, 0], [0, 0.4, 0.3], [0, 0, 1]] + 0.15 * vertices[:, [1, 2, 0]] ** 2)
    places, normals, _ = oracles.on_quads(vertices, quads, 40)
    for height in (1e-1, 1e-2, 1e-4):
        points = oracles.single(places - height * normals)
        wanted = oracles.quad_mean_value_weights(points, vertices, quads)
        assert error_to(weights_of(points, vertices, quads, device), wanted) < 1e-5


@pytest.mark.parametrize("distance", [0.9, 3.0, pytest.param(30.0, marks=pytest.mark.nightly), 900.0])
@some_cages
def test_points_outside_follow_the_formula(cells, bend, distance, device):
    vertices, quads = cage(cells, bend)
    points = np.random.default_rng(0).normal(size=(50, 3))
    points = oracles.single(distance * points / np.linalg.norm(points, axis=1, keepdims=True))
    wanted = oracles.quad_mean_value_weights(points, vertices, quads)
    weights = weights_of(points, vertices, quads, device)
    assert error_to(weights, wanted) < 1e-5 * np.abs(wanted).max()


@pytest.mark.parametrize("height", [0.0, 1e-12, 1e-7, 1e-5, 9e-4, 1.1e-3])
def test_points_in_the_plane_of_a_far_quad(height, device):
    """Beside the faces of a cube whose corner is lifted: planes of quads and of corners run through the points."""
    vertices, quads = cage(1, 0.0)
    vertices[7] += [0.25, 0, 0.5]
    points = oracles.single(np.random.default_rng(3).uniform(-0.4, 0.4, (60, 3)))
    points[:30, 0] = -0.5 - height  # of the left face, above it
    points[:30, 2] += 1.0
    points[30:, 2] = 0.5 + height  # of three corners of the top face, below its middle
    wanted = oracles.quad_mean_value_weights(points + [1e-13, 0, 1e-13], vertices, quads)
    assert error_to(weights_of(points, vertices, quads, device), wanted) < 1e-5


# -- Faces of all kinds


def test_mirrored_poses_of_a_cube_agree(device):
    """Each corner of the top lifted by one in turn: the middle below the top rises by the same."""
    vertices, quads = oracles.quad_cage(1, 0.0)
    weights = weights_of([[0, 0, 0.45]], vertices, quads, device)[0]
    top = np.flatnonzero(vertices[:, 2] > 0)
    assert np.ptp(weights[top]) < 1e-6 and 0.2 < weights[top].mean() < 0.25


def test_turned_quads_weigh_the_same(device):
    """Which corner a face begins with does not matter."""
    vertices, quads = cage(2, 0.2)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (200, 3))
    wanted = weights_of(points, vertices, quads, device)
    for turn in (1, 2, 3):
        assert error_to(weights_of(points, vertices, np.roll(quads, turn, axis=1), device), wanted) < 3e-6


def test_triangles_beside_quads_have_linear_values(device):
    vertices, quads = cage(2, 0.2)
    triangles = cut(quads[:10])
    points = oracles.single(np.random.default_rng(1).uniform(-0.4, 0.4, (200, 3)))
    weights = weights_of(points, vertices, [*triangles.tolist(), *quads[10:].tolist()], device)
    patches = np.concatenate([np.column_stack([triangles, triangles[:, 2]]), quads[10:]])  # two corners at one place
    assert error_to(weights, oracles.quad_mean_value_weights(points, vertices, patches)) < 3e-6


def test_scale_and_place_do_not_matter(device):
    vertices, quads = cage(2, 0.2)
    points = oracles.single(np.random.default_rng(1).uniform(-0.4, 0.4, (100, 3)))
    wanted = weights_of(points, vertices, quads, device)
    for scale, off in ((1e-4, 0.0), (1e4, 0.0), (3.0, 1e3)):
        weights = weights_of(points * scale + off, vertices * scale + off, quads, device)
        assert error_to(weights, wanted) < 2e-6


# -- Maps


@pytest.mark.parametrize("cells, bend", [(1, 0.2), (2, 0.2), (4, 0.15), (6, 0.0)])
def test_map_is_the_weighted_sum(cells, bend, device):
    vertices, quads = cage(cells, bend)
    random = np.random.default_rng(3)
    points = oracles.single(
        np.concatenate([random.uniform(-0.8, 0.8, (300, 3)), vertices[:8], vertices[quads[:6]].mean(axis=1)])
    )
    points[:30, 2] = 0.4996  # where all patches of a flat side are for float64
    targets = random.normal(size=vertices.shape)
    rest = Cage(vertices, quads)
    positions = deform_points(points, rest, rest.with_vertices(targets), coordinates="mean_value", device=device)
    weights = weights_of(points, vertices, quads, device)
    assert np.abs(positions - weights @ targets).max() < 1e-5 * np.abs(weights).sum(axis=1).max()
