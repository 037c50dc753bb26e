"""Cameras, and NeRF-synthetic folders of hand-written values."""

import json

import imageio.v3 as iio
import numpy as np
import pytest
from refusals import refused

import warpcage
from warpcage import Camera, load_scene, turntable


def write_folder(folder, images, *, angle=0.8, split="train", poses=None, **changes):
    (folder / split).mkdir(parents=True, exist_ok=True)
    frames = []
    for i, image in enumerate(images):
        iio.imwrite(folder / split / f"r_{i}.png", image)
        pose = np.eye(4) if poses is None else poses[i]
        frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": np.asarray(pose).tolist()})
    content = {"camera_angle_x": angle, "frames": frames, **changes}
    (folder / f"transforms_{split}.json").write_text(json.dumps(content))


def rgba(height=8, width=12, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 4), dtype=np.uint8)


def test_loader_composites_and_reads_cameras(tmp_path):
    pose = np.eye(4)
    pose[:3, 3] = [1, 2, 3]
    images = [rgba(seed=0), rgba(seed=1)]
    write_folder(tmp_path, images, poses=[pose, pose])
    scene = load_scene(tmp_path, background=(0.1, 0.2, 0.3))
    alpha = images[1][..., 3:] / 255
    expected = images[1][..., :3] / 255 * alpha + (1 - alpha) * np.array([0.1, 0.2, 0.3])
    np.testing.assert_allclose(scene.images[1], expected, atol=1e-6)
    np.testing.assert_allclose(scene.alphas[1], alpha[..., 0], atol=1e-6)
    camera = scene.cameras[0]
    assert camera.fx == camera.fy == pytest.approx(0.5 * 12 / np.tan(0.4))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (6, 4, 12, 8)
    np.testing.assert_allclose(camera.center, [1, 2, 3])
    # Blender looks along -z with +y up
    np.testing.assert_allclose(camera.rotation @ [0, 0, 1], [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(camera.rotation @ [0, 1, 0], [0, -1, 0], atol=1e-12)
    assert scene.names == ["r_0", "r_1"] and len(scene) == 2


@pytest.mark.parametrize("factor", [2, 4, 3])
def test_downscale_averages_premultiplied_color(tmp_path, factor):
    image = rgba()
    write_folder(tmp_path, [image])
    scene = load_scene(tmp_path, downscale=factor, background="black")
    straight = image.astype(np.float64) / 255
    premultiplied = straight[..., :3] * straight[..., 3:]
    height, width = round(8 / factor), round(12 / factor)
    assert scene.images.shape == (1, height, width, 3)
    # the mean of the whole picture is kept, and each cell is the mean over its own area
    np.testing.assert_allclose(scene.images[0].mean(axis=(0, 1)), premultiplied.mean(axis=(0, 1)), atol=1e-6)
    if 8 % factor == 0:
        np.testing.assert_allclose(
            scene.images[0, 0, 1], premultiplied[:factor, factor : 2 * factor].mean(axis=(0, 1)), atol=1e-6
        )
    full = load_scene(tmp_path).cameras[0]
    assert scene.cameras[0].fx / full.fx == pytest.approx(width / 12)


def test_real_scene(real_data):
    scene = load_scene(real_data / "lego_800", split="test", downscale=8)
    assert scene.images.shape == (13, 100, 100, 3)
    np.testing.assert_allclose([np.linalg.norm(c.center) for c in scene.cameras], 4.0311, atol=1e-3)


def test_bad_arguments(tmp_path):
    write_folder(tmp_path, [rgba()])
    refused(lambda: load_scene(tmp_path, split="val"), match="splits: train", error=FileNotFoundError)
    refused(lambda: load_scene(tmp_path / "none"), match="is not there", error=FileNotFoundError)
    (tmp_path / "file.txt").write_text("")
    with pytest.raises(FileNotFoundError, match="scene folder .*file.txt' is a file"):
        load_scene(tmp_path / "file.txt")
    refused(lambda: load_scene(tmp_path, downscale=0), match="downscale")
    refused(lambda: load_scene(tmp_path, background="transparent"), match="background")
    refused(lambda: load_scene(tmp_path, format="other"), match="not known")


def test_a_scene_is_told_in_one_short_line():
    camera = Camera(10, 10, 2, 1.5, 4, 3, np.eye(4))
    assert repr(warpcage.Scene(np.zeros((1, 3, 4, 3)), None, [camera])) == "Scene(1 pictures of 4x3)"
    alphas = np.ones((1, 3, 4))
    split = warpcage.Scene(np.zeros((1, 3, 4, 3)), alphas, [camera], surroundings=np.zeros((1, 3, 4, 3)))
    assert repr(split) == "Scene(1 pictures of 4x3, alphas, surroundings)"


def test_scene_refuses_what_does_not_fit():
    camera = Camera.look_at([3, 0, 0], [0, 0, 0], width=4, height=4)
    refused(lambda: warpcage.Scene(np.full((1, 4, 4, 3), np.nan), None, [camera]), match="finite")
    refused(lambda: warpcage.Scene(np.zeros((1, 4, 5, 3)), None, [camera]), match="4x4, images are 5x4")
    refused(lambda: warpcage.Scene(np.zeros((1, 4, 4, 3)), None, [camera] * 2), match="1 images, 2 cameras")


def test_camera_projects_its_own_rays():
    camera = Camera(50, 60, 11, 9, 24, 20, Camera.look_at([2, 1, 3], [0.3, 0, 0]).camera_to_world)
    origins, directions = camera.rays()
    pixels, depth = camera.project((origins + 2.5 * directions).reshape(-1, 3))
    rows, columns = np.mgrid[:20, :24]
    np.testing.assert_allclose(pixels, np.stack([columns + 0.5, rows + 0.5], -1).reshape(-1, 2), atol=1e-9)
    assert (depth > 0).all()
    np.testing.assert_allclose(camera.project([[0.3, 0, 0]])[0], [[11, 9]], atol=1e-9)  # looks at its target
    up = camera.project([[0.3, 0, 0.5]])[0]
    assert up[0, 1] < 9  # +z is up in the picture


def test_camera_resized_and_moved():
    camera = Camera.look_at([2, 1, 3], [0, 0, 0], width=20, height=10)
    half = camera.resized(10, 5)
    points = np.random.default_rng(0).normal(size=(5, 3)) * 0.3
    np.testing.assert_allclose(half.project(points)[0] * 2, camera.project(points)[0])
    transform = Camera.look_at([0, 5, 1], [1, 0, 0]).camera_to_world
    moved = points @ transform[:3, :3].T + transform[:3, 3]
    np.testing.assert_allclose(camera.moved(transform).project(moved)[0], camera.project(points)[0])


def test_turntable_goes_round():
    cameras = turntable([1, 2, 3], 4.0, 20, 8)
    centers = np.stack([c.center for c in cameras]) - [1, 2, 3]
    np.testing.assert_allclose(np.linalg.norm(centers, axis=1), 4.0)
    np.testing.assert_allclose(centers[:, 2], 4 * np.sin(np.radians(20)))
    np.testing.assert_allclose(centers[0, :2], -centers[4, :2], atol=1e-12)


@pytest.mark.parametrize(
    "changes, word",
    [
        ({"fx": 0.0}, "focal"),
        ({"width": 0}, "whole number of at least 1"),
        ({"camera_to_world": np.eye(3)}, "4, 4"),
        ({"camera_to_world": np.diag([1, 1, -1, 1.0])}, "rotation"),
    ],
)
def test_bad_cameras(changes, word):
    good = {"fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "width": 2, "height": 2, "camera_to_world": np.eye(4)}
    refused(lambda: Camera(**{**good, **changes}), match=word)
