"""What cage generation asks of kernels, against SciPy and NumPy, which they stand for."""

import platform

import numpy as np
import pytest
import scipy.ndimage
import scipy.spatial
import trimesh
from test_cage_generation import winding

from warpcage import Cage
from warpcage.cage import (
    HeldFaces,
    NearestInTree,
    NearestInVoxels,
    ObjectShell,
    ObjectVoxels,
    crossings,
    face_samples,
    surface_points,
)
from warpcage.core import limit_threads


def same(found, expected):
    """To the last bit where SciPy's own code does not fuse products and sums, as its wheels for x86 do not."""
    if platform.machine() in ("x86_64", "AMD64"):
        return np.array_equal(found, expected)
    return np.allclose(found, expected, rtol=1e-12, atol=1e-12)


@pytest.fixture(scope="module")
def shell():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    return ObjectShell(ObjectVoxels(np.asarray(mesh.vertices), 0.11, 0.2), 0.4)


def places(shell, count=20_000):
    """Points in the grid and beyond it, the first of them on its nodes and in its first cells."""
    random = np.random.default_rng(0)
    places = random.uniform(-4, np.array(shell.closed.shape) + 4, (count, 3))
    places[:500] = np.round(places[:500])
    places[500:1000] = random.uniform(-1, 1, (500, 3))
    return shell.lower + places * shell.spacing


def looked_up(shell, volume, x):
    grid = np.moveaxis((x - shell.lower) / shell.spacing, -1, 0)
    return scipy.ndimage.map_coordinates(volume, grid, order=1, mode="nearest")


def away(shell, x):
    """Directions of the slope and whether they are far from where it is too flat to have one."""
    slope = np.stack([looked_up(shell, each, x) for each in np.gradient(shell.smooth, shell.spacing)], axis=-1)
    length = np.linalg.norm(slope, axis=-1, keepdims=True)
    return np.where(length > 1e-6, slope / np.maximum(length, 1e-6), 0.0), ~((length > 1e-9) & (length < 1e-3))[..., 0]


def ball(radius, subdivisions=1):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces)


@pytest.mark.parametrize("threads", [1, 2])
def test_distances_on_faces_are_those_of_scipy(shell, threads):
    corners = places(shell)[:3000]
    with limit_threads(threads):
        found = shell.distance_on_faces(corners, np.arange(3000).reshape(-1, 3), 7)
    samples, weights = face_samples(corners, np.arange(3000).reshape(-1, 3), 7)
    assert weights.shape == (36, 3) and np.allclose(weights.sum(axis=1), 1.0)
    assert np.allclose(found, looked_up(shell, shell.closed, samples), atol=2e-6)


def test_directions_are_those_of_the_slope(shell):
    x = places(shell)
    expected, clear = away(shell, x)
    found = shell.outward(x)
    assert np.allclose(found[clear], expected[clear], atol=1e-3) and clear.mean() > 0.8
    assert (found == 0.0).all(axis=1).any() and (found != 0.0).any()  # flat beyond the grid's corners


def test_near_samples_are_all_that_are_nearer_to_the_points_and_few_others(shell):
    vertices, faces = ball(1.25)
    random = np.random.default_rng(1)
    pieces, levels = random.integers(1, 30, len(faces)).astype(np.int32), random.uniform(0.1, 0.4, len(faces))
    counts, found, distances = shell.near_samples(vertices, faces, pieces, levels)
    assert np.allclose(distances, looked_up(shell, shell.closed, found), atol=2e-6) and counts.sum() == len(found)
    tree, listed, others = (
        scipy.spatial.KDTree(shell.voxels.points),
        np.split(found, np.cumsum(counts)[:-1]),
        np.zeros(2),
    )
    for face, piece, level, near in zip(faces, pieces, levels, listed, strict=True):
        samples = face_samples(vertices, face[None], int(piece))[0][0]
        distance, about = tree.query(samples)[0], looked_up(shell, shell.closed, samples)
        own = scipy.spatial.KDTree(near if len(near) else [[9.0] * 3]).query(samples)[0] < 1e-9
        assert own[distance < level].all() and not own[about > level + 0.5 * shell.spacing + 1e-5].any()
        off = distance > level + 0.2 * shell.spacing
        others += np.count_nonzero(own & off), np.count_nonzero(off & (about < level + 0.5 * shell.spacing))
    assert 0 < others[0] < 0.5 * others[1]


