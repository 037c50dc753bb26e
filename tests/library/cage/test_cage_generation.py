import subprocess
import sys

import numpy as np
import pytest
import trimesh
from fields import GridField, ball_densities, nodes
from refusals import refused

from warpcage import Cage
from warpcage.cage import distance_to
from warpcage.cage.generate.shell import decimated
from warpcage.select import visible_nodes


def winding(points, vertices, faces):
    """Winding number by the sum of solid angles, one point at a time: an oracle of its own."""
    result = []
    for x in points:
        a, b, c = (vertices[faces[:, k]] - x for k in range(3))
        la, lb, lc = (np.sqrt((s * s).sum(axis=1)) for s in (a, b, c))
        numerator = np.linalg.det(np.stack([a, b, c], axis=1))
        denominator = la * lb * lc + (a * b).sum(axis=1) * lc + (b * c).sum(axis=1) * la + (c * a).sum(axis=1) * lb
        result.append(np.arctan2(numerator, denominator).sum() / (2 * np.pi))
    return np.array(result)


def join(*meshes):
    return trimesh.util.concatenate(meshes)


def shapes():
    make = trimesh.creation
    return {
        "sphere": make.icosphere(subdivisions=3),
        "L": join(make.box(bounds=[[0, 0, 0], [1, 0.3, 0.3]]), make.box(bounds=[[0, 0, 0], [0.3, 0.3, 1]])),
        "torus": make.torus(1.0, 0.25),
        "rod": make.cylinder(0.01, 1.0),
        "plate": make.box([1, 1, 0.002]),
        "far apart": join(make.icosphere(), make.icosphere().apply_translation([4, 0, 0])),
        "close by": join(make.icosphere(), make.icosphere().apply_translation([2.1, 0, 0])),
    }


@pytest.mark.parametrize(
    ("shape", "count"),
    [("sphere", 30), ("L", 50), ("torus", 60), ("rod", 40), ("plate", 60),
     ("far apart", 60), pytest.param("close by", 60, marks=pytest.mark.nightly)],
)  # fmt: skip
def test_cages_of_meshes_enclose_and_are_clean(shape, count):
    mesh = shapes()[shape]
    cage = Cage.from_mesh(mesh, count, method="shell" if shape in ("L", "torus", "plate") else "auto")
    report = cage.check()
    assert report.usable and report.intersecting_faces == () and report.unused_vertices == ()
    assert abs(report.vertex_count - count) <= 0.1 * count
    assert report.part_count == (2 if shape == "far apart" else 1)
    assert report.genus == (1 if shape == "torus" else 0)
    points = np.concatenate([mesh.vertices[:300], mesh.sample(300, seed=0)])
    assert (winding(points, cage.vertices, cage.faces) > 0.99).all()
    # the margin of 1 % of the size is kept, also by the middles of faces
    samples = cage.vertices[cage.faces].mean(axis=1)
    assert trimesh.proximity.closest_point_naive(mesh, samples)[1].min() >= 0.01 * np.ptp(mesh.vertices, axis=0).max()


def test_a_cage_of_a_ball_is_tight_and_even():
    mesh = shapes()["sphere"]
    cage = Cage.from_mesh(mesh, 100, method="shell")
    assert cage.volume < 1.2 * mesh.volume
    sides = np.linalg.norm(cage.vertices[cage.edges[:, 0]] - cage.vertices[cage.edges[:, 1]], axis=1)
    assert sides.max() < 3.0 * sides.min()


def two_arms():
    """A body with thin arms at its sides, which spikes of little volume would stand off from."""
    make, turned = trimesh.creation, trimesh.transformations.rotation_matrix
    parts = [make.capsule(1.2, 0.35)]
    for side in (-1, 1):
        arm = make.capsule(1.0, 0.1).apply_transform(turned(0.25 * side, [0, 1, 0]))
        shoulder = make.capsule(0.3, 0.1).apply_transform(turned(np.pi / 2, [0, 1, 0]))
        parts.append(arm.apply_translation([0.62 * side, 0, 0.1]))
        parts.append(shoulder.apply_translation([0.3 * side - 0.15, 0, 1.2]))
    return join(*parts)


