"""The two ways to a cage, and the choice between them, on the project's own scenes."""

import itertools

import numpy as np
import pytest
import trimesh
from refusals import refused
from test_cage_generation import shapes, winding

from warpcage import Cage
from warpcage.cage import outer_surface, principal_frame
from warpcage.cage.generate.voxel import made_manifold
from warpcage.demo import CAGE_SCENES, scene_field
from warpcage.mesh import MeshTopology
from warpcage.select import visible_nodes

SCENES = list(CAGE_SCENES)
GENUS = {"ring": 1}


def clean(cage, count):
    report = cage.check()
    assert report.usable and report.intersecting_faces == () and report.unused_vertices == ()
    assert abs(report.vertex_count - count) <= 0.1 * count
    return report


#: Each scene once by day, by one of these and the next; all by all at night.
WAYS = [(42, "auto"), (100, "shell"), (200, "voxel")]
BY_DAY = {(scene, *WAYS[k % len(WAYS)]) for k, scene in enumerate(SCENES)}
ALL = [(scene, *way) for scene in SCENES for way in WAYS]


@pytest.mark.parametrize(
    ("scene", "count", "method"),
    [case if case in BY_DAY else pytest.param(*case, marks=pytest.mark.nightly) for case in ALL],
)
def test_every_scene_is_enclosed_whole(scene, count, method):
    field = scene_field(scene, 48 if scene == "ring" else 32)
    cage = Cage.from_field(field, count, method=method)
    report = clean(cage, count)
    if method != "voxel":  # whose voxels may fill a hole
        assert report.genus == GENUS.get(scene, 0)
    points = visible_nodes(field)
    sample = points[:: max(1, len(points) // 400)]
    assert (winding(sample, cage.vertices, cage.faces) > 0.99).all()
    checked = cage.check(field=field)
    assert checked.field_enclosed == 1.0 and checked.leaking_faces == () and 0.8 < checked.hull_ratio < 4.0


@pytest.mark.parametrize("scene", ["tall"])
def test_auto_takes_the_tighter_of_both(scene, caplog):
    field = scene_field(scene, 32)
    cages = {method: Cage.from_field(field, 60, method=method) for method in ("shell", "voxel")}
    caplog.clear()
    with caplog.at_level("INFO", "warpcage"):
        chosen = Cage.from_field(field, 60)
    assert chosen.volume == min(cage.volume for cage in cages.values())
    assert not np.array_equal(cages["shell"].faces, cages["voxel"].faces)
    assert caplog.text.count("vertices, volume") == 2
    again = Cage.from_field(field, 60, method="voxel")
    assert np.array_equal(again.vertices, cages["voxel"].vertices)


WAYS_ACROSS = [("x", {"method": "voxel"}), ("y", {"method": "shell"}), ("z", {"detail": "parts"})]
ALL_ACROSS = [(axis, way) for axis in "xyz" for _, way in WAYS_ACROSS]


@pytest.mark.parametrize(
    ("axis", "options"),
    [pytest.param(*case, marks=() if case in WAYS_ACROSS else pytest.mark.nightly) for case in ALL_ACROSS],
)
def test_a_symmetric_cage_is_its_own_mirror_image(axis, options):
    along = "xyz".index(axis)
    mesh = shapes()["L"]
    cage = Cage.from_mesh(mesh, 90, symmetry=axis, **options)
    clean(cage, 90)
    assert cage.check(mesh=mesh).mesh_enclosed == 1.0
    middle = mesh.bounds[:, along].mean()
    mirrored = cage.vertices.copy()
    mirrored[:, along] = 2 * middle - mirrored[:, along]
    distance = np.linalg.norm(mirrored[:, None] - cage.vertices[None], axis=2)
    partner = distance.argmin(axis=1)
    assert distance.min(axis=1).max() < 1e-9 * cage.size and np.array_equal(partner[partner], np.arange(len(partner)))
    faces = {frozenset(face) for face in cage.faces.tolist()}
    assert {frozenset(face) for face in partner[cage.faces].tolist()} == faces


def test_voxels_follow_the_object_as_it_turns():
    rod = trimesh.creation.box([0.2, 0.3, 2.0])
    turn = trimesh.transformations.rotation_matrix(0.6, [1, 2, 0.5])
    turned = rod.copy().apply_transform(turn)
    one, two = (Cage.from_mesh(mesh, 60, method="voxel") for mesh in (rod, turned))
    assert two.volume == pytest.approx(one.volume, rel=0.3)
    frame = principal_frame(np.asarray(turned.sample(2000, seed=0)))
    assert np.abs(frame[:, 2] @ turn[:3, 2]) > 0.99 and np.linalg.det(frame) == pytest.approx(1)


def test_tangled_voxels_become_manifold_surfaces():
    rng = np.random.default_rng(0)
    for share in (0.15, 0.4, 0.6):
        marks = np.zeros((9, 8, 7), bool)
        marks[1:-1, 1:-1, 1:-1] = rng.random((7, 6, 5)) < share
        filled = made_manifold(marks.copy())
        assert filled.shape == marks.shape and filled[marks].all()
        nodes, faces = outer_surface(filled)
        topology = MeshTopology(len(nodes), faces)
        assert topology.closed and topology.manifold and not len(topology.clashing_edges)
        assert Cage(nodes, faces).volume == pytest.approx(np.count_nonzero(filled))


def test_outer_surface_of_a_block_by_hand():
    marks = np.zeros((4, 3, 5), bool)
    marks[1:3, 1:2, 1:4] = True
    for axis in (None, 0, 1, 2):
        nodes, faces = outer_surface(marks, axis)
        corners = set(itertools.product(range(1, 4), range(1, 3), range(1, 5)))
        inner = {(2, 1, 2), (2, 1, 3), (2, 2, 2), (2, 2, 3)}
        assert {tuple(node) for node in nodes.astype(int).tolist()} == corners and inner <= corners
        assert len(faces) == 2 * 2 * (2 * 1 + 1 * 3 + 2 * 3)


@pytest.mark.parametrize(
    ("options", "message"), [({"method": "best"}, "method must be"), ({"symmetry": "w"}, "symmetry must be")]
)
def test_refusals(options, message):
    refused(lambda: Cage.from_mesh(trimesh.creation.box(), 40, **options), match=message)
