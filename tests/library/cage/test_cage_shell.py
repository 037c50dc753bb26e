"""What cage generation asks of kernels, against SciPy, which they stand for."""

import platform

import numpy as np
import pytest
import scipy.ndimage
import scipy.spatial
import trimesh

from warpcage.cage import NearestInTree, NearestInVoxels, ObjectShell, face_samples, points_on, sample_weights
from warpcage.core import limit_threads


def same(found, expected):
    """To the last bit where SciPy's own code does not fuse products and sums, as its wheels for x86 do not."""
    if platform.machine() in ("x86_64", "AMD64"):
        return np.array_equal(found, expected)
    return np.allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def shell():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return ObjectShell(np.asarray(mesh.vertices), 0.11, 0.4, 0.2)


def places(shell, count=20_000):
    """Points in the grid and beyond it, the first of them on its nodes and in its first cells."""
    random = np.random.default_rng(0)
    places = random.uniform(-4, np.array(shell.solid.shape) + 4, (count, 3))
    places[:500] = np.round(places[:500])
    places[500:1000] = random.uniform(-1, 1, (500, 3))
    return shell.lower + places * shell.spacing


def looked_up(shell, volume, x):
    grid = np.moveaxis((x - shell.lower) / shell.spacing, -1, 0)
    return scipy.ndimage.map_coordinates(volume, grid, order=1, mode="nearest")


@pytest.mark.parametrize("threads", [1, 2])
def test_distances_are_looked_up_as_scipy_does(shell, threads):
    x = places(shell)
    with limit_threads(threads):
        assert same(shell.closed_distance(x), looked_up(shell, shell.closed, x))
    assert shell.closed_distance(x.reshape(-1, 4, 3)).shape == (5000, 4)


def test_directions_are_those_of_the_slope(shell):
    x = places(shell)
    slope = np.stack([looked_up(shell, each, x) for each in np.gradient(shell.smooth, shell.spacing)], axis=-1)
    length = np.linalg.norm(slope, axis=-1, keepdims=True)
    expected = np.where(length > 1e-6, slope / np.maximum(length, 1e-6), 0.0)
    assert same(shell.outward(x), expected)
    assert (expected == 0.0).all(axis=1).any() and (expected != 0.0).any()  # flat beyond the grid's corners


def test_samples_of_faces_are_where_their_points_are(shell):
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=1.3)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    samples, weights = face_samples(vertices, faces, 7)
    assert weights is sample_weights(7) and weights.shape == (36, 3) and np.allclose(weights.sum(axis=1), 1.0)
    assert np.array_equal(samples[:, 3], points_on(vertices, faces, np.broadcast_to(weights[3], (len(faces), 3))))
    found = shell.closed_distance_on_faces(vertices, faces, weights)
    assert same(found, looked_up(shell, shell.closed, samples))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("about", [1e-3, 0.1, 2.0])
def test_nearest_points_are_those_of_a_tree(about, threads):
    """Wherever the search begins: too near, about right, too far."""
    random = np.random.default_rng(0)
    points = random.normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True) * random.uniform(1.0, 1.1, (3000, 1))
    spacing = 0.1
    lower = points.min(axis=0) - 3.0 * spacing
    cell = np.floor((points - lower) / spacing + 0.5).astype(np.int64)
    shape = tuple((cell.max(axis=0) + 4).tolist())
    search = NearestInVoxels(points, np.ravel_multi_index(tuple(cell.T), shape), shape, lower, spacing)
    x = random.uniform(-1.6, 1.6, (2000, 3))  # beyond the grid, too
    x[:100] = points[:100]
    reach = np.full(len(x), about)
    with limit_threads(threads):
        found = search.distance(x, reach)
    expected = NearestInTree(points).distance(x, reach)
    assert same(found, expected) and (found[:100] == 0.0).all()
    # with an end to the search: the same up to there, anything more beyond
    for other in (search, NearestInTree(points)):
        ended, within = other.distance(x, reach, 0.3), expected < 0.3
        assert same(ended[within], expected[within]) and (ended[~within] >= 0.3).all() and 200 < within.sum() < 1900
    one = np.linalg.norm(points[None] - x[200:220, None], axis=2).min(axis=1)
    assert np.allclose(found[200:220], one, rtol=1e-14)
