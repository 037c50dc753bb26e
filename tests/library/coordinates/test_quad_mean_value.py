"""Mean value coordinates of cages of bilinear quads, against quadrature of their definition in float64."""

import numpy as np
import oracles
import pytest
import warp as wp

from warpcage.coordinates.quad_mean_value import QuadFaces, quad_mean_value_weights
from warpcage.core import launch
from warpcage.kernels.coordinates.quad_mean_value import map_quad_mean_value

#: Cells along an edge of a cube, and by what of their side vertices are off: planar, bent, and many quads.
some_cages = pytest.mark.parametrize("cells, bend", [(1, 0.0), (1, 0.2), (2, 0.2), (4, 0.15)])


def cage(cells, bend):
    vertices, quads = oracles.quad_cage(cells, bend)
    return oracles.single(vertices), quads


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
    weights = quad_mean_value_weights(points, vertices, quads, device)
    assert error_to(weights, oracles.quad_mean_value_weights(points, vertices, quads)) < 3e-6
    assert np.abs(weights @ vertices - points).max() < 1e-6 and np.abs(weights.sum(axis=1) - 1).max() < 1e-6


@pytest.mark.parametrize("height", [1e-1, 1e-2, 1e-3, 1e-5])
@some_cages
def test_weights_hold_up_to_the_patches(cells, bend, height, device):
    vertices, quads = cage(cells, bend)
    for side in (1, -1):
        places, normals, _ = oracles.on_quads(vertices, quads, 30)
        points = oracles.single(places - side * height * normals)
        wanted = oracles.quad_mean_value_weights(points, vertices, quads)
        assert error_to(quad_mean_value_weights(points, vertices, quads, device), wanted) < 3e-6


@pytest.mark.parametrize("distance", [0.0, 1e-7, 9e-7])
@some_cages
def test_on_the_patches_weights_are_bilinear(cells, bend, distance, device):
    vertices, quads = cage(cells, bend)
    places, normals, wanted = oracles.on_quads(vertices, quads, 200)
    weights = quad_mean_value_weights(places - distance * normals, vertices, quads, device)
    assert error_to(weights, wanted) < 1e-6 + 20 * cells * distance
    edges = np.concatenate([quads[:, [k, (k + 1) % 4]] for k in range(4)])
    for share in (0.0, 0.5, 0.9):
        points = (1 - share) * vertices[edges[:, 0]] + share * vertices[edges[:, 1]]
        wanted = (1 - share) * np.eye(len(vertices))[edges[:, 0]] + share * np.eye(len(vertices))[edges[:, 1]]
        assert error_to(quad_mean_value_weights(points, vertices, quads, device), wanted) < 2e-6


def test_sheared_and_bent_patches(device):
    """Quads of all shapes around the origin: long, with acute corners, strongly bent."""
    vertices, quads = oracles.quad_cage(2, 0.0)
    vertices = oracles.single(vertices @ [[3.0, 0.8, 0], [0, 0.4, 0.3], [0, 0, 1]] + 0.15 * vertices[:, [1, 2, 0]] ** 2)
    places, normals, _ = oracles.on_quads(vertices, quads, 40)
    for height in (1e-1, 1e-2, 1e-4):
        points = oracles.single(places - height * normals)
        wanted = oracles.quad_mean_value_weights(points, vertices, quads)
        assert error_to(quad_mean_value_weights(points, vertices, quads, device), wanted) < 1e-5


@pytest.mark.parametrize("distance", [0.9, 3.0, 30.0, 900.0])
@some_cages
def test_points_outside_follow_the_formula(cells, bend, distance, device):
    vertices, quads = cage(cells, bend)
    points = np.random.default_rng(0).normal(size=(50, 3))
    points = oracles.single(distance * points / np.linalg.norm(points, axis=1, keepdims=True))
    wanted = oracles.quad_mean_value_weights(points, vertices, quads)
    weights = quad_mean_value_weights(points, vertices, quads, device)
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
    assert error_to(quad_mean_value_weights(points, vertices, quads, device), wanted) < 1e-5


# -- Faces of all kinds


def test_mirrored_poses_of_a_cube_agree(device):
    """Each corner of the top lifted by one in turn: the middle below the top rises by the same."""
    vertices, quads = oracles.quad_cage(1, 0.0)
    weights = quad_mean_value_weights([[0, 0, 0.45]], vertices, quads, device)[0]
    top = np.flatnonzero(vertices[:, 2] > 0)
    assert np.ptp(weights[top]) < 1e-6 and 0.2 < weights[top].mean() < 0.25


def test_turned_quads_weigh_the_same(device):
    """Which corner a face begins with does not matter."""
    vertices, quads = cage(2, 0.2)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (200, 3))
    wanted = quad_mean_value_weights(points, vertices, quads, device)
    for turn in (1, 2, 3):
        assert error_to(quad_mean_value_weights(points, vertices, np.roll(quads, turn, axis=1), device), wanted) < 3e-6


