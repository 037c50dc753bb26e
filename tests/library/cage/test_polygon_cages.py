"""Quads and other polygons of cages: kept by files, matched in any order, checked, mended, cut, snapped and posed."""

import json
import pickle

import numpy as np
import pytest
from polygon_cages import (
    CUBE_CORNERS,
    CUBE_QUADS,
    concave_prism,
    mixed_prism,
    quad_box,
    quad_cube,
    reordered,
    triangulated,
)
from refusals import refused

from warpcage import Cage, PoseFile, RandomPoses, deform_points

CAGES = {"cube": quad_cube, "warped": lambda: quad_box(2, 0.2), "mixed": mixed_prism, "concave": concave_prism}
FORMATS = ["obj", "ply", "off", "usda", "usdc"]


# -- Files


@pytest.mark.parametrize("name", CAGES)
@pytest.mark.parametrize("ending", FORMATS)
def test_files_hold_polygons_as_they_came(name, ending, tmp_path):
    if ending.startswith("usd"):
        pytest.importorskip("pxr")
    cage, path = CAGES[name](), tmp_path / f"cage.{ending}"
    cage.save(path)
    loaded = Cage.load(path)
    assert loaded.polygons == cage.polygons
    np.testing.assert_allclose(loaded.vertices, cage.vertices, atol=0.0 if "usd" not in ending else 1e-6)
    loaded.save(tmp_path / f"again.{ending}")
    assert (tmp_path / f"again.{ending}").read_bytes() == path.read_bytes()


def test_a_polygon_of_many_corners_is_written_to_ply(tmp_path):
    angles = 2.0 * np.pi * np.arange(300) / 300
    ring = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    faces = [[k, (k + 1) % 300, 300] for k in range(300)] + [list(range(299, -1, -1))]
    cage = Cage(np.concatenate([ring, [[0.0, 0.0, 1.0]]]), faces)
    cage.save(tmp_path / "cone.ply")
    assert Cage.load(tmp_path / "cone.ply").polygons == cage.polygons


def test_gltf_has_the_triangles_of_polygons(tmp_path):
    cage = quad_box(2, 0.1)
    with pytest.warns(UserWarning, match="cage.glb holds triangles"):
        cage.save(tmp_path / "cage.glb")
    loaded = Cage.load(tmp_path / "cage.glb")
    with pytest.warns(UserWarning) as found:
        PoseFile(cage, {"bent": cage.bend(20)}).save(tmp_path / "walk.gltf")
    assert [str(each.message).partition(" holds ")[0] for each in found] == [str(tmp_path / "walk.gltf")]
    np.testing.assert_array_equal(loaded.faces, cage.faces)
    np.testing.assert_allclose(cage.match(loaded).vertices, cage.vertices, atol=1e-6)


def test_files_of_triangles_are_what_they_were(tmp_path):
    cage = Cage.box([0, 0, 0], [1, 1, 1])
    cage.save(tmp_path / "box.obj")
    lines = [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in cage.faces.tolist()]
    assert (tmp_path / "box.obj").read_text().splitlines()[9:] == lines
    PoseFile(cage, {"up": cage.translate((0, 0, 1))}).save(tmp_path / "box.json")
    assert json.loads((tmp_path / "box.json").read_text())["cage"]["faces"] == cage.faces.tolist()


@pytest.mark.parametrize("name", CAGES)
def test_pose_files_hold_polygons(name, tmp_path):
    cage = CAGES[name]()
    PoseFile(cage, {"twisted": cage.twist(20.0)}).save(tmp_path / "poses.json")
    alone, fitted = PoseFile.load(tmp_path / "poses.json"), PoseFile.load(tmp_path / "poses.json", cage)
    for file in (alone, fitted):
        assert file.rest.polygons == file["twisted"].polygons == cage.polygons
        np.testing.assert_array_equal(file["twisted"].vertices, cage.twist(20.0).vertices)
    # one of before, when polygons were cut as they were read
    PoseFile(triangulated(cage), {"twisted": triangulated(cage.twist(20.0))}).save(tmp_path / "old.json")
    old = PoseFile.load(tmp_path / "old.json", cage)
    assert old["twisted"].polygons == cage.polygons
    np.testing.assert_array_equal(old["twisted"].vertices, cage.twist(20.0).vertices)


def test_films_of_usd_hold_polygons(tmp_path):
    pytest.importorskip("pxr")
    cage = mixed_prism()
    film = PoseFile(cage, {"a": cage, "b": cage.bend(20.0)})
    film.save(tmp_path / "film.usda")
    assert Cage.load(tmp_path / "film.usda").polygons == cage.polygons
    assert PoseFile.load(tmp_path / "film.usda", cage).rest is cage