def contacts_in_numpy(shell, vertices, faces, pieces, levels, need, softness):
    """Push and slope of each vertex, and the most that a face is short, sample by sample."""
    total, weight, slope = np.zeros_like(vertices), np.zeros(len(vertices)), np.zeros_like(vertices)
    worst = -np.inf
    for face, piece, level in zip(faces, pieces, levels, strict=True):
        a, b, c = corners = vertices[face]
        cross = np.cross(b - a, c - a)
        samples, weights = face_samples(corners, np.array([[0, 1, 2]]), int(piece))
        distance = looked_up(shell, shell.closed, samples[0])
        worst = max(worst, float((level - distance).max()))
        low = distance < level
        out, load = away(shell, samples[0])[0], np.zeros((3, 3))
        for w, d, direction in zip(weights[low], distance[low], out[low], strict=True):
            share = np.clip(d / (0.5 * need), 0.0, 1.0)
            direction = share * direction + (1.0 - share) * cross / np.linalg.norm(cross)
            move = (level - d) * direction / np.linalg.norm(direction)
            urgency = w * (level - d)
            np.add.at(total, face, (urgency * w / (w @ w))[:, None] * move)
            np.add.at(weight, face, urgency)
            load += w[:, None] * move
        area = 0.5 * np.linalg.norm(cross)
        np.add.at(slope, face, cross / 6.0 - area / (softness * max(low.sum(), 1)) * load)
    return vertices + total / np.where(weight > 0.0, weight, 1.0)[:, None], slope, worst


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("radius", [0.9, 1.2, 1.35])
def test_faces_are_pushed_as_by_numpy(shell, radius, threads):
    """Through the object, where faces look; near it; hardly at all."""
    vertices, faces = ball(radius)
    random = np.random.default_rng(2)
    pieces, levels = random.integers(2, 12, len(faces)).astype(np.int32), random.uniform(0.15, 0.25, len(faces))
    with limit_threads(threads):
        held = HeldFaces(shell, vertices, faces, 0.2)
        held.ask(pieces, levels)
        worst = held.touch()
        held.push()
    expected, _, most = contacts_in_numpy(shell, vertices, faces, pieces, levels, 0.2, 1.0)
    assert (worst == pytest.approx(most, abs=1e-5)) if most > 0.0 else worst <= 0.0
    assert np.allclose(held.vertices, expected, atol=2e-4)
    assert (np.abs(expected - vertices).max() > 1e-3) == (radius < 1.3)
    # faces that did not move keep what was found, of others the samples that may be short are measured again
    for far in (0.0, 1e-3, 3e-3, 1e-2, 3e-3, 0.1):
        held.vertices[: len(vertices) // 2] += random.normal(size=(len(vertices) // 2, 3)) * far
        again = HeldFaces(shell, held.vertices, faces, 0.2)
        again.ask(pieces, levels)
        assert max(held.touch(), 0.0) == pytest.approx(max(again.touch(), 0.0), abs=1e-12)
        held.push()
        again.push()
        assert np.allclose(held.vertices, again.vertices, atol=1e-12)


def test_a_step_goes_down_the_slope_of_volume_and_load(shell):
    vertices, faces = ball(1.2)
    pieces, levels = np.full(len(faces), 6, np.int32), np.full(len(faces), 0.2)
    held = HeldFaces(shell, vertices, faces, 0.2)
    held.ask(pieces, levels, 0.05)
    held.touch()
    held.descend(0, 0.01)
    pushed, slope, _ = contacts_in_numpy(shell, vertices, faces, pieces, levels, 0.2, 0.05)
    corners = vertices[faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    slope *= len(vertices) / area  # in the first round Adam's means are the slope and its square
    step = 0.01 * slope / (np.linalg.norm(slope, axis=1, keepdims=True) + 0.05)
    assert np.allclose(held.vertices, pushed - step, atol=2e-4) and np.linalg.norm(step, axis=1).min() > 1e-3


def test_smoothing_stays_along_the_surface(shell):
    vertices, faces = ball(1.2)
    vertices *= np.random.default_rng(3).uniform(0.9, 1.1, (len(vertices), 1))
    held = HeldFaces(shell, vertices, faces, 0.2)
    held.smooth(0.3)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mean = np.array([vertices[near].mean(axis=0) for near in mesh.vertex_neighbors])
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], mesh.face_normals * mesh.area_faces[:, None])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    step = 0.3 * (mean - vertices)
    assert np.allclose(held.vertices, vertices + step - (step * normals).sum(axis=1, keepdims=True) * normals)


