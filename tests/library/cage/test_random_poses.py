"""Random poses: smooth, without folds, within bounds of stretch, and the same to the bit everywhere."""

import hashlib
import math

import numpy as np
import oracles
import pytest
from messages import MESSAGES
from refusals import refused

from warpcage import Cage, RandomPoses
from warpcage.cage import POSE_MODES, PosePath, PoseProbe, RandomNumbers, check_pose, poses, random_poses
from warpcage.coordinates import host_mean_value_weights, mean_value_gradients
from warpcage.mesh import intersecting_faces

#: Cages with faces of several sizes, reflex edges, and more than one part.
CAGES = {
    "box": lambda: Cage.box([-1, -1, 2], [1, 1.5, 3.1], segments=2),
    "icosphere": lambda: Cage.icosphere([5, 0, 0], 0.02),
    "cylinder": lambda: Cage.cylinder([0, 0, 0], 0.3, 2.0, rings=4, sides=8),
    "concave": lambda: Cage(*oracles.concave_l()),
    "two boxes": lambda: Cage(*oracles.two_boxes()),
}


@pytest.fixture(scope="module", params=list(CAGES))
def made(request):
    """A cage and 12 random poses of it."""
    rest = CAGES[request.param]()
    source = RandomPoses(rest, seed=3, stretch=(0.7, 1.4))
    return rest, [source.pose(number) for number in range(12)]


def random_ways(modes, count=6, vertices=None):
    vertices = Cage.icosphere([1, 2, 3], 2.0, 2).vertices if vertices is None else vertices
    return [PosePath(vertices, RandomNumbers(11, (k,)), modes) for k in range(count)]


@pytest.mark.parametrize("make", [oracles.box, oracles.icosphere, oracles.concave_l, oracles.two_boxes])
def test_weights_on_the_host_are_those_of_the_oracle(make):
    vertices, faces = make()
    cage = Cage(vertices, faces)
    points = np.random.default_rng(0).uniform(*cage.bounds, (150, 3))
    points = points[cage.contains(points)][:60]
    assert (
        np.abs(host_mean_value_weights(points, cage) - oracles.mean_value_weights(points, vertices, faces)).max()
        < 1e-13
    )


def test_gradients_reproduce_affine_maps():
    cage = Cage(*oracles.concave_l())
    points = np.random.default_rng(1).uniform(-0.4, -0.15, (20, 3))
    points[:, 2] += 0.25
    matrix = np.array([[1.2, 0.3, 0.0], [0.1, 0.8, -0.2], [0.0, 0.5, 1.0]])
    weights, gradients = mean_value_gradients(points, cage, 1e-6)
    assert np.allclose(weights @ cage.vertices, points, atol=1e-13)
    assert np.allclose(gradients @ (cage.vertices @ matrix.T), matrix.T, atol=1e-8)


def test_faces_stretch_by_the_singular_values_of_their_maps():
    rest = Cage(*oracles.icosphere())
    posed = rest.with_vertices(rest.vertices + 0.1 * np.random.default_rng(5).uniform(-1, 1, rest.vertices.shape))
    found = PoseProbe(rest).faces(posed)
    values = []
    for face in rest.faces:
        a, b, c = rest.vertices[face]
        p, q, r = posed.vertices[face]
        plane = np.linalg.qr(np.stack([b - a, c - a], axis=1))[0]  # an orthonormal frame of the face at rest
        at_rest = plane.T @ np.stack([b - a, c - a], axis=1)
        values.append(np.linalg.svd(np.stack([q - p, r - p], axis=1) @ np.linalg.inv(at_rest), compute_uv=False))
    assert found.least == pytest.approx(np.min(values), rel=1e-9)
    assert found.largest == pytest.approx(np.max(values), rel=1e-9)


@pytest.mark.parametrize("way", ["forward", "backward"])
def test_the_inside_stretches_by_the_singular_values_of_finite_differences_of_an_oracle(way):
    rest = Cage(*oracles.icosphere())
    posed = rest.bend(60.0).twist(40.0)
    probe = PoseProbe(rest, samples=40)
    source, target = (rest, posed) if way == "forward" else (posed, rest)
    places = probe.places
    if way == "backward":
        places = oracles.mean_value_weights(places, rest.vertices, rest.faces) @ posed.vertices
    step = 1e-4 * rest.size

    def carried(points):
        return oracles.mean_value_weights(points, source.vertices, source.faces) @ target.vertices

    columns = [(carried(places + step * e) - carried(places - step * e)) / (2 * step) for e in np.eye(3)]
    values = np.linalg.svd(np.stack(columns, axis=2).astype(np.float64), compute_uv=False)
    values = values if way == "forward" else 1.0 / values
    found = getattr(probe, way)(posed)
    assert found.least == pytest.approx(values.min(), rel=1e-4)
    assert found.largest == pytest.approx(values.max(), rel=1e-4)


