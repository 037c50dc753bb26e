"""Cages of many shapes come about whatever the last digits, the order of vertices, the turn and the machine.

At night each pair of a shape and a count is tried under each small change of its mesh; otherwise the
least count of two shapes in three is tried under one of them in turn, which takes half a minute. Distances are
measured on voxels four times as large as otherwise: that is quick, and harder for thin shapes.
"""

import numpy as np
import pytest
import trimesh
from test_cage_generation import winding

from warpcage import Cage
from warpcage.cage import generate
from warpcage.cage.generate import decimate, distance, fit, shell, voxel
from warpcage.mesh import queries, validity

#: Sizes of the noise on vertices, as shares of the object's size; each goes with a new order and another turn.
JITTERS = (1e-9, 1e-7, 1e-5)

COARSER = 4.0

make = trimesh.creation


def boxes(*bounds):
    return trimesh.util.concatenate([make.box(bounds=bound) for bound in bounds])


def sheet(height, size=17):
    """An open sheet z = height(x, y) over the square [-1, 1]^2."""
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, size)] * 2, indexing="ij")
    a = (np.arange(size - 1)[:, None] * size + np.arange(size - 1)).reshape(-1)
    faces = np.concatenate([np.stack([a, a + size, a + 1], axis=1), np.stack([a + 1, a + size, a + size + 1], axis=1)])
    vertices = np.stack([x, y, np.broadcast_to(height(x, y), x.shape)], axis=2).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)


def tube(path, radius, sides=8):
    """A closed tube along a closed path (n, 3)."""
    along = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    one = np.cross(along, [0.3, 0.5, 0.8])
    two = np.cross(along, one)
    one, two = (side / np.linalg.norm(side, axis=1, keepdims=True) for side in (one, two))
    angle = np.arange(sides) * 2.0 * np.pi / sides
    rings = path[:, None] + radius * (np.cos(angle)[:, None] * one[:, None] + np.sin(angle)[:, None] * two[:, None])
    i, j = (k.reshape(-1) for k in np.meshgrid(np.arange(len(path)), np.arange(sides), indexing="ij"))
    ahead, beside = (i + 1) % len(path), (j + 1) % sides
    a, b, c, d = i * sides + j, ahead * sides + j, ahead * sides + beside, i * sides + beside
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return trimesh.Trimesh(rings.reshape(-1, 3), faces, process=False)


def star(arms, seed=None):
    """A ball whose radius goes up and down with the direction, or, with a seed, at random."""
    ball = make.icosphere(subdivisions=3)
    x, y, z = ball.vertices.T
    if seed is None:
        radius = 0.6 + 0.4 * np.cos(arms * np.arctan2(y, x)) * (1.0 - z * z)
    else:
        waves = np.random.default_rng(seed).normal(size=(arms, 3)) * 3.0
        radius = 1.0 + 0.5 * np.sin(ball.vertices @ waves.T).mean(axis=1)
    return trimesh.Trimesh(ball.vertices * radius[:, None], ball.faces, process=False)


def knot(p=2, q=3):
    t = np.arange(120) * 2.0 * np.pi / 120
    ring = 2.0 + np.cos(q * t)
    return np.stack([ring * np.cos(p * t), ring * np.sin(p * t), np.sin(q * t)], axis=1)


def moved(mesh, *offset):
    return mesh.copy().apply_translation(offset)


