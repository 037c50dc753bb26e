"""Where the object of a scene is: by what cameras look at, and by the points of a reconstruction."""

import dataclasses

import numpy as np
import pytest
from refusals import refused

from warpcage import Camera, Scene
from warpcage.scene import are_inliers, draw_box, find_box


def looking(eyes, targets, up=(0, 0, 1)):
    return [
        Camera.look_at(eye, target, up=up, fov_degrees=60, width=80, height=60)
        for eye, target in zip(eyes, np.broadcast_to(targets, np.shape(eyes)), strict=True)
    ]


def ring(count=30, *, radius=3.0, height=1.0, around=(0, 0, 0)):
    turn = 2 * np.pi * np.arange(count) / count
    circle = np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(count, height)], axis=1)
    return circle + around


def scattered(random, low, high, count):
    return random.uniform(low, high, (count, 3))


def inside(box, cameras):
    places = np.stack([camera.center for camera in cameras])
    return int(((places > box[0]) & (places < box[1])).all(axis=1).sum())


def place_points(seed=0):
    """A table with a body on it, a thin arm above, the walls of the room, and a few mistakes far above."""
    random = np.random.default_rng(seed)
    table = scattered(random, [-0.6, -0.6, -0.02], [0.6, 0.6, 0.0], 3000)
    body = scattered(random, [-0.3, -0.3, 0.0], [0.3, 0.3, 0.4], 1500)
    arm = scattered(random, [0.1, -0.03, 0.4], [0.16, 0.03, 1.0], 30)
    wall = scattered(random, [-8, 6, -1], [8, 6.1, 5], 6000)
    mistakes = np.array([[0.3, 0.0, 1.3], [-0.3, 0.2, 1.4], [0.0, -0.3, 1.3], [0.2, 0.3, 1.4]])
    return np.concatenate([table, body]), arm, np.concatenate([mistakes, wall])


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_box_holds_matter_in_the_middle_with_a_thin_part_and_no_mistakes(axis, sign):
    turned = lambda places: sign * np.roll(places, axis - 2, axis=1)  # noqa: E731
    bulk, arm, others = (turned(each) for each in place_points())
    up = sign * np.eye(3)[axis]
    cameras = looking(turned(ring(height=1.2)), turned(np.array([[0.0, 0.0, 0.3]])), up=up)
    with_arm, without = (find_box(cameras, np.concatenate([bulk, *more, others])) for more in ([arm], []))
    heights = lambda box: np.sort(box @ up)  # noqa: E731
    assert 1.0 < heights(with_arm.bounds)[1] < 1.25 and heights(without.bounds)[1] < 0.7
    sides = [each for each in range(3) if each != axis]
    for box in (with_arm.bounds, without.bounds):
        np.testing.assert_allclose(np.abs(box[:, sides]), 0.72, atol=0.1)  # the table, a tenth of its side more
    assert inside(with_arm.bounds, cameras) == 0 and [len(look.cameras) for look in with_arm.looks] == [30]
    np.testing.assert_allclose(with_arm.looks[0].point, 0.3 * up, atol=1e-6)
    level = find_box(
        looking(turned(ring(height=1.2)), turned(np.array([[0.0, 0.0, 0.3]])), up=np.eye(3)[sides[0]]),
        np.concatenate([bulk, arm, others]),
    )
    assert heights(level.bounds)[1] < 0.85  # nothing says that this is up


def test_a_room_beyond_and_a_camera_in_the_middle_do_not_move_it():
    """One camera near the place that all look at once shrank the box to nothing, and then the whole room counted."""
    bulk, arm, others = place_points()
    points = np.concatenate([bulk, arm, others])
    alone = looking(ring(), [[0, 0, 0.2]])
    near = Camera.look_at([0.03, 0.02, 0.25], [0, 5, 0.2], up=(0, 0, 1), fov_degrees=60, width=80, height=60)
    expected, found = find_box(alone, points).bounds, find_box([*alone, near], points)
    np.testing.assert_allclose(found.bounds, expected, atol=0.02)
    assert len(found.looks) == 1 and 30 not in found.looks[0].cameras and "30 of 31 cameras" in found.reason
    without = find_box([*alone, near]).bounds
    np.testing.assert_allclose(without, find_box(alone).bounds, atol=0.02)