def test_cages_are_pickled_with_their_polygons():
    cage = quad_box(2, 0.1)
    held = cage.surface.volume
    copied = pickle.loads(pickle.dumps(cage))
    assert copied.polygons == cage.polygons and copied.surface.volume == held


# -- Faces as they are given


def test_faces_are_arrays_or_the_corners_of_each():
    cage = mixed_prism()
    assert cage.face_array.shape == (9, 5) and cage.face_array.dtype == np.int32
    assert Cage(cage.vertices, cage.face_array).polygons == cage.polygons
    assert Cage(cage.vertices, cage.polygons).polygons == cage.polygons
    assert cage.face_count == 9 and cage.faces.shape == (2 * 3 + 3 * 2 + 4, 3) and len(cage.edges) == 17
    assert "9 faces" in repr(cage)


@pytest.mark.parametrize(
    ("faces", "said"),
    [
        ([[0, 1, 2, 3], [4, 5, 9]], r"cage face 1 is \[4, 5, 9\]"),
        ([[0, 1, 2, 3], [4, 5]], "at least 3 vertices each, got one of 2"),
        ([[0, 1, 2, -1, 3], [4, 5, 6, 7, 0]], "-1 stands behind the last corner only"),
        (np.zeros((2, 4)), "whole numbers"),
        ([[0, 1, -1, -1]], "cage face 0 is "),
    ],
)
def test_faces_that_cannot_be_are_refused_in_one_line(faces, said):
    refused(lambda: Cage(CUBE_CORNERS, faces), match=said)


def test_with_vertices_and_poses_keep_polygons():
    cage = mixed_prism()
    for posed in (cage.bend(20.0), cage.twist(10.0), cage.symmetrise("y"), cage.named("a"), cage.random_pose(3)):
        assert posed.polygons == cage.polygons and posed.polygon_faces is cage.polygon_faces


# -- Matching


@pytest.mark.parametrize("name", CAGES)
def test_a_pose_in_another_order_is_matched(name):
    cage = CAGES[name]()
    cage = cage.with_vertices(cage.vertices + 0.05 * np.random.default_rng(2).normal(size=cage.vertices.shape))
    posed = cage.twist(15.0).translate((0.1, 0.2, 0.3))
    for seed in range(3):
        other, _ = reordered(posed, seed)
        np.testing.assert_array_equal(cage.match(other).vertices, posed.vertices)
        assert cage.match(other).polygons == cage.polygons


@pytest.mark.parametrize("turn", [0, 1, 2])
@pytest.mark.parametrize("name", CAGES)
def test_a_pose_of_triangles_is_matched_and_the_other_way_round(name, turn):
    cage = CAGES[name]()
    posed = cage.twist(15.0)
    np.testing.assert_array_equal(cage.match(triangulated(posed, turn)).vertices, posed.vertices)
    np.testing.assert_array_equal(triangulated(cage, turn).match(posed).vertices, posed.vertices)


def test_other_faces_do_not_match():
    cage = quad_box(2, 0.1)
    swapped = list(cage.polygons)
    swapped[0] = (swapped[0][0], swapped[0][2], swapped[0][1], swapped[0][3])
    refused(lambda: cage.match(Cage(cage.vertices, swapped)), match="the pose ")


# -- Check, repair, finer ones


def test_checks_count_polygons_and_name_concave_and_warped_ones():
    report = mixed_prism().check()
    assert report.usable and (report.face_count, report.genus, report.planarity) == (9, 0, pytest.approx(0, abs=1e-12))
    assert report.concave_faces == () and "concave" not in str(report) and not report.intersecting_faces
    report = concave_prism().check()
    assert report.usable and report.concave_faces == (0, 1) and "concave faces" in str(report)
    lifted = quad_cube().move((0.0, 0.0, 1.0), group=[7])
    assert lifted.check().planarity == pytest.approx(0.25 / 2.0, rel=0.2) and "off their plane" in str(lifted.check())
    assert report.volume == pytest.approx(3.0) and quad_cube().volume == pytest.approx(8.0)


def test_volumes_are_those_of_bilinear_patches():
    # under a patch over the unit square, heights 0, 0, 0 and h: the integral of h x y is h / 4
    lifted = quad_cube().move((0.0, 0.0, 1.0), group=[7])
    assert lifted.refined(1).volume == pytest.approx(8.0 + 4.0 * 0.25, abs=0.1)
    off = [abs(lifted.refined(cells).volume - 9.0) for cells in (1, 2)]
    assert off[1] <= off[0] + 1e-12 and off[1] < 1e-6


