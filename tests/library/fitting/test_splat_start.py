"""Where fits of splats begin: at points of the capture, inside silhouettes, at places that views share."""

import dataclasses

import numpy as np
import pytest

from warpcage import Camera, Scene, turntable
from warpcage.fitting.splats import fitted_scene, scene_units, starting_splats
from warpcage.fitting.splats.start import QUICK_FIT
from warpcage.view.motion import axis_rotation

SIZE = 48
GAPS = 43  # far places more than 216 points, where pictures have none: a fifth
CENTER = np.array([10.0, -3.0, 2.0])


def cameras_around(count=8, distance=4.0, size=SIZE, target=CENTER):
    """Two rings of cameras, above and below."""
    options = {"fov_degrees": 50, "width": size, "height": size}
    below = turntable(target, distance, -25, count // 2, **options)
    return below + turntable(target, distance, 35, count // 2, start_degrees=20.0, **options)


def plain_scene(cameras, color=(0.2, 0.5, 0.8), **options):
    first = cameras[0]
    images = np.broadcast_to(np.float32(color), (len(cameras), first.height, first.width, 3))
    return Scene(images, None, cameras, **options)


def ball_scene(radius, color=(0.9, 0.3, 0.1), count=24, **options):
    """A ball of one colour on a blue background, every pixel whose ray meets it opaque."""
    cameras, background = cameras_around(count), np.array([0.0, 0.2, 1.0], np.float32)
    alphas = np.empty((count, SIZE, SIZE), np.float32)
    for alpha, camera in zip(alphas, cameras, strict=True):
        origins, directions = camera.rays()
        offset = origins - CENTER
        nearest = offset - (offset * directions).sum(axis=-1, keepdims=True) * directions
        alpha[:] = np.linalg.norm(nearest, axis=-1) < radius
    images = alphas[..., None] * np.float32(color) + (1.0 - alphas[..., None]) * background
    return Scene(images, alphas, cameras, background, **options)


def lattice(side, count=6):
    return CENTER + side * (np.indices((count,) * 3).reshape(3, -1).T - 0.5 * (count - 1))


def start_of(scene, most=200_000, seed=0, device="cpu", kind="auto"):
    start = starting_splats(scene, most=most, seed=seed, device=device, kind=kind)
    assert start.centers.dtype == np.float64 and start.colors.dtype == start.log_scales.dtype == np.float32
    assert start.centers.shape == start.colors.shape == (*start.log_scales.shape, 3)
    assert np.isfinite(start.centers).all() and np.isfinite(start.log_scales).all()
    assert start.colors.min() >= 0.0 and start.colors.max() <= 1.0
    return start


def views_with(scene, places):
    """How many cameras have each place in their picture, by their matrices."""
    counts = np.zeros(len(places), int)
    for camera in scene.cameras:
        to_camera = np.linalg.inv(camera.camera_to_world)
        x, y, z = (places @ to_camera[:3, :3].T + to_camera[:3, 3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        counts += (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return counts


def test_splats_lie_at_the_points_as_large_as_their_neighbors_are_far():
    points = lattice(0.07)
    colors = np.random.default_rng(0).random((len(points), 3), np.float32)
    start = start_of(plain_scene(cameras_around(), points=points, point_colors=colors))
    assert np.array_equal(start.centers[:216], points) and np.array_equal(start.colors[:216], colors)
    np.testing.assert_allclose(start.log_scales[:216], np.log(0.07), atol=1e-6)  # corners have three neighbours too
    assert start.source == f"216 points of the capture and {GAPS} far places where pictures have none"
    # each size is the root mean square of three distances
    points = CENTER + np.random.default_rng(0).normal(size=(150, 3))
    apart = np.sort(np.linalg.norm(points[:, None] - points, axis=-1), axis=1)[:, 1:4]
    start = start_of(plain_scene(cameras_around(), points=points))
    np.testing.assert_allclose(np.exp(start.log_scales[:150]), np.sqrt((apart**2).mean(axis=1)), rtol=1e-5)


def test_many_points_are_drawn_from():
    points = lattice(0.07, 12)
    colors = (points - points.min(axis=0)) / np.ptp(points, axis=0)
    scene = plain_scene(cameras_around(), points=points, point_colors=colors)
    start = start_of(scene, most=500)
    assert len(np.unique(start.centers, axis=0)) == 500 and start.source == "500 of 1,728 points of the capture"
    np.testing.assert_allclose(start.colors, (start.centers - points.min(axis=0)) / np.ptp(points, axis=0), atol=1e-6)
    assert np.array_equal(start_of(scene, most=500).centers, start.centers)
    assert not np.array_equal(start_of(scene, most=500, seed=1).centers, start.centers)


def test_points_on_each_other_and_far_off():
    points = np.concatenate([np.repeat(CENTER[None], 80, axis=0), lattice(0.1, 4), CENTER + [[1e6, 0, 0]]])
    start = start_of(plain_scene(cameras_around(), points=points))
    count = len(points) - 1  # no camera sees the last one
    assert len(start.centers) == count + count // 5 and np.array_equal(start.centers[:count], points[:-1])
    assert np.exp(start.log_scales).min() > 1e-5
    same = start_of(plain_scene(cameras_around(), points=np.repeat(CENTER[None], 120, axis=0)))
    assert 1e-4 < np.exp(same.log_scales[:120]).max() < 1.0


def test_colors_that_points_lack_are_those_of_the_pictures():
    cameras = cameras_around()
    pictures = np.zeros((len(cameras), SIZE, SIZE, 3), np.float32)
    pictures[:, : SIZE // 2] = (0.0, 1.0, 0.5)  # the upper half
    pictures[:, SIZE // 2 :] = (0.5, 0.0, 0.0)
    points = np.concatenate([lattice(0.01) + [0, 0, 0.5], lattice(0.01) - [0, 0, 0.5], lattice(0.01) + [0, 0, 900]])
    start = start_of(Scene(pictures, None, cameras, points=points))
    np.testing.assert_allclose(start.colors[:216], np.broadcast_to([0.0, 1.0, 0.5], (216, 3)), atol=1e-6)
    np.testing.assert_allclose(start.colors[216:432], np.broadcast_to([0.5, 0.0, 0.0], (216, 3)), atol=1e-6)
    np.testing.assert_array_equal(start.colors[432:648], 0.5)  # in no picture


def test_where_pictures_have_no_points_places_lie_on_their_rays():
    # points on the lower half of the pictures alone; each pixel of the upper half has a colour of its own
    cameras = cameras_around(2)
    pictures = np.full((2, SIZE, SIZE, 3), 0.2, np.float32)
    pictures[:, :, :, :2] = np.moveaxis(np.indices((SIZE, SIZE)), 0, -1) / SIZE
    pictures[1, :, :, 2] = 0.7
    rows, columns = (each.ravel() + 0.5 for each in np.mgrid[SIZE // 2 : SIZE : 2, 0:SIZE:2])
    ahead = [((columns - each.cx) / each.fx, (rows - each.cy) / each.fy, np.ones(len(rows))) for each in cameras]
    places = zip(cameras, ahead, strict=True)
    points = np.concatenate([each.center + 4 * np.stack(local, axis=1) @ each.rotation.T for each, local in places])
    scene = Scene(pictures, None, cameras, points=points, point_colors=np.full((len(points), 3), 0.5))
    start = start_of(scene)
    added, colors = start.centers[len(points) :], start.colors[len(points) :]
    assert len(added) == int(0.2 * len(points)) and np.array_equal(start.centers[: len(points)], points)
    cell, found = SIZE / 24, 0
    for view, camera in enumerate(cameras):
        mine = np.isclose(colors[:, 2], pictures[view, 0, 0, 2])
        pixels, depths = camera.project(added[mine])
        np.testing.assert_allclose(colors[mine, 0], pixels[:, 1].astype(int) / SIZE, atol=1e-6)
        np.testing.assert_allclose(colors[mine, 1], pixels[:, 0].astype(int) / SIZE, atol=1e-6)
        assert (pixels[:, 1] < SIZE / 2 - cell).all()  # not beside a point either
        away = np.linalg.norm(added[mine] - camera.center, axis=1)
        assert (depths > 0.0).all()
        np.testing.assert_allclose(away, 80.0)  # 20 times the cameras' distance
        np.testing.assert_allclose(np.exp(start.log_scales[len(points) :][mine]), away * cell / camera.fx, rtol=1e-5)
        found += mine.sum()
    assert found == len(added)
    assert np.array_equal(start_of(scene).centers, start.centers)
    counted = np.ones((2, SIZE, SIZE), np.float32)
    counted[1] = 0.0
    ignored = start_of(dataclasses.replace(scene, weights=counted))
    assert (ignored.colors[len(points) :, 2] == np.float32(0.2)).all() and len(ignored.centers) > len(points)
    assert len(start_of(scene, most=len(points) + 7).centers) == len(points) + 7
    assert np.array_equal(start_of(scene, kind="points").centers, points)


def test_pictures_full_of_points_and_objects_alone_get_no_more_places():
    near = cameras_around(2)
    full = CENTER + np.random.default_rng(0).uniform(-3, 3, (6000, 3))
    assert start_of(plain_scene(near, points=full)).source == "6,000 points of the capture"
    inside = ball_scene(0.5, points=lattice(0.05))
    assert len(start_of(inside).centers) == len(inside.points)


def test_points_outside_the_silhouettes_are_left_out():
    inside, outside = lattice(0.05), lattice(0.05) + [0, 0, 1.2]
    both = {"points": np.concatenate([inside, outside])}
    start = start_of(ball_scene(0.5, **both))
    assert np.array_equal(start.centers, inside)
    np.testing.assert_allclose(start.colors, np.broadcast_to([0.9, 0.3, 0.1], inside.shape), atol=1e-6)
    split = ball_scene(0.5, **both)
    around = (1.0 - split.alphas[..., None]) * np.float32([0.1, 0.6, 0.1])
    whole = start_of(fitted_scene(dataclasses.replace(split, surroundings=around)))
    count = len(both["points"])
    assert np.array_equal(whole.centers[:count], both["points"])  # what is around the object is fitted too
    assert np.abs(whole.colors[: len(inside)] - [0.9, 0.3, 0.1]).max() < 1e-6
    assert np.abs(whole.colors[len(inside) : count] - [0.1, 0.6, 0.1]).mean() < 0.1


@pytest.mark.parametrize("points", [None, lattice(0.05, 3), lattice(0.05) + [0, 0, 1.2]])
def test_without_points_splats_begin_inside_the_silhouettes(points):
    radius = 0.6
    start = start_of(ball_scene(radius, points=points), most=20_000)
    assert len(start.centers) == 20_000 and start.source == "20,000 random places inside the silhouettes"
    away = np.linalg.norm(start.centers - CENTER, axis=1) / radius
    pixel = 4.0 * 2 * np.tan(np.radians(25)) / SIZE  # at the ball
    assert away.max() < 1.2 + pixel / radius  # the hull of two rings of views is a little larger than the ball
    for low, high in ((0.0, 0.5), (0.5, 0.8), (0.8, 0.95)):  # evenly
        share = ((away > low) & (away < high)).sum() / (away < 0.95).sum()
        assert share == pytest.approx((high**3 - low**3) / 0.95**3, abs=0.02)
    inner = away < 0.9
    np.testing.assert_allclose(start.colors[inner], np.broadcast_to([0.9, 0.3, 0.1], (inner.sum(), 3)), atol=1e-5)
    spacing = (4 / 3 * np.pi * radius**3 / 20_000) ** (1 / 3)
    assert 0.4 * spacing < np.exp(np.median(start.log_scales)) < 1.2 * spacing


def test_more_views_than_are_carved_by():
    start = start_of(ball_scene(0.6, count=80), most=1000)
    assert np.linalg.norm(start.centers - CENTER, axis=1).max() < 0.85


def test_transparent_pictures_have_no_start():
    scene = ball_scene(0.6)
    with pytest.raises(ValueError, match="transparent"):
        starting_splats(dataclasses.replace(scene, alphas=np.zeros_like(scene.alphas)), most=1000, seed=0)


def test_whole_pictures_begin_where_three_views_look():
    scene = plain_scene(cameras_around())
    start = start_of(scene, most=5000, kind="random")
    assert len(start.centers) == 5000 and start.source == "5,000 random places that several views see"
    assert views_with(scene, start.centers).min() >= 3
    places = np.stack([camera.center for camera in scene.cameras])
    nearest = np.linalg.norm(start.centers[:, None] - places, axis=-1).min(axis=1)
    assert nearest.min() > 0.05 * 4.0 and nearest.max() < 10.1 * 4.0
    np.testing.assert_allclose(start.colors, np.broadcast_to([0.2, 0.5, 0.8], (5000, 3)), atol=1e-6)
    # places are near in many views and far in few
    away = np.linalg.norm(start.centers - CENTER, axis=1)
    assert 0.2 < np.median(away) / 4.0 < 3.0


def test_few_views_and_views_that_share_nothing():
    eyes = [(0, 0, 0), (100, 0, 0), (0, 100, 0), (0, 0, 100)]
    away = [Camera.look_at(eye, 2 * np.array(eye) + [0, 1e-3, 1], fov_degrees=30, width=9, height=9) for eye in eyes]
    for cameras, least in ((cameras_around()[:1], 1), (cameras_around()[:2], 2), (away, 1)):
        scene = plain_scene(cameras)
        start = start_of(scene, most=500)
        assert len(start.centers) == 500 and views_with(scene, start.centers).min() >= least


@pytest.mark.parametrize("kind", ["points", "hull", "views"])
def test_a_seed_makes_the_same_start(device, kind, monkeypatch):
    """To the bit; but those of views are seen in a quick fit of voxels, which is not the same on CUDA twice."""
    for name in ("max_resolution", "max_outer_resolution"):
        monkeypatch.setitem(QUICK_FIT, name, 16)
    scene = {
        "points": plain_scene(cameras_around(), points=lattice(0.07)),
        "hull": ball_scene(0.6, count=8),
        "views": dataclasses.replace(ball_scene(0.6, count=8), alphas=None),
    }[kind]
    one, same, other = (start_of(scene, most=200, seed=seed, device=device) for seed in (3, 3, 4))
    assert one.centers.shape == same.centers.shape
    for field in dataclasses.fields(one) if (device, kind) != ("cuda:0", "views") else ():
        assert np.array_equal(getattr(one, field.name), getattr(same, field.name)), field.name
    assert not np.array_equal(one.centers, other.centers)


def test_units_of_a_ring():
    scene = plain_scene(turntable(CENTER, 5.0, 30, 12, width=8, height=8))
    focus, unit, extent = scene_units(scene)
    np.testing.assert_allclose(focus, CENTER, atol=1e-9)
    assert unit == pytest.approx(5.0) and extent == pytest.approx(1.1 * np.cos(np.radians(30)))
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = axis_rotation(np.array([0.6, 0, 0.8]), 1.0), (5, 0, -2)
    moved_focus, *same = scene_units(scene.moved(motion))
    np.testing.assert_allclose(moved_focus, motion[:3, :3] @ CENTER + motion[:3, 3], atol=1e-9)
    np.testing.assert_allclose(same, [unit, extent])
    larger = plain_scene(turntable(CENTER, 50.0, 30, 12, width=8, height=8))
    np.testing.assert_allclose(scene_units(larger)[1:], [50.0, extent])


def shifted(eyes, directions):
    views = zip(eyes, directions, strict=True)
    return plain_scene([Camera.look_at(eye, np.add(eye, ahead), width=8, height=8) for eye, ahead in views])


def test_units_of_parallel_single_and_turning_cameras():
    eyes = np.array([[x, y, 7.0] for x in range(3) for y in range(4)], float)
    down = np.tile([0.0, 0, -1], (12, 1))
    focus, unit, extent = scene_units(shifted(eyes, down))
    assert focus[2] < 7.0 and np.allclose(focus[:2], [1.0, 1.5]) and 1.0 < unit < 30.0 and 0.1 <= extent < 1.1
    from_bounds = dataclasses.replace(shifted(eyes, down), bounds=[[0, 0, -1], [2, 3, 1]])
    np.testing.assert_allclose(scene_units(from_bounds)[0], [1, 1.5, 0])
    apart = down + 0.05 * (eyes - eyes.mean(axis=0)) * [1, 1, 0]  # nearly parallel, they meet 20 behind
    focus, unit, _ = scene_units(shifted(eyes, apart))
    assert focus[2] < 7.0 and 1.0 < unit < 30.0
    four_ways = [[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]
    for scene in (shifted(eyes[:1], down[:1]), shifted(np.zeros((4, 3)), four_ways)):
        focus, unit, extent = scene_units(scene)
        assert np.isfinite(focus).all() and unit == pytest.approx(1.0) and extent == pytest.approx(0.1)
    turn = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    outward = np.stack([np.cos(turn), np.sin(turn), np.zeros(12)], axis=1)
    _, unit, extent = scene_units(shifted(0.3 * outward, outward))  # a handheld circle in the middle of a room
    assert unit == pytest.approx(0.3) and extent == pytest.approx(1.1)