@pytest.mark.parametrize("points", [True, False])
def test_subsets_of_the_cameras_find_the_same(points):
    random = np.random.default_rng(3)
    matter = np.concatenate(place_points()) if points else None
    eyes = ring(60) + random.normal(scale=0.2, size=(60, 3))
    cameras = looking(eyes, [0, 0, 0.2] + random.normal(scale=0.1, size=(60, 3)))
    whole = find_box(cameras, matter).bounds
    for _ in range(5):
        chosen = np.sort(random.choice(60, 36, replace=False))
        part = find_box([cameras[index] for index in chosen], matter).bounds
        assert np.abs(part - whole).max() < 0.06 * np.ptp(whole, axis=0).max()


def test_without_points_it_is_a_cube_that_no_camera_is_in():
    cameras = looking(ring(), [[0, 0, 0]])
    found = find_box(cameras)
    sides = np.ptp(found.bounds, axis=0)
    np.testing.assert_allclose(sides, sides[0])
    distance, tangent = np.hypot(3, 1), 30 / cameras[0].fx  # what fills the shorter side of a picture, and a fifth more
    np.testing.assert_allclose(sides[0] / 2, 1.2 * distance * tangent / np.hypot(1, tangent), rtol=1e-6)
    assert inside(found.bounds, cameras) == 0 and "no points" in found.reason
    close = looking(ring(radius=0.8, height=0.0), [[0, 0, 0]])
    wide = [dataclasses.replace(camera, fx=15.0, fy=15.0) for camera in close]
    assert inside(find_box(wide).bounds, wide) == 0  # pictures as wide as these show what is behind other cameras


def test_flat_matter_gets_room_but_not_around_cameras():
    random = np.random.default_rng(0)
    sheet = scattered(random, [-0.5, -0.5, -0.001], [0.5, 0.5, 0.001], 2000)
    box = find_box(looking(ring(radius=2.0, height=1.5), [[0, 0, 0]]), sheet).bounds
    assert np.ptp(box, axis=0)[2] == pytest.approx(np.ptp(box, axis=0)[0] / 2, rel=0.02)
    low = looking(ring(radius=0.9, height=0.22), [[0, 0, 0]])
    assert inside(find_box(low, sheet).bounds, low) == 0


def test_two_places_are_told():
    one, two = ring(20), ring(12, around=(0.0, 9.0, 0.0))
    cameras = looking(one, [[0, 0, 0]]) + looking(two, [[0, 9, 0]])
    found = find_box(cameras)
    np.testing.assert_allclose([look.point for look in found.looks], [[0, 0, 0], [0, 9, 0]], atol=0.02)
    counts = [len(look.cameras) for look in found.looks]
    assert sum(counts) == 32 and counts[0] in (20, 21)  # one of the second ring looks past its middle at the first
    assert f"{counts[0]} and {counts[1]} of 32 cameras look at" in found.reason and "2 places" in found.reason
    np.testing.assert_allclose(found.bounds.mean(axis=0), 0, atol=0.02)  # cameras walk between them
    assert inside(found.bounds, cameras) == 0
    beside = looking(ring(20) * [1, 1, -1], [[-1.0, 0, 0]]) + looking(ring(20), [[1.0, 0, 0]])
    both = find_box(beside)
    assert (both.bounds[0, 0] < -1 < 1 < both.bounds[1, 0]) and inside(both.bounds, beside) <= 1


def test_cameras_that_look_at_nothing_in_common_are_a_place():
    random, way = np.random.default_rng(0), np.arange(30)
    outward = looking(ring(), 2 * ring())
    steps = np.stack([0 * way, 0.3 * way, 0.02 * (-1.0) ** way], axis=1)
    walk = looking(steps, steps + random.normal(scale=0.1, size=(30, 3)) + [0, 3, 0])
    for cameras in (outward, walk):
        found = find_box(cameras)
        assert found.looks == () and "a place" in found.reason and inside(found.bounds, cameras) == 30
    turning = looking(np.zeros((12, 3)), ring(12))
    refused(lambda: find_box(turning), match="do not determine the size")