def shapes():
    join, ball = trimesh.util.concatenate, make.icosphere(subdivisions=2)
    bowl = make.icosphere(subdivisions=3)
    bowl = trimesh.Trimesh(bowl.vertices, bowl.faces[bowl.triangles_center[:, 2] < 0.0], process=False)
    return {
        "plate": make.box([1, 1, 0.002]),
        "long plate": make.box([1, 0.3, 0.01]),
        "thick plate": make.box([1, 0.8, 0.1]),
        "cube": make.box(),
        "brick": make.box([1, 0.6, 0.3]),
        "rod": make.cylinder(0.01, 1.0, sections=8),
        "beam": make.box([1, 0.05, 0.05]),
        "L": boxes([[0, 0, 0], [1, 0.3, 0.3]], [[0, 0, 0], [0.3, 0.3, 1]]),
        "T": boxes([[-1, -0.2, 0.8], [1, 0.2, 1.1]], [[-0.2, -0.2, -1], [0.2, 0.2, 0.8]]),
        "U": boxes([[0, 0, 0], [1, 0.4, 0.2]], [[0, 0, 0], [0.2, 0.4, 1]], [[0.8, 0, 0], [1, 0.4, 1]]),
        "cross": boxes([[-1, -0.1, -0.1], [1, 0.1, 0.1]], [[-0.1, -1, -0.1], [0.1, 1, 0.1]],
                       [[-0.1, -0.1, -1], [0.1, 0.1, 1]]),
        "stairs": boxes(*[[[k, 0, 0], [k + 1, 2, k + 1]] for k in range(4)]),
        "torus": make.torus(1.0, 0.25),
        "thin torus": make.torus(1.0, 0.05),
        "sphere": make.icosphere(subdivisions=3),
        "egg": make.icosphere(subdivisions=3).apply_scale([1.0, 0.6, 0.4]),
        "cylinder": make.cylinder(0.5, 1.0, sections=16),
        "disc": make.cylinder(1.0, 0.02, sections=16),
        "pipe": make.annulus(0.8, 1.0, 1.5),
        "cone": make.cone(0.5, 1.0, sections=16),
        "needle": make.cone(0.05, 1.0, sections=8),
        "capsule": make.capsule(1.0, 0.3),
        "flat sheet": sheet(lambda x, y: 0.0 * x),
        "wave": sheet(lambda x, y: 0.3 * np.sin(3.0 * x) * np.cos(2.0 * y)),
        "saddle": sheet(lambda x, y: 0.5 * (x * x - y * y)),
        "bowl": bowl,
        "far apart": join(ball, moved(ball, 4, 0, 0)),
        "close by": join(ball, moved(ball, 2.1, 0, 0)),
        "two plates": join(make.box([1, 1, 0.01]), moved(make.box([1, 1, 0.01]), 0, 0, 0.4)),
        "ball and rod": join(ball, moved(make.cylinder(0.05, 2.0), 1.6, 0, 0)),
        "star of 5": star(5),
        "star of 3": star(3),
        "blob": star(12, seed=1),
        "other blob": star(20, seed=2),
        "knot": tube(knot(), 0.35),
        "thin knot": tube(knot(3, 2), 0.1),
    }  # fmt: skip


