"""Poses as pipelines have them: arrays of any library, files of other programs, vertex caches in and out."""

import pathlib
import struct

import numpy as np
import pytest
import warp as wp
from fields import BOX, OnlyDLPack, ellipsoid, make_field, plain
from refusals import refused

from warpcage import Cage, CageEdit, Deformer, PoseFile, PositionMap, deform_points
from warpcage.cage import cache_poses

FIXTURES = pathlib.Path(__file__).parents[2] / "data" / "blender_motion"
BENT = BOX.bend(25)
MOVES = np.stack([BOX.bend(angle).vertices for angle in (0, 10, 25)]).astype(np.float32)


@pytest.fixture(scope="module")
def deformer():
    field = make_field(ellipsoid, plain((0.8, 0.3, 0.2)), device="cpu", resolution=12)
    return Deformer(field, BOX, coordinates="mean_value", resolution=12)


def pc2(vertices, begin=1.0, step=1.0):
    """A file as its format is published: little-endian, frames of points."""
    count, points = vertices.shape[:2]
    return struct.pack("<12siiffi", b"POINTCACHE2\0", 1, points, begin, step, count) + vertices.astype("<f4").tobytes()


def mdd(vertices, times):
    """A file as its format is published: big-endian, times in seconds first."""
    head = struct.pack(">2i", *vertices.shape[:2]) + np.asarray(times, ">f4").tobytes()
    return head + vertices.astype(">f4").tobytes()


KINDS = {
    "float64": lambda vertices: vertices,
    "float32": lambda vertices: vertices.astype(np.float32),
    "strided": lambda vertices: np.repeat(vertices, 2, axis=0)[::2],
    "warp": lambda vertices: wp.array(vertices.astype(np.float32), dtype=wp.vec3, device="cpu"),
    "dlpack": lambda vertices: OnlyDLPack(np.array(vertices)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_vertices_of_any_library_are_a_pose(kind, deformer):
    (posed,) = deformer.pose(KINDS[kind](BENT.vertices)).deformed
    np.testing.assert_allclose(posed.vertices, BENT.vertices, atol=0 if kind in ("float64", "strided") else 1e-6)
    np.testing.assert_array_equal(posed.faces, BOX.faces)


@pytest.mark.parametrize("kind", KINDS)
def test_they_pose_points_and_maps_too(kind, device):
    """As the cage of the same vertices does, to their precision."""
    vertices, points = KINDS[kind](BENT.vertices), 0.5 * BOX.vertices
    maps = [PositionMap(BOX, coordinates="green", resolution=12, device=device) for _ in range(2)]
    found, expected = ([deform_points(points, BOX, pose, device=device)] for pose in (vertices, BENT))
    for posed, pose, places in zip(maps, (vertices, BENT), (found, expected), strict=True):
        places.append(posed.pose(pose).data.positions.numpy())
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, atol=0 if kind in ("float64", "strided") else 1e-5)


def test_each_edit_takes_its_own_kind(deformer, tmp_path):
    BENT.save(tmp_path / "bent.obj")
    several = Deformer(deformer.field, [BOX, CageEdit(BOX, remove=True), BOX], coordinates="mean_value", resolution=12)
    one, nothing, two = several.pose([tmp_path / "bent.obj", None, BENT.vertices]).deformed
    np.testing.assert_array_equal(one.vertices, two.vertices)
    assert nothing is None


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (BENT.vertices[:-1], "of these faces needs"),
        (np.full_like(BENT.vertices, np.nan), "finite"),
        (BENT.vertices.tolist(), "one cage per edit"),
        (5, "the pose of edit 0 must be a Cage"),
        ("twist.json", "not there"),
        ("walk.pc2", "not there"),
        (3 * [BENT], "one cage per edit"),
    ],
)
def test_what_is_no_pose_is_told_and_the_pose_before_stays(pose, message, deformer):
    before = deformer.pose(BENT).deformed
    refused(lambda: deformer.pose(pose), match=message, error=(ValueError, FileNotFoundError))
    assert deformer.deformed is before


def test_files_of_one_pose_are_a_pose(deformer, tmp_path):
    file = PoseFile(BOX, {"bow": BENT})
    BENT.save(tmp_path / "bent.ply")
    BENT.save(tmp_path / "bent.glb")
    file.save(tmp_path / "bow.json")
    file.save(tmp_path / "bow.pc2")
    for name in ("bent.ply", "bent.glb", "bow.json", "bow.pc2"):
        (posed,) = deformer.pose(tmp_path / name).deformed
        np.testing.assert_allclose(posed.vertices, BENT.vertices, atol=1e-6)
    file["wave"] = BOX
    file.save(tmp_path / "two.json")
    refused(lambda: deformer.pose(tmp_path / "two.json"), match="holds 2 poses .bow, wave.: take one")