def test_parallel_cameras_look_ahead():
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 5), [-0.5, 0.5], [0.0]), axis=-1).reshape(-1, 3)
    cameras = looking(grid, grid + [0, 0, 1], up=(0, 1, 0))
    found = find_box(cameras)
    assert len(found.looks) == 1 and len(found.looks[0].cameras) == 10 and found.bounds[0, 2] > 0
    matter = scattered(np.random.default_rng(0), [-0.5, -0.5, 3], [0.5, 0.5, 4], 500)
    low, high = find_box(cameras, matter).bounds
    assert (low < matter.min(axis=0)).all() and (high > matter.max(axis=0)).all() and (high - low < 1.3).all()


def test_room_is_a_factor_and_few_points_say_nothing():
    cameras, points = looking(ring(), [[0, 0, 0.2]]), np.concatenate(place_points())
    one, wider = find_box(cameras, points).bounds, find_box(cameras, points, room=1.5).bounds
    np.testing.assert_allclose(np.ptp(wider, axis=0), 1.5 * np.ptp(one, axis=0))
    np.testing.assert_allclose(wider.mean(axis=0), one.mean(axis=0), atol=1e-9)
    few = find_box(cameras, points[:30])
    np.testing.assert_array_equal(few.bounds, find_box(cameras).bounds)


def test_given_bounds_win_and_found_ones_are_found_anew_where_the_scene_is_moved():
    points = np.concatenate(place_points())
    cameras = looking(ring(), [[0, 0, 0.2]])
    found = find_box(cameras, points)
    images = np.zeros((30, 60, 80, 3), np.float32)
    scene = Scene(images, None, cameras, bounds=found.bounds, points=points, found=found)
    turn = np.eye(4)
    turn[:2, :2] = [[np.sqrt(0.5), -np.sqrt(0.5)], [np.sqrt(0.5), np.sqrt(0.5)]]
    moved = scene.moved(turn)
    again = find_box(moved.cameras, points @ turn[:3, :3].T)
    np.testing.assert_array_equal(moved.bounds, again.bounds)
    given = dataclasses.replace(scene, bounds=[[-1, -1, -1], [1, 1, 1]]).moved(turn)
    np.testing.assert_allclose(given.bounds[:, :2], [[-np.sqrt(2)] * 2, [np.sqrt(2)] * 2])


def test_points_alone_are_those_without_others_near_them():
    random = np.random.default_rng(1)
    points = random.normal(size=(300, 3))
    apart = np.sort(np.linalg.norm(points[:, None] - points[None], axis=-1), axis=1)
    assert np.array_equal(are_inliers(points, 0.5), apart[:, 5] <= 0.5)
    assert 20 < are_inliers(points, 0.5).sum() < 280 and not are_inliers(points[:5], 1e9).any()


def test_the_picture_shows_box_points_and_cameras():
    points = np.concatenate(place_points())
    cameras = looking(ring(), [[0, 0, 0.2]])
    found = find_box(cameras, points)
    picture = draw_box(cameras, points, found)
    assert picture.dtype == np.float32 and picture.shape[1] > 2.5 * picture.shape[0] and picture.max() <= 1.0
    red = (picture[..., 0] > 0.6) & (picture[..., 1:] < 0.35).all(axis=-1)
    blue = (picture[..., 2] > 0.6) & (picture[..., 0] < 0.35)
    first = slice(8, 408)  # along z: the box in the middle of the ring
    rows, columns = np.nonzero(red[first, first])
    wide, high = np.ptp(columns) / np.ptp(np.nonzero(blue[first, first])[1]), np.ptp(rows) / np.ptp(columns)
    sides = np.ptp(found.bounds, axis=0)
    assert wide == pytest.approx(sides[0] / 6.0, rel=0.05) and high == pytest.approx(sides[1] / sides[0], rel=0.05)
    assert blue.sum() > 100 and not blue[first, first][rows.min() : rows.max(), columns.min() : columns.max()].any()
    dark = picture[415:].max(axis=-1) < 0.4  # a line of text below
    assert dark.sum() > 200
    assert draw_box(cameras, None, find_box(cameras)).shape[1] == picture.shape[1]
