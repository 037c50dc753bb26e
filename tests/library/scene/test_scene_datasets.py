"""What is particular to scenes of data sets: frames without a pose, smaller copies, parameters beside the folder."""

import dataclasses
import json
import warnings

import numpy as np
import pytest
from dataset_writers import (
    save_matrix,
    write_blendedmvs,
    write_nerfies,
    write_nerfpp,
    write_replica,
    write_scannet,
    write_semantic_nerf,
)
from refusals import refused
from scene_writers import Pictures, brick_pictures, intrinsic_matrix, write_image

from warpcage import load_scene


def require_cameras(scene, cameras):
    for read, written in zip(scene.cameras, cameras, strict=True):
        np.testing.assert_allclose(read.camera_to_world, written.camera_to_world, atol=1e-9)
        numbers = [[c.fx, c.fy, c.cx, c.cy, c.width, c.height] for c in (read, written)]
        np.testing.assert_allclose(*numbers, atol=1e-9)


def test_scannet_frames_without_a_pose_are_left_out(tmp_path, bricks):
    write_scannet(tmp_path, bricks, lost=(3,), ending=".jpg")
    (tmp_path / "pose/0.txt").unlink()
    with pytest.warns(UserWarning, match="2 of 10 pictures have no pose"):
        scene = load_scene(tmp_path, split="all")
    require_cameras(scene, [camera for index, camera in enumerate(bricks.cameras) if index not in (0, 3)])
    write_scannet(tmp_path, bricks, lost=range(10))
    refused(lambda: load_scene(tmp_path), match="those of all .. pictures are not finite")


def test_scannet_pictures_are_in_the_order_of_their_numbers(tmp_path):
    pictures = brick_pictures(12)  # 10 comes after 9, not after 1
    write_scannet(tmp_path, pictures)
    require_cameras(load_scene(tmp_path, split="all"), pictures.cameras)


def test_scannet_pictures_that_were_shrunk(tmp_path, bricks):
    """1296x968 to 640x480 is not quite the same shape; the scan's own file says what the intrinsics are for."""
    folder = tmp_path / "scene0000_00"
    white = np.full((1, 480, 640, 3), 255, np.uint8)
    camera = dataclasses.replace(bricks.cameras[0], fx=1169.6, fy=1167.1, cx=646.3, cy=489.9, width=1296, height=968)
    write_scannet(folder, Pictures(white, [camera]), ending=".jpg")
    refused(lambda: load_scene(folder, split="all"), match="principal point .* of another size")
    (folder / "scene0000_00.txt").write_text("axisAlignment = 1 0 0\ncolorHeight = 968\ncolorWidth = 1296\n")
    (read,) = load_scene(folder, split="all").cameras
    wanted = (camera.fx * 640 / 1296, camera.fy * 480 / 968, camera.cx * 640 / 1296, camera.cy * 480 / 968)
    np.testing.assert_allclose((read.fx, read.fy, read.cx, read.cy), wanted, rtol=1e-9)
    (folder / "scene0000_00.txt").write_text("colorWidth = 1296\ncolorHeight = 1200\n")
    refused(lambda: load_scene(folder, split="all"), match="1296x1200 pixels, .* another shape")


@pytest.mark.parametrize("beside", [False, True])
def test_replica_parameters_in_the_folder_and_beside_it(tmp_path, bricks, beside):
    write_replica(tmp_path / "room0", bricks, beside=beside)
    require_cameras(load_scene(tmp_path / "room0", split="all"), bricks.cameras)
    next(tmp_path.rglob("cam_params.json")).unlink()
    with pytest.raises(FileNotFoundError, match="room0/cam_params.json' is not there"):
        load_scene(tmp_path / "room0")


def test_replica_of_semantic_nerf_sees_a_right_angle(tmp_path, bricks):
    cameras = [dataclasses.replace(each, fx=12.0, fy=12.0, cx=12.0, cy=10.0) for each in bricks.cameras]
    write_semantic_nerf(tmp_path, Pictures(bricks.rgba, cameras))
    require_cameras(load_scene(tmp_path, split="all"), cameras)
    save_matrix(tmp_path / "traj_w_c.txt", [camera.camera_to_world.ravel() for camera in cameras[:9]])
    refused(lambda: load_scene(tmp_path), match="0 to 8, 'rgb_9.png' is beyond them")


@pytest.mark.parametrize("downscale, factors, read", [(1, (1, 2), 1), (2, (1, 2), 2), (4, (1, 2), 4), (1, (2,), 2)])
@pytest.mark.filterwarnings("ignore:.*holds its pictures smaller alone")
def test_nerfies_take_the_copy_of_the_size(tmp_path, bricks, downscale, factors, read):
    write_nerfies(tmp_path, bricks, factors=factors, held=())
    scene = load_scene(tmp_path, downscale=downscale)
    for camera, whole in zip(scene.cameras, bricks.cameras, strict=True):
        assert (camera.width, camera.height) == (24 // read, 20 // read)
        numbers = [[c.fx, c.fy, c.cx, c.cy] for c in (camera, whole)]
        np.testing.assert_allclose(read * np.array(numbers[0]), numbers[1], atol=1e-9)


def test_nerfies_say_that_the_scene_moves(tmp_path, bricks):
    write_nerfies(tmp_path, bricks, times=5)
    with pytest.warns(UserWarning, match="pictures show 5 moments of what moves"):
        load_scene(tmp_path)
    path = tmp_path / "camera" / "view_01.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"skew": 0.5}))
    refused(lambda: load_scene(tmp_path), match="view_01.json: .* skew 0.5 is not read")


def test_blendedmvs_cameras_without_a_picture_are_left_out(tmp_path, bricks):
    write_blendedmvs(tmp_path, bricks, ending=".jpg")
    require_cameras(load_scene(tmp_path, split="all"), bricks.cameras)
    (tmp_path / "blended_images" / "00000004.jpg").unlink()
    with pytest.warns(UserWarning, match="cams lists 10 pictures, 1 of them are"):
        assert len(load_scene(tmp_path, split="all")) == 9


def test_nerfpp_masks_are_said_and_skew_is_refused(tmp_path, bricks):
    write_nerfpp(tmp_path, bricks, mask=True)
    with pytest.warns(UserWarning, match="train/mask is not read"):
        load_scene(tmp_path)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(tmp_path, masks=False)
    skewed = np.eye(4)
    skewed[:3, :3] = intrinsic_matrix(bricks.cameras[0])
    skewed[0, 1] = 0.3
    save_matrix(tmp_path / "train" / "intrinsics" / "view_02.txt", skewed.reshape(1, 16))
    refused(lambda: load_scene(tmp_path, masks=False), match="intrinsics/view_02.txt: .* skew 0.3")


@pytest.mark.parametrize("count, kept", [(301, 300)])
def test_videos_are_thinned_evenly(tmp_path, bricks, count, kept):
    one = np.zeros((2, 3, 3), np.uint8)
    for index in range(count):
        write_image(tmp_path / f"color/{index}.png", one)
        save_matrix(tmp_path / f"pose/{index}.txt", bricks.cameras[index % 10].camera_to_world)
    save_matrix(tmp_path / "intrinsic/intrinsic_color.txt", np.array([[2.0, 0, 1.0], [0, 2.0, 0.5], [0, 0, 1]]))
    names = [int(name) for name in load_scene(tmp_path, split="all").names]
    assert len(names) == kept and names[0] == 0 and names[-1] == count - 1
    assert np.diff(names).max() - np.diff(names).min() <= 1