def test_a_pose_turned_inside_out_or_crossing_itself_is_seen():
    rest = Cage.box([-1, -1, -1], [1, 1, 1], segments=3)
    probe = PoseProbe(rest)
    assert probe.forward(rest.with_vertices(rest.vertices * [1, 1, -1])).least < 0
    folded = rest.bend(300.0)
    assert probe.crosses(folded) and not probe.crosses(rest)
    assert not probe.backward(folded).within(0.01, 100.0)
    assert probe.forward(rest).within(1 - 1e-6, 1 + 1e-6) and probe.backward(rest).within(1 - 1e-6, 1 + 1e-6)


def test_poses_stay_within_the_bounds_and_do_not_fold(made):
    rest, posed = made
    probe = PoseProbe(rest, samples=200)
    for pose in posed:
        assert probe.faces(pose).within(0.7, 1.4)  # exactly what is asked for
        assert len(intersecting_faces(pose.vertices, pose.faces)) == 0
    # what the check of cages says, which looks at ten times as many places, among them some that are nearer to edges
    for pose in posed[:4]:
        report = check_pose(rest, pose)
        assert report.inverted_share == 0.0 and report.outside_share < 2e-3 and not report.problem
        assert report.least_stretch > 0.55 and report.largest_stretch < 1.9


def test_poses_are_of_all_strengths_and_none_is_at_rest(made):
    rest, posed = made
    moved = [np.linalg.norm(pose.vertices - rest.vertices, axis=1).max() / rest.size for pose in posed]
    assert 0.01 < min(moved) < 0.5 * max(moved)
    assert np.allclose([pose.vertices.mean(axis=0) for pose in posed], rest.vertices.mean(axis=0), atol=1e-12 * 10)
    assert len({pose.vertices.tobytes() for pose in posed}) == len(posed)


def test_a_thin_leaf_has_poses_that_do_not_fold():
    rest = Cage.box([-1, -1, -0.005], [1, 1, 0.005], segments=(4, 4, 1))
    source = RandomPoses(rest, seed=2)
    assert len(source.probe.places) > 100
    for number in range(2):
        report = check_pose(rest, source.pose(number))
        assert report.inverted_share == 0.0 and not report.intersecting_faces and report.largest_stretch < 2.5


def test_weaker_bounds_and_shorter_reaches_give_weaker_poses():
    rest = CAGES["cylinder"]()

    def strength(**options):
        source = RandomPoses(rest, seed=1, **options)
        return np.mean([np.abs(source.vertices(k) - rest.vertices).max() for k in range(6)])

    usual = strength()
    assert strength(stretch=(0.9, 1.1)) < 0.6 * usual
    assert strength(reach=(0.05, 0.1)) < 0.4 * usual


def test_a_number_has_its_pose_whatever_else_is_made():
    rest = CAGES["box"]()
    source = RandomPoses(rest, seed=9)
    later = source.vertices(4)
    assert np.array_equal(rest.random_pose(9, 4).vertices, later)
    assert np.array_equal(RandomPoses(rest, seed=9).vertices(4), later)
    assert not np.array_equal(RandomPoses(rest, seed=10).vertices(4), later)
    assert not np.array_equal(source.vertices(5), later)


def test_poses_are_the_same_to_the_bit_on_all_machines():
    """The digest was made on an x86-64 with AVX-512, and with those instructions switched off."""
    rest = Cage.box([-1, -1, -1], [1, 1.5, 0.8], segments=2)
    source = RandomPoses(rest, seed=2026)
    digest = hashlib.sha256()
    for number in range(4):
        digest.update(source.vertices(number).astype("<f8").tobytes())
    assert digest.hexdigest() == "78af2c9aea89f7a26ddc5c93fc774b9365220d2f4fe990f32538d1243f88f5d0"


def test_random_numbers_are_even():
    random = RandomNumbers(0, (1, 2))
    numbers = np.array([random.number() for _ in range(4000)])
    assert numbers.min() >= 0.0 and numbers.max() < 1.0
    assert np.abs(np.histogram(numbers, 8, (0, 1))[0] / 500 - 1).max() < 0.2
    directions = np.array([random.direction() for _ in range(2000)])
    assert np.allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-15)
    assert np.abs(directions.T @ directions / 2000 - np.eye(3) / 3).max() < 0.03
    assert sorted({random.whole(3) for _ in range(50)}) == [0, 1, 2]


