import numpy as np
import pytest
from refusals import refused

from warpcage import Cage
from warpcage.cage import poses

rod = np.array([[0, 0, 0], [0, 0, 1], [0, 0, 2], [0.1, 0, 2], [0, 0.1, 2], [0, 0, 4.0]])


def test_bend_of_a_quarter_circle_by_hand():
    radius = 4 / (np.pi / 2)
    bent = poses.bend(rod, 90, axis="z", towards="x", center=[0, 0, 0])
    half = np.pi / 4
    middle = [radius * (1 - np.cos(half)), 0, radius * np.sin(half)]
    normal = np.array([np.cos(half), 0, -np.sin(half)])
    assert np.allclose(bent[0], [0, 0, 0]) and np.allclose(bent[2], middle)
    assert np.allclose(bent[3], middle + 0.1 * normal) and np.allclose(bent[4], middle + np.array([0, 0.1, 0]))
    assert np.allclose(bent[5], [radius, 0, radius])


@pytest.mark.parametrize("axis", "xyz")
@pytest.mark.parametrize("towards", ["x", "y", "z", "-x", "-y", "-z"])
def test_bend_keeps_lengths_on_the_line_and_ends_at_the_angle(axis, towards):
    if axis == towards[-1]:
        return
    along, across = "xyz".index(axis), "xyz".index(towards[-1])
    line = np.zeros((2001, 3))
    line[:, along] = np.linspace(-1, 3, 2001)
    bent = poses.bend(line, 70, axis=axis, towards=towards, limits=(0.25, 0.75))
    assert np.linalg.norm(np.diff(bent, axis=0), axis=1) == pytest.approx(np.full(2000, 4 / 2000), rel=1e-6)
    assert np.allclose(bent[:501], line[:501])
    end = bent[-1] - bent[-2]
    end /= np.linalg.norm(end)
    sign = -1 if towards[0] == "-" else 1
    assert end[along] == pytest.approx(np.cos(np.deg2rad(70)), abs=1e-6)
    assert end[across] == pytest.approx(sign * np.sin(np.deg2rad(70)), abs=1e-6)


def test_small_bends_approach_the_identity_without_dividing_by_zero():
    assert np.array_equal(poses.bend(rod, 0), rod)
    assert np.allclose(poses.bend(rod, 1e-9), rod, atol=1e-9)


def test_bend_is_locally_rigid_across_the_line():
    slice_ = np.array([[x, y, 2.0] for x in (-0.2, 0.2) for y in (-0.1, 0.3)])
    bent = poses.bend(np.concatenate([rod, slice_]), 50, center=[0, 0, 0])[len(rod) :]
    before = np.linalg.norm(slice_[:, None] - slice_[None], axis=2)
    assert np.allclose(np.linalg.norm(bent[:, None] - bent[None], axis=2), before)


def test_twist_turns_the_top_and_keeps_the_bottom():
    box = Cage.box([-1, -1, 0], [1, 1, 2], segments=(1, 1, 2))
    twisted = box.twist(90).vertices
    for before, after in zip(box.vertices, twisted, strict=True):
        turn = np.pi / 2 * before[2] / 2
        x, y, z = before
        assert np.allclose(after, [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z])
    low = box.vertices[:, 2] < 1.5
    assert np.allclose(box.twist(90, limits=(0.9, 1.0)).vertices[low], box.vertices[low])


def test_taper_scales_across_and_stretch_along():
    box = Cage.box([-1, -1, 0], [1, 1, 2])
    top = box.vertices[:, 2] == 2
    tapered = box.taper(0.5)
    assert np.allclose(tapered.vertices[top], box.vertices[top] * [0.5, 0.5, 1])
    assert np.array_equal(tapered.vertices[~top], box.vertices[~top])
    assert np.allclose(box.stretch(3).vertices[top, 2], 6) and box.stretch(3).volume == pytest.approx(24)
    assert box.stretch(3, keep_volume=True).volume == pytest.approx(8)
    assert np.allclose(poses.stretch(rod, 2, limits=(0.25, 0.5))[:, 2], [0, 1, 3, 3, 3, 5])