@pytest.mark.parametrize("count", [42, pytest.param(100, marks=pytest.mark.nightly)])
def test_no_vertex_stands_far_off(count):
    mesh = two_arms()
    cage = Cage.from_mesh(mesh, count, method="shell")
    corners = cage.vertices[cage.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    points = np.concatenate([mesh.vertices, mesh.sample(3000, seed=0)])
    off = np.linalg.norm(points[None] - cage.vertices[:, None], axis=2).min(axis=1)
    assert off.max() < 0.6 * np.sqrt(area / count)  # 0.76 before vertices were drawn in


def test_an_open_pot_is_filled():
    pot = trimesh.creation.icosphere(subdivisions=3)
    pot = trimesh.Trimesh(pot.vertices, pot.faces[pot.triangles_center[:, 2] < 0.95], process=False)  # a hole on top
    cage = Cage.from_mesh(pot, 60, method="shell")
    assert cage.topology.part_count == 1 and cage.volume > 4.0


def test_the_same_mesh_gives_the_same_cage_at_any_place_and_scale():
    mesh = shapes()["L"]
    one, two = (Cage.from_mesh(mesh, 50, method="shell") for _ in range(2))
    assert np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)
    moved = trimesh.Trimesh(np.asarray(mesh.vertices) * 1e3 + 5e4, mesh.faces, process=False)
    far = Cage.from_mesh(moved, 50, method="shell")
    assert far.check(mesh=moved).mesh_enclosed == 1.0 and far.volume == pytest.approx(1e9 * one.volume, rel=0.05)


def test_earlier_calls_of_pymeshlab_do_not_change_a_cage():
    """What is left out in a call of it is taken from the one before."""
    pymeshlab, ball = pytest.importorskip("pymeshlab"), trimesh.creation.icosphere(subdivisions=3)
    first, _ = decimated(ball.vertices, ball.faces, 100)
    meshes = pymeshlab.MeshSet(verbose=False)
    meshes.add_mesh(pymeshlab.Mesh(ball.vertices, ball.faces))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=100, optimalplacement=False, qualityweight=True, preserveboundary=True, boundaryweight=9.0
    )
    again, _ = decimated(ball.vertices, ball.faces, 100)
    np.testing.assert_array_equal(again, first)


def test_a_wider_margin_is_kept():
    mesh = shapes()["sphere"]
    cage = Cage.from_mesh(mesh, 60, margin=0.4, method="shell")
    samples = np.einsum("sk,fki->fsi", np.random.default_rng(0).dirichlet([1, 1, 1], 50), cage.vertices[cage.faces])
    assert np.linalg.norm(samples.reshape(-1, 3), axis=1).min() >= 1.4


