"""Scenes as programs of phones write them come back: raw data of Polycam, captures of Record3D and Stray Scanner,
videos of ARKitScenes. Pixels of known points are compared with the formulas of their own documentation."""

import json

import numpy as np
import pytest
from messages import MESSAGES
from phone_writers import write_arkitscenes, write_json, write_polycam, write_record3d, write_stray
from program_writers import SHADES, SQUARE
from scipy.spatial.transform import Rotation
from test_scene_formats import load, require_equal, require_held_out_splits


@pytest.mark.parametrize("corrected", [False, True])
def test_polycam(tmp_path, bricks, corrected):
    """The raw data of Polycam: a JSON file a picture; optimised ones are taken where they are there."""
    kinds = ("", "corrected_") if corrected else ("",)
    write_polycam(tmp_path, bricks, kinds=kinds, shift=5.0 * corrected)
    require_equal(load(tmp_path, split="all"), bricks)
    np.testing.assert_allclose(load(tmp_path).to_source @ [0, 0, 1, 1], [0, 1, 0, 1], atol=1e-12)
    (tmp_path / f"keyframes/{kinds[-1]}cameras/{bricks.names[2]}.json").write_text('{"fx": 3}')
    with pytest.raises(ValueError, match=MESSAGES["scene.pose_number"]):
        load(tmp_path)
    (tmp_path / f"keyframes/{kinds[-1]}images").rename(tmp_path / "depth")
    (tmp_path / "keyframes/images").rename(tmp_path / "other") if corrected else None
    with pytest.raises(ValueError, match="holds no cameras/ .* beside images/"):
        load(tmp_path)


@pytest.mark.parametrize("each", [False, True])
@pytest.mark.parametrize("file, images", [("metadata", "rgbd"), ("metadata.json", "rgb")])
def test_record3d(tmp_path, bricks, file, images, each):
    write_record3d(tmp_path, bricks, file=file, images=images, each=each)
    require_equal(load(tmp_path, split="all", format="record3d"), bricks)
    content = json.loads((tmp_path / file).read_text())
    content["poses"][1] = [0.0] * 6
    write_json(tmp_path / file, content)
    with pytest.raises(ValueError, match=r"poses\[1\] must hold 7 numbers"):
        load(tmp_path)


# ARKitScenes


@pytest.mark.parametrize("place", ["", "41069021_frames"])
def test_arkitscenes(tmp_path, bricks, place):
    write_arkitscenes(tmp_path, bricks, place=place)
    require_held_out_splits(tmp_path, bricks)
    scene = load(tmp_path, split="all", format="arkitscenes")
    np.testing.assert_allclose(scene.points, SQUARE, atol=1e-6)
    np.testing.assert_allclose(scene.point_colors, SHADES / 255, atol=1e-6)
    files = sorted((tmp_path / place / "lowres_wide_intrinsics").iterdir())[::2]
    lines = (tmp_path / place / "lowres_wide.traj").read_text().splitlines()
    for camera, line, file in zip(scene.cameras, lines, files, strict=True):
        values = np.array(line.split(), float)
        x, y, z = (Rotation.from_rotvec(values[1:4]).apply(SQUARE) + values[4:]).T
        _, _, fx, fy, cx, cy = map(float, file.read_text().split())
        np.testing.assert_allclose(
            camera.project(SQUARE)[0], np.stack([fx * x / z + cx, fy * y / z + cy], 1), atol=1e-6
        )


def test_arkitscenes_takes_the_largest_pictures(tmp_path, bricks):
    write_arkitscenes(tmp_path, bricks.pick([0, 1, 2]), images="wide", mesh=False)
    write_arkitscenes(tmp_path, bricks, mesh=False)
    require_equal(load(tmp_path, split="all"), bricks.pick([0, 1, 2]))
    require_equal(load(tmp_path, split="all", model="lowres_wide"), bricks)
    with pytest.raises(ValueError, match="only wide, lowres_wide"):
        load(tmp_path, model="vga_wide")


def test_arkitscenes_of_other_times(tmp_path, bricks):
    write_arkitscenes(tmp_path, bricks)
    path = tmp_path / "41069021_frames" / "lowres_wide.traj"
    path.write_text(path.read_text().replace("345", "745"))
    with pytest.raises(ValueError, match=MESSAGES["scene.no_pose_in_time"]):
        load(tmp_path)


# Stray Scanner


def test_stray(tmp_path, bricks):
    write_stray(tmp_path, bricks)
    require_held_out_splits(tmp_path, bricks)
    scene = load(tmp_path, split="all", format="stray")
    np.testing.assert_allclose(scene.to_source @ [0, 0, 1, 1], [0, 1, 0, 1], atol=1e-12)
    matrix = np.loadtxt(tmp_path / "camera_matrix.csv", delimiter=",")
    rows = np.loadtxt(tmp_path / "odometry.csv", delimiter=",", skiprows=1)
    world = SQUARE @ scene.to_source[:3, :3].T
    for camera, row in zip(scene.cameras, rows, strict=True):
        seen = Rotation.from_quat(row[5:]).inv().apply(world - row[2:5]) @ matrix.T
        np.testing.assert_allclose(camera.project(SQUARE)[0], seen[:, :2] / seen[:, 2:], atol=1e-6)


def test_stray_frames_must_be_pictures(tmp_path, bricks):
    write_stray(tmp_path, bricks)
    for index in (3, 4):
        (tmp_path / "rgb" / f"{index:06d}.png").unlink()
    assert len(load(tmp_path, split="all")) == 8
    (tmp_path / "rgb").rename(tmp_path / "depth")
    (tmp_path / "rgb.mp4").write_bytes(b"video")
    with pytest.raises(FileNotFoundError, match="rgb.mp4 .*ffmpeg -i rgb.mp4"):
        load(tmp_path)