SHAPES = shapes()
#: Each shape with two small counts and, in turns, a third.
PAIRS = [(shape, count) for k, shape in enumerate(SHAPES) for count in (12, 30, (20, 60, 40, 100, 16, 200)[k % 6])]
#: A few of all by day.
CASES = [
    pytest.param(*pair, jitter, marks=() if k % 9 == 0 and k // 9 % 3 == j else pytest.mark.nightly)
    for k, pair in enumerate(PAIRS) for j, jitter in enumerate(JITTERS)
]  # fmt: skip


def varied(mesh, jitter, seed):
    """The mesh with noise on its vertices, in another order, and turned: by any angle, a right angle, or hardly."""
    random = np.random.default_rng(seed)
    vertices = mesh.vertices + jitter * np.ptp(mesh.vertices, axis=0).max() * random.uniform(-1, 1, mesh.vertices.shape)
    angle = (random.uniform(0.0, 2.0 * np.pi), 0.5 * np.pi, 1e-8)[seed % 3]
    turn = trimesh.transformations.rotation_matrix(angle, random.normal(size=3) if seed % 3 == 0 else [0, 0, 1])
    order = random.permutation(len(vertices))
    place = np.argsort(order)
    faces = random.permutation(place[mesh.faces])
    return trimesh.Trimesh(vertices[order] @ turn[:3, :3].T, faces, process=False)


def coarsen(monkeypatch):
    fine = generate.voxel_spacing
    monkeypatch.setattr(generate, "voxel_spacing", lambda extent, count: COARSER * fine(extent, count))


def assert_holds(cage, mesh, count):
    report = cage.check()
    assert report.usable and report.intersecting_faces == () and report.unused_vertices == ()
    assert report.open_edges == () and report.crowded_edges == () and report.pinched_vertices == ()
    assert abs(report.vertex_count - count) <= 0.1 * count
    vertices = np.asarray(mesh.vertices)
    points = np.concatenate([vertices[:: max(len(vertices) // 150, 1)], mesh.sample(150, seed=0)])
    assert (winding(points, cage.vertices, cage.faces) > 0.99).all()


@pytest.mark.parametrize(("shape", "count", "jitter"), CASES)
def test_a_small_change_of_the_mesh_costs_no_cage(shape, count, jitter, monkeypatch):
    coarsen(monkeypatch)
    pair = PAIRS.index((shape, count))
    mesh = varied(SHAPES[shape], jitter, 10 * pair + JITTERS.index(jitter) + pair // 9)
    assert_holds(Cage.from_mesh(mesh, count, method=("shell", "shell", "auto")[pair % 3]), mesh, count)


def test_there_are_a_hundred_pairs_of_a_shape_and_a_count():
    assert len(set(PAIRS)) >= 100


class Perturbed:
    """NumPy, or a part of it, whose products come out a last digit higher or lower, or as they are, at random."""

    def __init__(self, numpy, names, random):
        self.wrapped, self.changed, self.generator = numpy, names, random

    def __getattr__(self, name):
        value = getattr(self.wrapped, name)
        if name == "linalg":
            return Perturbed(value, self.changed, self.generator)
        return self.perturbing(value) if name in self.changed else value

    def perturbing(self, product):
        def nudged(x):
            x = np.asarray(x)
            if x.dtype != np.float64:
                return x
            return np.nextafter(x, x + self.generator.integers(-1, 2, x.shape) * np.abs(x))  # a zero stays

        def perturbed(*args, **kwargs):
            result = product(*args, **kwargs)
            return tuple(map(nudged, result)) if isinstance(result, tuple) else nudged(result)

        return perturbed


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in range(1, 10))])
@pytest.mark.parametrize(
    ("shape", "count", "method"),
    [("plate", 60, "shell"), ("plate", 60, "voxel"), ("cube", 12, "voxel"), ("star of 3", 20, "shell")],
)
def test_last_digits_of_products_cost_no_cage(shape, count, method, seed, monkeypatch):
    coarsen(monkeypatch)
    products = ("einsum", "cross", "matmul", "dot", "norm", "solve", "eigh", "svd", "det")
    numpy = Perturbed(np, products, np.random.default_rng(seed))
    for module in (decimate, distance, fit, generate, queries, shell, validity, voxel):
        monkeypatch.setattr(module, "np", numpy)
    cage = Cage.from_mesh(SHAPES[shape], count, method=method)
    monkeypatch.undo()
    assert_holds(cage, SHAPES[shape], count)


def test_equal_spreads_take_the_axes_of_the_world():
    random = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    for scale in ([1, 1, 1], [1, 1, 0.01], [0.1, 1, 1], [1, 0.2, 1]):
        frame = voxel.principal_frame(grid * scale + 1e-9 * random.normal(size=grid.shape))
        assert np.allclose(frame, np.eye(3), atol=1e-6)
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.5, 0.8]))[:3, :3]
    frame = voxel.principal_frame(grid * [1.0, 0.6, 0.3] @ turn.T)
    assert np.allclose(np.sort(np.abs(frame.T @ turn), axis=1), [0, 0, 1], atol=1e-9)
    assert np.linalg.det(frame) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [8, 9, 31, 200])
def test_the_last_resort_is_a_box_of_the_count(count):
    points = np.random.default_rng(0).normal(size=(50, 3)) * [1.0, 0.2, 0.01]
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    cage = Cage(*shell.split_box(bounds, 0.1, count))
    report = cage.check()
    assert report.usable and report.vertex_count == count and report.intersecting_faces == ()
    assert cage.volume == pytest.approx(np.prod(np.ptp(points, axis=0) + 0.2))
    assert (winding(points, cage.vertices, cage.faces) > 0.99).all()


def test_where_all_attempts_fail_the_box_is_drawn_close(monkeypatch):
    coarsen(monkeypatch)
    monkeypatch.setattr(shell, "progressive_hull", lambda vertices, faces, *_: (vertices, faces))
    monkeypatch.setattr(shell, "CLOSINGS", (5.0,))
    assert_holds(Cage.from_mesh(SHAPES["U"], 16, method="shell"), SHAPES["U"], 16)


def test_thin_objects_need_no_margin(monkeypatch):
    coarsen(monkeypatch)
    for shape in ("flat sheet", "needle"):
        assert_holds(Cage.from_mesh(SHAPES[shape], 20, margin=0.0, method="shell"), SHAPES[shape], 20)