def test_a_bend_and_a_twist_are_those_of_the_poses():
    vertices = Cage.icosphere([1, 2, 3], 2.0, 2).vertices
    box = np.stack([vertices.min(axis=0), vertices.max(axis=0)])
    center, t = box.mean(axis=0), 0.7
    for way in random_ways(["twist"], vertices=vertices):
        axis, amount = way.twist
        length = np.abs((vertices - center) @ axis).max()
        ends = center + np.outer([-length, length], axis)
        # that turns nothing at its lower limit, this one nothing in the middle
        degrees = math.degrees(t * math.copysign(random_poses.MAX_TWIST, amount))  # a mode alone gets to its end
        turned = poses.rotate(vertices, -0.5 * degrees, axis=axis, center=center)
        expected = poses.twist(turned, degrees, axis=axis, center=center, bounds=np.repeat(ends, 2, 0))
        assert_same_but_for_a_shift(way.at(t), expected)
    for way in random_ways(["bend"], vertices=vertices):
        axis, towards, amount = way.bend
        length = np.abs((vertices - center) @ axis).max()
        ends = center + np.outer([-length, length], axis)
        degrees = math.degrees(t * math.copysign(random_poses.MAX_BEND, amount))
        expected = poses.bend(
            vertices, degrees, axis=axis, towards=towards, center=center, bounds=np.repeat(ends, 2, 0)
        )
        # the one leaves its lower end in place, the other its middle: distances are the same
        assert_congruent(way.at(t), expected)


def test_a_stretch_keeps_volume_and_a_taper_the_axis():
    cage = Cage.icosphere([1, 2, 3], 2.0, 2)
    for way in random_ways(["stretch"]):
        assert cage.with_vertices(way.at(1.0)).volume == pytest.approx(cage.volume, rel=1e-12)
    for way in random_ways(["taper"]):
        axis = np.array(way.taper[0])
        assert_same_but_for_a_shift((way.at(1.0) @ axis)[:, None], (cage.vertices @ axis)[:, None])


@pytest.mark.parametrize("mode", POSE_MODES)
def test_ways_begin_at_rest_are_smooth_and_move(mode):
    vertices = Cage.icosphere([1, 2, 3], 2.0, 3).vertices
    for way in random_ways([mode], vertices=vertices):
        assert way.kinds == (mode,)
        assert np.allclose(way.at(0.0), vertices, atol=1e-14 * 10)
        steps = [way.at(t) for t in (0.0, 0.001, 0.5, 0.501, 1.0)]
        assert np.abs(steps[1] - steps[0]).max() < 0.02 and np.abs(steps[3] - steps[2]).max() < 0.02
        assert np.abs(steps[4] - steps[0]).max() > 1e-3


@pytest.mark.parametrize(
    "options, message",
    [
        ({"stretch": (1.1, 1.6)}, "stretch must hold 1"),
        ({"stretch": 2}, "stretch must be two finite numbers"),
        ({"reach": (0.5, 1.5)}, "reach must be two shares"),
        ({"modes": []}, "at least one mode"),
        ({"modes": ["melt"]}, MESSAGES["cage.random_mode"]),
        ({"seed": -1}, MESSAGES["cage.random_seed"]),
        ({"number": 1.5}, MESSAGES["cage.random_number"]),
    ],
)
def test_options_that_cannot_be_are_refused(options, message):
    refused(lambda: Cage.box([0, 0, 0], [1, 1, 1]).random_pose(**options), match=message)


def test_an_open_cage_and_one_without_room_for_poses_are_refused():
    box = Cage.box([0, 0, 0], [1, 1, 1])
    refused(lambda: RandomPoses(Cage(box.vertices, box.faces[1:])), match="rest cage is open")
    with pytest.raises(ValueError, match=MESSAGES["cage.random_stretch_range"]):
        RandomPoses(box, stretch=(1 - 1e-12, 1 + 1e-12)).vertices(0)


def assert_same_but_for_a_shift(one, two):
    assert np.allclose(one - one.mean(axis=0), two - two.mean(axis=0), atol=1e-9)


def assert_congruent(one, two):
    pick = np.random.default_rng(0).integers(0, len(one), (2, 200))
    lengths = [np.linalg.norm(points[pick[0]] - points[pick[1]], axis=1) for points in (one, two)]
    assert np.allclose(*lengths, atol=1e-9)
