"""Cameras found of videos and pictures that the project ray casts, against the true ones."""

import dataclasses
import json

import numpy as np
import pytest
from fit_oracles import poses_of
from ground_truth import PhonePath, write_phone_video
from PIL import Image
from runs import require_same_film
from scenes import PHONE_VIDEO, camera_errors, found_poses, relative_errors, save_pictures, similarity
from test_capture_video import turn_video

import warpcage
from warpcage.mesh import read_ply
from warpcage.studio.captures import scan_video

pytest.importorskip("pycolmap", minversion="4.2")


@pytest.fixture(scope="module")
def walk(phone_video, tmp_path_factory):
    """The folder of the scene of the phone's video, the report, and the true cameras of all frames."""
    folder = tmp_path_factory.mktemp("scene") / "scene"
    return folder, warpcage.capture(phone_video[0], folder, frames=18, progress=False), phone_video[1]


@pytest.mark.nightly
def test_the_kept_video_is_what_is_ray_cast_now(phone_video, tmp_path):
    """Otherwise: `python tests/support/records.py video`."""
    cameras = write_phone_video(tmp_path / "walk.mp4", device="cpu", **PHONE_VIDEO)
    require_same_film(phone_video[0], tmp_path / "walk.mp4")
    assert np.array_equal(poses_of(cameras), poses_of(phone_video[1]))


def test_cameras_of_a_video(walk):
    folder, report, true = walk
    names, poses, _ = found_poses(folder)
    numbers = np.array([int(name.removeprefix("frame_")) for name in names])
    degrees, off = camera_errors(poses, [true[number] for number in numbers])
    assert report.registered_count == len(names) == 18
    assert np.median(degrees) < 0.35 and np.median(off) < 0.005, (degrees, off)
    assert (numbers % 6 == 5).sum() == 0 and np.diff(numbers).max() <= 4  # of blurred frames chance takes 3


def test_a_captured_scene_stands_upright_around_its_object(walk):
    folder, _, _true = walk
    names, poses, _ = found_poses(folder)
    scene = warpcage.load_scene(folder, split="all")
    assert scene.names == names and len(scene) == 18
    np.testing.assert_allclose(scene.up, [0, 0, 1], atol=0.02)
    assert np.ptp(scene.bounds, axis=0).max() == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_allclose(scene.bounds.mean(axis=0), 0, atol=1e-3)
    first = poses[0, :3, 3]
    assert abs(first[0]) < 0.05 * abs(first[1]) and first[1] < 0
    lows = [camera.center[2] / np.linalg.norm(camera.center) for camera in scene.cameras]
    assert min(lows) > 0  # the phone was above the table


