"""Casual captures that the project makes: their cameras are true, and what is said about their pictures holds."""

import dataclasses
import functools

import numpy as np
import pytest
from ground_truth import CASUAL, casual_scene, casual_views
from refusals import refused

from warpcage import Camera

SMALL = {"views": 12, "aside": 2, "size": 32, "samples": 1}

#: The largest difference of 8 bits.
HALF_STEP = 0.5 / 255 + 1e-6


@functools.cache
def made(name, device):
    return casual_scene(name, device=device, **SMALL)


def views_of(train, test):
    """Pictures and cameras by their names."""
    return {
        name: (image, camera)
        for scene in (train, test)
        for name, image, camera in zip(scene.names, scene.images, scene.cameras, strict=True)
    }


def again(name, views, device):
    """Sharp pictures of an exposure of 1 from the cameras of views."""
    return casual_views(name, [camera for _, camera in views], samples=1, device=device)


def point_error(scenes, degrees=0.0):
    """Median difference of the points' colours to the pixels that they fall into, of cameras that are turned."""
    differences = []
    scene = scenes[0]
    for image, taken in views_of(*scenes).values():
        camera = turned(taken, degrees)
        places, depth = camera.project(scene.points)
        x, y = np.floor(places).astype(int).T
        seen = (depth > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
        differences += list(np.abs(image[y[seen], x[seen]] - scene.point_colors[seen]).mean(axis=1))
    return np.median(differences)


def turned(camera, degrees):
    """The camera turned about its own axis of height."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, 0, s, 0], [0, 1, 0, 0], [-s, 0, c, 0], [0, 0, 0, 1]])
    return dataclasses.replace(camera, camera_to_world=camera.camera_to_world @ turn)


@pytest.mark.parametrize("name", list(CASUAL))
def test_pictures_are_whole_and_held_out_ones_are_others(device, name):
    train, test = made(name, device)
    assert train.alphas is None and test.alphas is None and train.bounds is None
    assert test.names == ["path_0000", "path_0008", "aside_00", "aside_01"]
    assert set(train.names) == {f"path_{k:04d}" for k in range(12)} - set(test.names)
    wide, high = CASUAL[name].shape
    assert train.images.shape[1:3] == (round(32 * high / max(wide, high)), round(32 * wide / max(wide, high)))
    centers = np.array([camera.center for camera in train.cameras])
    away = [np.linalg.norm(centers - camera.center, axis=1).min() for camera in test.cameras]
    assert min(away[2:]) > 0.3 and min(away) > 0.02
    assert np.ptp(train.images, axis=(1, 2)).min() > 0.1 and train.images.max() <= 1.0


@pytest.mark.parametrize("name", list(CASUAL))
def test_points_are_where_cameras_see_them(device, name):
    assert point_error(made(name, device)) < 0.75 * point_error(made(name, device), degrees=5.0)


@pytest.mark.parametrize("name", [name for name in CASUAL if not CASUAL[name].rolls])
def test_cameras_take_the_pictures_again(device, name):
    views = list(views_of(*made(name, device)).values())
    assert np.abs(again(name, views, device) - [image for image, _ in views]).max() < HALF_STEP


def test_a_ball_is_where_cameras_look_for_it(device):
    """The pixel of its middle is red, unless another object is before it."""
    vertices, faces, colors = CASUAL["lamp"].place()
    red = (colors[:, 0] > 0.55) & (colors[:, 1] < 0.1)
    ball = vertices[faces[red]].reshape(-1, 3)
    middle = 0.5 * (ball.min(axis=0) + ball.max(axis=0))
    found = []
    for image, camera in views_of(*made("lamp", device)).values():
        ((x, y),), _ = camera.project([middle])
        red, green, blue = image[int(y), int(x)]
        found.append(red > 2.0 * max(green, blue) and red > 0.1)
    assert np.mean(found) > 0.8


def test_the_seed_says_all(device):
    options = {**SMALL, "views": 3}
    first, same, other = (casual_scene("handheld", seed=seed, device=device, **options) for seed in (1, 1, 2))
    for one, two in zip(first, same, strict=True):
        assert (one.images == two.images).all() and (one.points == two.points).all()
    assert not (first[0].images == other[0].images).any(axis=-1).all()
    assert np.abs(first[0].cameras[0].center - other[0].cameras[0].center).max() > 0.01


def test_exposures_roll_about_those_of_the_place(device):
    views = views_of(*made("narrow", device))
    logs = {}
    for (name, (image, _)), truth in zip(views.items(), again("narrow", views.values(), device), strict=True):
        clear = (truth > 0.2) & (image < 0.99)
        ratio = image[clear] / truth[clear]
        assert np.abs(ratio - np.median(ratio)).max() < 0.01  # of 8 bits
        logs[name] = np.log(np.median(ratio))
    path = np.array([logs[f"path_{k:04d}"] for k in range(12)])
    train = np.arange(12) % 8 != 0
    rolls = CASUAL["narrow"].rolls
    assert abs(path[train].mean()) < 2e-3 and np.abs(path).max() <= rolls + 2e-3
    assert np.ptp(path) > 0.5 * rolls and np.abs(np.diff(path)).max() < 0.75 * np.ptp(path)
    assert max(abs(logs["aside_00"]), abs(logs["aside_01"])) < 2e-3


def steepness(image):
    return np.abs(np.diff(image / image.mean(), axis=1)).mean()


def test_blurred_pictures_have_the_mean_of_their_poses(device):
    capture, views = CASUAL["handheld"], views_of(*made("handheld", device))
    route = dataclasses.replace(capture.route, seed=0)
    sharp = again("handheld", views.values(), device)
    detail = {
        name: steepness(image) / steepness(truth)
        for (name, (image, _)), truth in zip(views.items(), sharp, strict=True)
    }
    blurred, others = ("path_0005", "path_0011"), [f"path_{k:04d}" for k in (3, 4, 6, 7, 9, 10)]
    assert max(detail[name] for name in blurred) < 0.9 * min(detail[name] for name in others)
    for name in blurred:
        frame, camera = int(name[-4:]), views[name][1]
        half = 0.5 * (capture.exposure + capture.readout)
        poses = np.array([route.pose((frame + shift) / 11) for shift in np.linspace(-half, half, 31)])
        # a mean lies within what the phone does, and its rotation does not leave that of the middle
        assert (camera.center >= poses[:, :3, 3].min(axis=0)).all()
        assert (camera.center <= poses[:, :3, 3].max(axis=0)).all()
        middle = Camera(1, 1, 0, 0, 1, 1, route.pose(frame / 11))
        assert np.trace(camera.rotation.T @ middle.rotation) > 1 + 2 * np.cos(np.radians(0.5))


def test_what_no_capture_can_be():
    for name, options, message in (
        ("garden", {}, "not known"),
        ("table", {"views": 1}, "2 views"),
        ("table", {"size": 8}, "16 pixels or more"),
        ("table", {"aside": 0}, "needs views"),
    ):
        refused(functools.partial(casual_scene, name, **options), match=message)
    refused(lambda: casual_views("garden", []), match="not known")
