"""Scenes written as nerfstudio has them: pictures, cameras, masks, points and ignored pixels come back."""

import json

import numpy as np
import pytest
from refusals import refused

from warpcage import Camera, Scene, load_scene
from warpcage.view import read_image

COUNT, HEIGHT, WIDTH = 5, 18, 24
BACKGROUND = np.array([0.2, 0.6, 0.9], np.float32)


def cameras(sizes=None):
    random = np.random.default_rng(1)
    found = []
    for k in range(COUNT):
        width, height = (WIDTH, HEIGHT) if sizes is None else sizes[k]
        turn = Camera.look_at(random.normal(size=3) * 3, (0, 0, 0), fov_degrees=50, width=width, height=height)
        found.append(Camera(31.3 + k, 30.7, 11.25, 9.5, width, height, turn.camera_to_world))
    return found


def parts(with_alphas):
    random = np.random.default_rng(0)
    colors = random.random((COUNT, HEIGHT, WIDTH, 3)).astype(np.float32)
    alphas = np.clip(random.random((COUNT, HEIGHT, WIDTH)) * 1.6 - 0.3, 0.0, 1.0).astype(np.float32)
    images = colors * alphas[..., None] + (1.0 - alphas[..., None]) * BACKGROUND if with_alphas else colors
    return {"images": images, "alphas": alphas if with_alphas else None, "background": BACKGROUND}


def back(scene, tmp_path, **options):
    scene.save(tmp_path / "out")
    read = load_scene(tmp_path / "out", split="all", background=BACKGROUND, format="transforms", **options)
    assert read.names == scene.names
    for one, two in zip(read.cameras, scene.cameras, strict=True):
        np.testing.assert_allclose(one.camera_to_world, two.camera_to_world, atol=1e-12)
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(one, name) == getattr(two, name)
    return read


@pytest.mark.parametrize("captured", [False, True])
@pytest.mark.parametrize("with_alphas", [False, True])
def test_pictures_and_cameras_come_back(tmp_path, with_alphas, captured):
    scene = Scene(cameras=cameras(), captured=captured and with_alphas, **parts(with_alphas))
    read = back(scene, tmp_path)
    np.testing.assert_allclose(read.images, scene.images, atol=2.1 / 255)
    assert (read.alphas is None) == (not with_alphas) and read.captured == scene.captured
    if with_alphas:
        np.testing.assert_allclose(read.alphas, scene.alphas, atol=0.51 / 255)
    document = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert ("mask_path" in document["frames"][0]) == scene.captured
    first = np.array(document["frames"][0]["transform_matrix"])
    # OpenGL's axes: y up and z backward
    np.testing.assert_allclose(first[:3, :3], scene.cameras[0].camera_to_world[:3, :3] * [1, -1, -1], atol=1e-12)
    picture = read_image(tmp_path / "out" / document["frames"][0]["file_path"])
    assert picture.shape == (HEIGHT, WIDTH, 4 if with_alphas and not captured else 3)


def test_what_masks_split_off_is_in_the_pictures(tmp_path):
    given = parts(True)
    whole = np.random.default_rng(3).random(given["images"].shape).astype(np.float32)
    alphas = given["alphas"][..., None]
    given["images"] = whole * alphas + (1.0 - alphas) * BACKGROUND
    scene = Scene(cameras=cameras(), captured=True, surroundings=whole * (1.0 - alphas), **given)
    read = back(scene, tmp_path, masks="split")
    np.testing.assert_allclose(read.whole, whole, atol=2.1 / 255)
    np.testing.assert_allclose(read.surroundings, scene.surroundings, atol=2.1 / 255)


def test_points_the_world_they_come_from_and_ignored_pixels(tmp_path):
    random = np.random.default_rng(2)
    points, colors = random.normal(size=(30, 3)) + 1e5, random.integers(0, 256, (30, 3)) / 255.0
    weights = np.ones((COUNT, HEIGHT, WIDTH), np.float32)
    weights[1, 3:9, 5:12] = 0.0
    source = np.array([[0, -2.0, 0, 3], [2, 0, 0, 1], [0, 0, 2, -5], [0, 0, 0, 1]])
    scene = Scene(
        cameras=cameras(), **parts(False), points=points, point_colors=colors, weights=weights, to_source=source
    )
    read = back(scene, tmp_path)
    np.testing.assert_array_equal(read.points, points)
    np.testing.assert_allclose(read.point_colors, colors, atol=1e-6)
    np.testing.assert_allclose(read.to_source, source, atol=1e-12)
    np.testing.assert_array_equal(read.weights, weights)


def test_pictures_of_several_sizes(tmp_path):
    sizes = [(WIDTH, HEIGHT), (20, 18), (24, 10), (WIDTH, HEIGHT), (12, 9)]
    given = parts(False)
    weights = np.zeros((COUNT, HEIGHT, WIDTH), np.float32)
    for k, (width, height) in enumerate(sizes):
        weights[k, :height, :width] = 1.0
    scene = Scene(cameras=cameras(sizes), **given, weights=weights)
    read = back(scene, tmp_path)
    for k in range(COUNT):
        np.testing.assert_allclose(read.cut(k, read.images[k]), scene.cut(k, scene.images[k]), atol=0.51 / 255)


def test_names_that_no_file_can_have_and_folders_that_hold_something(tmp_path):
    names = ["a/b", "../c", "a_b", "d e", "..."]
    scene = Scene(cameras=cameras(), **parts(False), names=names)
    scene.save(tmp_path / "out")
    assert len(list((tmp_path / "out" / "images").iterdir())) == COUNT
    assert len(load_scene(tmp_path / "out", split="all")) == COUNT
    refused(lambda: scene.save(tmp_path / "out"), match="empty folder")