def test_triangles_weigh_as_in_triangle_cages(device):
    vertices, quads = cage(2, 0.2)
    triangles = cut(quads)
    points = oracles.single(np.random.default_rng(1).uniform(-0.4, 0.4, (200, 3)))
    wanted = oracles.mean_value_weights(points, vertices, triangles)
    assert error_to(quad_mean_value_weights(points, vertices, triangles, device), wanted) < 3e-6
    places = vertices[triangles[:20]].mean(axis=1)
    on = np.zeros((20, len(vertices)))
    on[np.arange(20)[:, None], triangles[:20]] = 1 / 3
    assert error_to(quad_mean_value_weights(places, vertices, triangles, device), on) < 1e-6


def test_polygons_weigh_as_fans_around_their_middle(device):
    """A prism over a hexagon that is not planar: two polygons of six corners and six quads."""
    angles = np.arange(6) * np.pi / 3
    ring = np.stack([np.cos(angles), np.sin(angles), 0.1 * np.cos(3 * angles)], axis=1)
    vertices = np.concatenate([ring - [0, 0, 0.7], ring + [0, 0, 0.7]])
    after = (np.arange(6) + 1) % 6
    sides = np.stack([np.arange(6), after, after + 6, np.arange(6) + 6], axis=1)
    polygons = [*sides.tolist(), list(range(6, 12)), list(range(5, -1, -1))]
    points = oracles.single(np.random.default_rng(1).uniform(-0.5, 0.5, (100, 3)))
    weights = quad_mean_value_weights(points, vertices, polygons, device)
    middles = np.concatenate([vertices, vertices[6:].mean(axis=0)[None], vertices[:6].mean(axis=0)[None]])
    fans = [[a + 6, b + 6, 12] for a, b in zip(range(6), after, strict=True)] + [
        [b, a, 13] for a, b in zip(range(6), after, strict=True)
    ]
    wanted = quad_mean_value_weights(points, middles, [*sides.tolist(), *fans], device)
    wanted[:, 6:12] += wanted[:, 12:13] / 6
    wanted[:, :6] += wanted[:, 13:] / 6
    assert error_to(weights, wanted[:, :12]) < 1e-6 and np.abs(weights @ vertices - points).max() < 2e-6
    middle = quad_mean_value_weights([[0, 0, 0.2]], vertices, polygons, device)[0]
    assert np.ptp(middle.reshape(2, 3, 2), axis=1).max() < 1e-6  # the prism turned by a third is itself


def test_faces_without_area_give_nothing(device):
    vertices, quads = cage(2, 0.2)
    points = np.random.default_rng(1).uniform(-0.4, 0.4, (50, 3))
    more = [*quads.tolist(), [0, 1, 1, 0], [2, 2, 2, 2], [3, 4, 4]]
    weights = quad_mean_value_weights(points, vertices, more, device)
    assert error_to(weights, quad_mean_value_weights(points, vertices, quads, device)) < 1e-6


def test_scale_and_place_do_not_matter(device):
    vertices, quads = cage(2, 0.2)
    points = oracles.single(np.random.default_rng(1).uniform(-0.4, 0.4, (100, 3)))
    wanted = quad_mean_value_weights(points, vertices, quads, device)
    for scale, off in ((1e-4, 0.0), (1e4, 0.0), (3.0, 1e3)):
        weights = quad_mean_value_weights(points * scale + off, vertices * scale + off, quads, device)
        assert error_to(weights, wanted) < 2e-6


# -- Maps


@pytest.mark.parametrize("cells, bend", [(1, 0.2), (2, 0.2), (4, 0.15), (6, 0.0)])
def test_map_is_the_weighted_sum(cells, bend, device):
    """In another unit than weights, as on lattices."""
    vertices, quads = cage(cells, bend)
    random = np.random.default_rng(3)
    points = oracles.single(
        np.concatenate([random.uniform(-0.8, 0.8, (300, 3)), vertices[:8], vertices[quads[:6]].mean(axis=1)])
    )
    points[:30, 2] = 0.4996  # where all patches of a flat side are for float64
    targets = random.normal(size=vertices.shape)
    near = [wp.array(100 * each, dtype=wp.vec3, device=device) for each in (points, vertices)]
    faces = QuadFaces(len(vertices), quads)
    inputs = [*near, *faces.prepared(near[1], 100.0), wp.array(targets, dtype=wp.vec3, device=device), 100.0]
    positions = wp.empty_like(near[0])
    launch(map_quad_mean_value, len(points), inputs, [positions], device=device)
    weights = quad_mean_value_weights(points, vertices, quads, device)
    assert np.abs(positions.numpy() - weights @ targets).max() < 1e-5 * np.abs(weights).sum(axis=1).max()