def test_vertices_far_off_go_inward_too(shell):
    vertices, faces = ball(1.3)
    vertices[0] *= 1.2  # a spike
    held = [HeldFaces(shell, vertices, faces, 0.2) for _ in range(2)]
    held[0].smooth(0.0, 0.35, 0.3)
    held[1].smooth(0.0)
    off = looked_up(shell, shell.closed, vertices)
    assert off[0] > 0.35 > off[1:].max()
    moved = np.linalg.norm(held[0].vertices - vertices, axis=1) > 0.0
    assert moved[0] and not moved[1:].any() and np.allclose(held[1].vertices, vertices)
    assert looked_up(shell, shell.closed, held[0].vertices[:1])[0] < off[0]


def test_points_cover_narrow_faces_with_fewer():
    """Within 1 / sqrt(3) of the spacing, as regular grids are, whichever side of the face is the short one."""
    random, spacing = np.random.default_rng(5), 0.1
    corners = random.normal(size=(60, 3, 3)) * 2.0
    for k, corner in enumerate(corners):
        corner[k % 3] = corner[(k + 1) % 3] + random.normal(size=3) * 10.0 ** random.uniform(-5, -2)
    vertices, faces = corners.reshape(-1, 3), np.arange(180).reshape(-1, 3)
    points = np.concatenate([vertices, surface_points(vertices, faces, spacing)])
    places = np.einsum("nk,fki->fni", random.dirichlet([1.0, 1.0, 1.0], 500), corners).reshape(-1, 3)
    assert scipy.spatial.KDTree(points).query(places)[0].max() < spacing / np.sqrt(3.0)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    assert len(points) < 10 * (longest / spacing).sum() < 0.5 * ((longest / spacing) ** 2).sum()


def test_crossings_of_rays_are_winding_numbers():
    torus = trimesh.creation.torus(1.0, 0.3, major_sections=16, minor_sections=8)
    inner, outer = ball(0.2), ball(0.9, 0)
    vertices = np.concatenate([torus.vertices, outer[0] + [0, 0, 2], inner[0] + [0, 0, 2]])
    first, second = len(torus.vertices), len(torus.vertices) + len(outer[0])
    faces = np.concatenate([torus.faces, outer[1] + first, inner[1] + second])  # the two balls wind alike: 2 within
    random = np.random.default_rng(4)
    points = random.uniform(vertices.min(axis=0) - 0.1, vertices.max(axis=0) + 0.1, (3000, 3))
    points[:300] = points[:300].round(1)  # in rows, and below corners
    points[300:400] = random.normal(size=(100, 3)) * 0.05 + [0, 0, 2]
    assert Cage(vertices, faces).topology.closed
    expected = np.round(winding(points, vertices, faces))
    assert np.array_equal(crossings(points, vertices, faces), expected) and {0, 1, 2} <= set(expected)


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