def test_points_of_a_capture_project_to_where_they_were_seen(walk):
    """Colours of points are those of the pixels that they fall on: cameras, points and pictures belong together."""
    scene = warpcage.load_scene(walk[0], split="all")
    points, _ = read_ply(walk[0] / "points.ply")
    raw = (walk[0] / "points.ply").read_bytes().split(b"end_header\n", 1)[1]
    colors = np.frombuffer(raw, np.uint8).reshape(-1, 15)[:, 12:] / 255.0
    near = []
    for image, camera in list(zip(scene.images, scene.cameras, strict=True))[::5]:
        pixels, depth = camera.project(points)
        u, v = np.floor(pixels).astype(int).T
        there = (depth > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        near.append(np.abs(image[v[there], u[there]] - colors[there]).mean(axis=1))
    near = np.concatenate(near)
    shuffled = np.abs(colors[np.random.default_rng(0).permutation(len(colors))] - colors).mean()
    assert np.median(near) < 0.4 * shuffled


def test_a_fit_with_found_cameras_is_as_good_as_one_with_true_ones(walk):
    """Small pictures, small fields, views held out: video, capture, fit, and the truth beside it."""
    folder, _, true = walk
    numbers = [int(name.removeprefix("frame_")) for name in found_poses(folder)[0]]
    held = np.arange(len(numbers)) % 8 == 0
    train, test = (warpcage.load_scene(folder, split=split, downscale=4) for split in ("train", "test"))
    rotation, scale, shift = similarity(
        np.array([each.center for each in warpcage.load_scene(folder, split="all", downscale=4).cameras]),
        np.array([true[number].center for number in numbers]),
    )
    corners = np.where(np.indices((2, 2, 2)).reshape(3, 8).T == 1, train.bounds[1], train.bounds[0])
    corners = scale * corners @ rotation.T + shift
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    psnr = {}
    for name in ("found", "true"):
        scenes = [train, test]
        if name == "true":
            for k, part in enumerate((~held, held)):
                cameras = [true[n].resized(64, 48) for n, kept in zip(numbers, part, strict=True) if kept]
                scenes[k] = dataclasses.replace(scenes[k], cameras=cameras, bounds=bounds, to_source=None)
        field = warpcage.fit(scenes[0], device="cpu", quality="fast", resolution=40, epochs=2.0, progress=False)
        psnr[name] = warpcage.mean_psnr(warpcage.evaluate(field, scenes[1]))
    assert psnr["found"] > max(15.0, psnr["true"] - 1.5), psnr


def test_the_report_says_what_was_found(walk):
    folder, report, _ = walk
    assert {entry.name for entry in folder.iterdir()} == {
        "images", "transforms.json", "points.ply", "capture.json", "capture.md", "contact.png", "box.png", "seen.png"
    }  # fmt: skip
    content = json.loads((folder / "capture.json").read_text())
    assert content["registered"] == 18 and content["frames_of_the_video"] == 36
    assert content["reprojection_error"] == pytest.approx(report.error, abs=1e-3) and 0.05 < report.error < 1.0
    assert 85 < report.around < 140 and 10 < report.elevation[0] < report.elevation[1] < 60  # it walked 250 degrees
    assert report.sphere < report.upper < 0.7
    page = (folder / "capture.md").read_text()
    for message in ("18 of 18", "contact.png", "box.png", "cameras look at", "Walk all the way around"):
        assert message in page
    assert not any(entry.name.startswith(".scene") for entry in folder.parent.iterdir())


def test_pictures_of_a_phone_held_upright(tmp_path, shots):
    """EXIF says the turn and the focal length; the stored pictures lie on their side."""
    pictures, cameras = (each[:5] for each in shots)
    lying = [np.rot90(picture) for picture in pictures]  # orientation 6 turns them back, by 90 degrees clockwise
    equivalent = cameras[0].fx * 43.267 / np.hypot(*pictures.shape[1:3])
    folder = save_pictures(tmp_path / "in", lying, ending=".jpg", orientation=6, focal_35=round(float(equivalent)))
    report = warpcage.capture(folder, tmp_path / "out", progress=False)
    _, poses, frames = found_poses(tmp_path / "out")
    assert report.size == (200, 150) and report.registered_count == len(cameras)
    assert relative_errors(poses, cameras).max() < 0.5 and np.median(camera_errors(poses, cameras)[1]) < 0.005
    assert frames[0]["fl_x"] == pytest.approx(cameras[0].fx, rel=0.02)


def test_pictures_of_several_sizes_become_one(tmp_path, shots):
    """Small ones, wide ones, and ones on their side: one size in the scene, and cameras that are still the true."""
    pictures, cameras = (each[:7] for each in shots)
    folder = save_pictures(tmp_path / "in", pictures)
    Image.fromarray(pictures[1]).resize((160, 120), Image.Resampling.BOX).save(folder / "p001.png")
    Image.fromarray(pictures[3][10:140]).save(folder / "p003.png")
    Image.fromarray(np.rot90(pictures[5])).save(folder / "p005.png")  # held on its side, without EXIF
    warpcage.capture(folder, tmp_path / "out", progress=False)
    names, poses, _ = found_poses(tmp_path / "out")
    scene = warpcage.load_scene(tmp_path / "out", split="all")
    assert scene.images.shape[1:3] == (150, 200) and len(names) >= 6
    true = [cameras[int(name[1:])] for name in names]
    assert "p005" in names and relative_errors(poses, true).max() < 1.0  # upright again, and its camera with it
    assert np.median(camera_errors(poses, true)[1]) < 0.01


def test_a_video_of_the_walk(tmp_path):
    """Its cameras are those of the route; a turned one is upright."""
    video, route = tmp_path / "walk.mp4", PhonePath(degrees=9)
    options = {"frames": 3, "size": (64, 48), "strips": 2, "blurred": 3, "route": route, "device": "cpu"}
    true = write_phone_video(video, exposures=1, **options)
    np.testing.assert_array_equal(true[1].camera_to_world, route.pose(0.5))
    upright = scan_video(video)
    assert upright.size == (64, 48) and upright.sharpness.argmin() == 2
    turn_video(video, 90)
    assert scan_video(video).size == (48, 64)