@pytest.mark.parametrize("start", range(4))
@pytest.mark.parametrize("mirrored", [False, True])
def test_a_warped_dart_is_cut_at_its_notch_wherever_its_corners_begin(start, mirrored):
    # the notch is corner 2, so that the diagonal from 0 to 2 alone stays within the face
    dart = np.array([(0.0, 0.0, 0.0), (2.0, -1.5, 0.3), (0.8, 0.0, -0.3), (2.0, 1.5, 0.3)])
    points = np.concatenate([dart - (0, 0, 1), dart + (0, 0, 1)]) * (-1 if mirrored else 1, 1, 1)
    faces = [[3, 2, 1, 0], [4, 5, 6, 7], *([k, (k + 1) % 4, (k + 1) % 4 + 4, k + 4] for k in range(4))]
    faces = [face[start:] + face[:start] for face in faces]
    cage = Cage(points, [face[::-1] for face in faces] if mirrored else faces)
    # its sides are upright, so its volume is its height times the area of the outline
    assert cage.check().concave_faces == (0, 1)
    assert cage.volume == pytest.approx(
        2.0 * 0.5 * abs(np.linalg.det([dart[2, :2] - dart[0, :2], dart[3, :2] - dart[1, :2]]))
    )
    inside = cage.contains([[-0.4 if mirrored else 0.4, 0.0, 0.0], [-1.9 if mirrored else 1.9, 0.0, 0.0]])
    assert inside.tolist() == [True, False]


@pytest.mark.parametrize("outline", ["L", "star", "comb"])
def test_concave_faces_are_cut_alike_wherever_their_corners_begin(outline):
    """So a pose is the same, though nothing says which of several cuts is right; that of the L is symmetric."""
    turns, comb = np.arange(10) * np.pi / 5, [(0, 0), (5, 0), (5, 3), (4, 3), (4, 1), (3, 1), (3, 3), (0, 3)]
    star = np.stack([np.cos(turns), np.sin(turns)], axis=1) * np.where(np.arange(10) % 2, 1.0, 0.4)[:, None]
    corners = np.array({"L": [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], "star": star, "comb": comb}[outline])
    n = len(corners)
    vertices = np.concatenate([np.c_[corners, np.zeros(n)], np.c_[corners, np.ones(n)]])
    sides = [(k, (k + 1) % n, (k + 1) % n + n, k + n) for k in range(n)]
    found = set()
    for start in range(n):
        cage = Cage(vertices, [np.roll(np.arange(n)[::-1], start), n + np.roll(np.arange(n), start), *sides])
        cage.require_usable()
        assert {0, 1} <= set(cage.check().concave_faces)
        found.add(frozenset(frozenset(face) for face in cage.faces.tolist()))
    assert len(found) == 1
    if outline == "L":  # triangles about its notch, 3, as far as they go
        assert {frozenset(each) for each in ((3, 4, 5), (5, 0, 3), (0, 1, 3), (1, 2, 3))} <= next(iter(found))


def test_points_between_a_patch_and_the_triangles_of_a_kind_are_told_which_they_are():
    cage = quad_box(2, 0.2)
    points = np.random.default_rng(0).uniform(*cage.bounds, (20000, 3))
    points = points[cage.contains(points) & ~cage.refined(1).contains(points)]
    assert len(points)
    refused(lambda: deform_points(points, cage, cage, "green"), match=r"the triangles of refined\(1\)$")
    refused(lambda: deform_points(points + 9.0, cage, cage, "harmonic"), match="inside, mean_value for any$")


def test_poses_that_are_refused_are_named_by_the_numbers_of_the_cage():
    cage = quad_cube()
    flat = CUBE_CORNERS * (1, 1, 0)
    refused(lambda: deform_points([[0, 0, 0]], cage, flat, "harmonic"), match="^deformed cage has 4 vertices at")


@pytest.mark.parametrize("seed", range(4))
def test_a_flat_cage_is_refused_however_its_volume_is_rounded(seed):
    sheared = CUBE_CORNERS @ np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.3, 0.17, 0.0]])
    turn = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    problem = quad_cube().with_vertices(sheared @ turn.T).check().problem
    assert problem.startswith("is flat: the part with face 0 encloses no volume")
    sheared[:, 2] = 1e-5 * CUBE_CORNERS[:, 2]
    thin = quad_cube().with_vertices(sheared @ (turn * np.linalg.det(turn)).T)
    assert thin.check().usable and thin.volume == pytest.approx(8e-5, rel=1e-3)