def test_an_axis_from_its_other_end():
    rod = np.stack([np.zeros(6), np.zeros(6), np.arange(6.0)], axis=1)
    heap = np.random.default_rng(0).random((40, 3))
    for pose, amount in ((poses.bend, 40), (poses.twist, 30), (poses.taper, 0.5), (poses.stretch, 2)):
        against = pose(heap, amount, axis="-z", limits=(0, 0.5))
        assert np.allclose(against, pose(heap, amount, axis=[0, 0, -1], limits=(0, 0.5)))
        assert not np.allclose(against, pose(heap, amount, axis="z", limits=(0, 0.5)), atol=0.05)
    assert np.allclose(poses.bend(rod, 40, axis="-z", center=[0, 0, 5])[5], rod[5])  # what lies at its beginning stays
    assert np.allclose(poses.rotate(rod, 30, axis="-z"), poses.rotate(rod, -30, axis="z"))
    refused(lambda: poses.twist(rod, 10, axis="-q"), match="axis must be")


def test_scale_translate_rotate():
    box = Cage.box([0, 0, 0], [2, 2, 2])
    assert box.scale(2).bounds.tolist() == [[-1, -1, -1], [3, 3, 3]]
    assert box.scale([1, 2, 3], center=[0, 0, 0]).bounds.tolist() == [[0, 0, 0], [2, 4, 6]]
    assert box.translate([1, 2, 3]).bounds.tolist() == [[1, 2, 3], [3, 4, 5]]
    assert np.allclose(poses.rotate([[1, 0, 0]], 90, center=[0, 0, 0]), [[0, 1, 0]])
    assert np.allclose(poses.rotate([[1, 0, 0]], 120, axis=[1, 1, 1], center=[0, 0, 0]), [[0, 1, 0]])
    assert box.rotate(33, axis=[1, 2, 3]).volume == pytest.approx(8)
    assert np.allclose(box.rotate(33, axis="y").bounds.mean(axis=0), [1, 1, 1])


def test_poses_of_a_cage_ignore_unused_vertices_and_keep_its_faces():
    box = Cage.box([0, 0, 0], [1, 1, 1])
    extra = Cage(np.concatenate([box.vertices, [[0, 0, 50.0]]]), box.faces)
    for pose in (lambda c: c.bend(40), lambda c: c.twist(40), lambda c: c.scale(2), lambda c: c.rotate(10, axis="x")):
        assert np.allclose(pose(extra).vertices[:8], pose(box).vertices)
        assert pose(extra).faces is extra.faces
        pose(box).require_usable()


def test_bounds_pose_a_part_along_with_the_whole():
    box = Cage.box([0, 0, 0], [1, 1, 3], segments=3)
    part = box.vertices[5:20]
    assert np.allclose(poses.bend(part, 60, bounds=box.bounds), box.bend(60).vertices[5:20])


@pytest.mark.parametrize(
    "pose",
    [
        lambda c: c.bend(np.nan),
        lambda c: c.bend(20, axis="z", towards="z"),
        lambda c: c.bend(20, towards="up"),
        lambda c: c.bend(20, limits=(0.5, 0.5)),
        lambda c: c.bend(20, limits=(0, np.inf)),
        lambda c: c.bend("20"),
        lambda c: c.twist(20, axis=2),
        lambda c: c.taper(0.0),
        lambda c: c.stretch(-1),
        lambda c: c.stretch(2, keep_volume=True, limits=(0, 0.5)),
        lambda c: c.scale(0.0),
        lambda c: c.scale([1, 1]),
        lambda c: c.translate([1, 2]),
        lambda c: c.translate([1, 2, np.nan]),
        lambda c: c.rotate(20, axis=[0, 0, 0]),
        lambda c: c.rotate(20, center=[0, 0]),
    ],
)
def test_poses_refuse_what_makes_no_sense(pose):
    refused(lambda: pose(Cage.box([0, 0, 0], [1, 1, 1])))