@pytest.mark.parametrize("name", ["shape_keys", "moved_object", "armature"])
def test_a_pose_file_reads_what_blender_animated(name):
    expected = np.load(FIXTURES / f"{name}.npz")["vertices"]
    file = PoseFile.load(FIXTURES / f"{name}.glb")
    assert len(file) == len(expected) and file.fps == 24.0
    np.testing.assert_allclose(file.rest.vertices, Cage.load(FIXTURES / f"{name}.glb").vertices)
    for key, places in zip(file.names, expected, strict=True):  # vertices of files come in an order of their own
        gaps = np.linalg.norm(file[key].vertices[:, None] - places[None], axis=-1)
        assert gaps.min(axis=1).max() < 2e-6


def test_numbered_cages_and_a_cage_alone_are_read_too(tmp_path):
    for number, vertices in enumerate(MOVES):
        BOX.with_vertices(vertices).save(tmp_path / f"walk_{number:03d}.ply")
    file = PoseFile.load(tmp_path / "walk_###.ply", BOX, fps=10)
    assert file.names == ("walk_000", "walk_001", "walk_002") and file.times["walk_002"] == pytest.approx(0.2)
    one = PoseFile.load(tmp_path / "walk_002.ply", BOX)
    np.testing.assert_array_equal(one["walk_002"].vertices, MOVES[2])
    refused(lambda: PoseFile.load(tmp_path / "walk_002.ply"), match="give the cage at rest")


def test_caches_are_read_as_published(tmp_path):
    (tmp_path / "a.pc2").write_bytes(pc2(MOVES, step=0.5))
    file = PoseFile.load(tmp_path / "a.pc2", BOX, fps=25)
    np.testing.assert_allclose([file.times[name] for name in file.names], [0, 0.02, 0.04])
    (tmp_path / "a.mdd").write_bytes(mdd(MOVES, [2.0, 2.1, 2.2]))
    other = PoseFile.load(tmp_path / "a.mdd", BOX)
    np.testing.assert_allclose([other.times[name] for name in other.names], [0, 0.1, 0.2], atol=1e-6)
    assert other.fps == pytest.approx(10.0) and set(other.easings.values()) == {"linear"}
    for each in (file, other):
        np.testing.assert_array_equal([each[name].vertices for name in each.names], MOVES)


def test_a_cache_with_another_axis_up_is_turned(tmp_path):
    lower = BOX.vertices[:, 2] < 0  # which stay, so that the pose is no turn of everything
    moved = BOX.vertices + np.where(lower, 0.0, 0.3)[:, None] * [1.0, 0.2, 0.0]
    y_up = moved[:, [0, 2, 1]] * [1, 1, -1]
    (tmp_path / "a.pc2").write_bytes(pc2(y_up[None]))
    np.testing.assert_allclose(PoseFile.load(tmp_path / "a.pc2", BOX)["frame 0"].vertices, moved, atol=1e-6)
    np.testing.assert_allclose(cache_poses(tmp_path / "a.pc2", BOX, up="z")["frame 0"].vertices, y_up, atol=1e-6)


@pytest.mark.parametrize("ending", [".pc2", ".mdd", ".PC2"])
def test_a_cache_comes_back_as_it_was_written(ending, tmp_path):
    file = PoseFile(BOX, {"a": BOX, "b": BENT})
    file.times, file.easings, file.fps = {"a": 0.0, "b": 0.5}, {"a": "linear", "b": "linear"}, 8.0
    file.save(tmp_path / f"walk{ending}")
    again = PoseFile.load(tmp_path / f"walk{ending}", BOX, fps=8.0)
    assert len(again) == 5 and again.fps == pytest.approx(8.0)
    for index, name in enumerate(again.names):
        assert again.times[name] == pytest.approx(index / 8)
        np.testing.assert_allclose(again[name].vertices, file.at_time(index / 8).vertices, atol=1e-6)
    refused(lambda: PoseFile(BOX).save(tmp_path / f"none{ending}"), match="needs a keyframe")
    assert not (tmp_path / f"none{ending}").exists()


DAMAGES = {
    "cut off": pc2(MOVES)[:-1],
    "longer": pc2(MOVES) + b"\0",
    "empty": b"",
    "head alone": pc2(MOVES)[:20],
    "other": b"solid cube" * 9,
    "another cage": pc2(MOVES[:, :-1]),
    "not finite": pc2(np.where(MOVES > 0.7, np.nan, MOVES)),
    "billions": struct.pack("<12siiffi", b"POINTCACHE2\0", 1, 2**31 - 1, 0.0, 1.0, 2**31 - 1),
    "below zero": struct.pack("<12siiffi", b"POINTCACHE2\0", 1, -26, 0.0, 1.0, 3),
    "no step": pc2(MOVES, step=0.0),
    "times go back": mdd(MOVES, [0.0, 2.0, 1.0]),
    "mdd cut off": mdd(MOVES, [0.0, 1.0, 2.0])[:-5],
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_cache_takes_one_line(damage, tmp_path):
    path = tmp_path / "bad.mdd"
    path.write_bytes(DAMAGES[damage])
    refused(lambda: PoseFile.load(path, BOX), match="bad.mdd")