def test_faults_are_named_by_polygons():
    faces = [list(face) for face in CUBE_QUADS]
    assert "is open: 4 edges" in Cage(CUBE_CORNERS, faces[1:]).check().problem
    turned = [faces[0][::-1], *faces[1:]]
    assert len(Cage(CUBE_CORNERS, turned).check().clashing_edges) == 4
    inside_out = Cage(CUBE_CORNERS, [face[::-1] for face in faces])
    assert inside_out.check().inward_parts == (0,) and inside_out.volume == pytest.approx(-8.0)
    flat = quad_cube().with_vertices(CUBE_CORNERS * (1, 1, 0))
    assert flat.check().problem
    twice = np.concatenate([CUBE_CORNERS[list(face)] for face in CUBE_QUADS])
    loose = Cage(twice, np.arange(24).reshape(6, 4))
    assert loose.check().problem.endswith("or merge the 16 vertices at the place of another")
    crossing = quad_cube().move((0.0, 0.0, -3.0), group=[7])
    assert crossing.check().intersecting_faces


def test_parts_that_touch_in_the_middle_of_faces_are_named():
    """A small cube that stands on a large one: the middles of two faces are one place."""
    small, large = quad_cube(), quad_cube().scale(2.0)
    vertices = np.concatenate([large.vertices, small.vertices + (0.0, 0.0, 3.0)])
    cage = Cage(vertices, [*large.polygons, *(tuple(np.array(face) + 8) for face in small.polygons)])
    said = refused(lambda: cage.require_usable(), "touch in the middle")
    assert "the first 1 and 6:" in said


def test_repairs_keep_polygons():
    faces = [list(face) for face in CUBE_QUADS]
    turned = [faces[0], faces[1][::-1], *faces[2:]]
    mended, notes = Cage(CUBE_CORNERS, turned).repair()
    assert mended.polygons == tuple(map(tuple, faces)) and notes == (
        "flipped 1 face that was wound against their neighbours, the first 1",
    )
    mended, notes = Cage(CUBE_CORNERS, faces[1:]).repair()
    assert mended.check().usable and mended.polygons[:5] == tuple(map(tuple, faces[1:])) and "closed a hole" in notes[0]
    mended, _ = Cage(CUBE_CORNERS, [face[::-1] for face in faces]).repair()
    assert mended.volume == pytest.approx(8.0) and mended.face_count == 6
    twice = np.concatenate([CUBE_CORNERS, CUBE_CORNERS[7:]])
    apart = [[8 if corner == 7 and k == 1 else corner for corner in face] for k, face in enumerate(faces)]
    mended, notes = Cage(twice, apart).repair()
    assert mended.polygons == tuple(map(tuple, faces)) and notes[0].startswith("merged 1 vertex")
    cage = quad_cube()
    assert cage.repair() == (cage, ())


@pytest.mark.parametrize("name", CAGES)
def test_finer_cages_have_the_same_surface(name):
    cage = CAGES[name]()
    finer = cage.subdivide()
    assert finer.check().usable and finer.topology.genus == cage.topology.genus
    np.testing.assert_array_equal(finer.vertices[: len(cage.vertices)], cage.vertices)
    if name != "concave":
        corners = sum(len(face) for face in cage.polygons if len(face) > 3)
        assert finer.face_count == corners + 4 * sum(len(face) == 3 for face in cage.polygons)
    flat = name != "warped"
    assert finer.volume == pytest.approx(cage.volume, rel=1e-9 if flat else 1e-3)


def test_random_poses_of_quads_stay_within_their_bounds():
    cage = quad_box(2, 0.05)
    poses = RandomPoses(cage, seed=1)
    for number in range(3):
        posed = poses.pose(number)
        assert posed.polygons == cage.polygons and not cage.check(pose=posed).pose.intersecting_faces
    assert np.abs(poses.pose(0).vertices - cage.vertices).max() > 0.01


def test_points_inside_are_those_of_the_bilinear_patch(device):
    lifted = quad_cube().move((0.0, 0.0, 1.0), group=[7])
    random = np.random.default_rng(0).uniform(-1.0, 1.0, (2000, 2))
    heights = np.random.default_rng(1).uniform(0.9, 2.0, 2000)
    top = 1.0 + 0.25 * (1.0 + random[:, 0]) * (1.0 + random[:, 1])
    clear = np.abs(heights - top) > 0.02
    found = lifted.contains(np.column_stack([random, heights]), device=device)
    np.testing.assert_array_equal(found[clear], (heights < top)[clear])