@pytest.mark.parametrize("recorded", [False, True])
def test_cages_of_fields_enclose_every_visible_node(recorded):
    density = ball_densities(32).astype(np.float32)
    density[np.abs(nodes(32)[..., 0] - 0.1) > 0.9] = 0.002  # haze too thin to see
    weights = np.where(density > 1.0, 0.5, 0.001).astype(np.float32) if recorded else None
    field = GridField(density, weights=weights)
    cage = Cage.from_field(field, 60, method="shell" if recorded else "voxel")
    visible = np.argwhere(density > 1.0)
    centers = field.bounds[0] + (visible + 0.5) * field.voxel_size
    assert abs(len(cage.vertices) - 60) <= 6
    assert (winding(centers[:: len(centers) // 500], cage.vertices, cage.faces) > 0.99).all()
    assert cage.check(field=field).field_enclosed == 1.0
    haze = field.bounds[0] + (np.argwhere(density == np.float32(0.002)) + 0.5) * field.voxel_size
    assert len(haze) > 1000 and cage.contains(haze).mean() < 0.05
    # a voxel of room around the boxes of the visible voxels
    samples = np.einsum("sk,fki->fsi", np.random.default_rng(0).dirichlet([1, 1, 1], 20), cage.vertices[cage.faces])
    beyond = np.abs(samples.reshape(-1, 1, 3) - centers[::3]) - 0.5 * field.voxel_size
    assert np.linalg.norm(np.maximum(beyond, 0.0), axis=2).min() >= field.voxel_size[0]


def test_visible_nodes_by_opacity_by_weight_and_by_threshold():
    density = np.zeros((4, 4, 4), np.float32)
    density[0, 0, 0], density[1, 1, 1], density[3, 2, 1] = 0.019, 0.021, 5.0  # 0.0201 is 1 % over half a unit
    assert visible_nodes(GridField(density)).tolist() == [[-0.25, -0.25, -0.25], [0.75, 0.25, -0.25]]
    assert visible_nodes(GridField(density), 0.5).tolist() == [[0.75, 0.25, -0.25]]
    weights = np.where(density == 5.0, 0.0, 1.0)
    assert visible_nodes(GridField(density, weights=weights)).tolist() == [[-0.75] * 3, [-0.25] * 3]


def test_distances_are_exact_within_the_radius():
    mask = np.random.default_rng(0).random((12, 9, 11)) < 0.01
    places = np.argwhere(np.ones_like(mask))
    exact = np.linalg.norm(places[:, None] - np.argwhere(mask)[None], axis=2).min(axis=1).reshape(mask.shape)
    assert np.allclose(distance_to(mask, 5), np.minimum(exact, 5), atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda m: Cage.from_mesh(m, 7), "vertex_count"),
        (lambda m: Cage.from_mesh(m, 2001), "vertex_count"),
        (lambda m: Cage.from_mesh(m, 50.5), "vertex_count"),
        (lambda m: Cage.from_mesh(m, margin=-1.0), "margin"),
        (lambda m: Cage.from_mesh(m, margin=np.nan), "margin"),
        (lambda m: Cage.from_mesh(trimesh.Trimesh()), "the mesh is empty"),
        (lambda m: Cage.from_mesh(trimesh.Trimesh(m.vertices * np.nan, m.faces, process=False)), "not finite"),
        (lambda m: Cage.from_mesh(trimesh.Trimesh(m.vertices * 0.0, m.faces, process=False)), "no extent"),
        (lambda m: Cage.from_field(GridField(np.zeros((4, 4, 4)))), "shows nothing"),
        (lambda m: Cage.from_field(GridField(np.full((4, 4, 4), np.inf))), "not finite"),
        (lambda m: Cage.from_field(GridField(np.ones((4, 4, 4))), threshold=0.0), "threshold"),
    ],
)
def test_refusals(make, message):
    refused(lambda: make(trimesh.creation.box()), message)


def test_without_pymeshlab_one_line_says_what_to_do(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)  # as where it is not installed
    ball = trimesh.creation.icosphere(subdivisions=2)
    refused(lambda: Cage.from_mesh(ball, vertex_count=42), match="needs PyMeshLab .*: pip install", error=ImportError)


#: Cages of a mesh by threads that end before the process does.
IN_THREADS = """\
import threading, trimesh
from warpcage import Cage

def make():
    print(len(Cage.from_mesh(trimesh.creation.icosphere(subdivisions=2), 42).vertices))

for _ in range(2):
    thread = threading.Thread(target=make)
    thread.start()
    thread.join()
"""


def test_cages_made_in_threads_let_the_process_end():
    # PyMeshLab aborts one at its very end whose plugins were loaded by a thread that is gone
    done = subprocess.run([sys.executable, "-c", IN_THREADS], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stdout) == (0, "42\n42\n"), done.stderr
