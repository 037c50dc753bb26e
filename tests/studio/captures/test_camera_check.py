"""What is doubtful about a scene's cameras is said before a fit, in one line; right ones are left in peace."""

import dataclasses
import re
import threading

import numpy as np
import pytest

import warpcage
from warpcage import Camera, Scene
from warpcage.scene import camera_doubt
from warpcage.studio.cli import main
from warpcage.view.motion import axis_rotation


@pytest.fixture(scope="module")
def scene(shots):
    pictures, cameras = shots
    return Scene(pictures / np.float32(255), None, cameras)


def moved(cameras, motion, chosen):
    return [camera.moved(motion) if k in chosen else camera for k, camera in enumerate(cameras)]


def shifted(scene):
    motion = np.eye(4)
    motion[:3, :3] = axis_rotation(np.array([0.0, 0.0, 1.0]), 0.8)
    motion[:3, 3] = [0.5, 0.2, 0.1]
    return moved(scene.cameras, motion, range(4, 8))


def turned_over(scene):
    """As cameras of OpenGL read as those of OpenCV."""
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    return [dataclasses.replace(each, camera_to_world=each.camera_to_world @ flip) for each in scene.cameras]


#: What is wrong, and what is said of it.
DOUBTS = {
    "torn": (shifted, r"the cameras fell apart: of 8 pictures .* 4 \(0000, .*, 0003\) do not fit to 4 \(0004, "),
    "axes": (turned_over, r"the cameras are inside out: .* [0-9] % agree with them: look whether the format's axes"),
    "order": (lambda scene: scene.cameras[::-1], r"the cameras do not fit to the pictures: .* % agree"),
}


@pytest.mark.parametrize("wrong", DOUBTS)
def test_cameras_that_pictures_disagree_with(scene, wrong):
    make, message = DOUBTS[wrong]
    line = camera_doubt(dataclasses.replace(scene, cameras=make(scene)))
    assert line is not None and "warpcage capture" in line and "\n" not in line
    assert re.match(message, line), line


def test_right_cameras_are_not_doubted(scene):
    """Nor where some pixels do not count, or pictures have two sizes."""
    weights = np.ones(scene.images.shape[:3], np.float32)
    weights[:, :40] = 0.0
    cameras = list(scene.cameras)
    cameras[3] = dataclasses.replace(cameras[3], width=180, height=140)
    weights[3, 140:], weights[3, :, 180:] = 0.0, 0.0
    assert camera_doubt(scene) is None
    assert camera_doubt(dataclasses.replace(scene, cameras=cameras, weights=weights)) is None


def two_rings():
    """Cameras that look at two places, one above the other, with pictures too small to show more."""
    around = warpcage.turntable((0, 0, 0), 2.0, 20, 6, width=24, height=24, fov_degrees=40)
    motion = np.eye(4)
    motion[2, 3] = 9.0
    return [*around, *(camera.moved(motion) for camera in around)]


def test_places_that_no_picture_shows_together():
    scene = Scene(np.zeros((12, 24, 24, 3)), None, two_rings())
    line = camera_doubt(scene)
    assert line is not None and line.startswith("6 (0000 to 0005) and 6 (0006 to 0011) of 12 cameras look at 2 places")
    assert camera_doubt(scene.subset(range(6))) is None


def test_a_check_ends_with_the_fit_that_is_cancelled(scene):
    with pytest.raises(warpcage.Cancelled):
        warpcage.fit(scene, resolution=8, levels=1, bounds=[[-1] * 3, [1] * 3], progress=lambda *_: False)
    assert not [each.name for each in threading.enumerate() if each.name.startswith("warpcage-cameras")]


def test_parts_of_a_panorama_have_nothing_to_compare():
    cameras = warpcage.turntable((0, 0, 0), 2.0, 20, 2, width=6400, height=96, fov_degrees=90)
    assert camera_doubt(Scene(np.zeros((2, 96, 6400, 3), np.float32), None, cameras)) is None


def test_pictures_of_one_place_say_nothing_of_depth():
    cameras = [Camera.look_at((0.01 * k, 0, 0), (0.01 * k, 5, 0.1 * k), width=24, height=24) for k in range(5)]
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) + (0, 5, 0)
    scene = Scene(np.zeros((5, 24, 24, 3)), None, cameras, points=points)
    assert "say nothing about depth" in (camera_doubt(scene) or "").replace("says", "say")


def test_fits_and_info_say_it(scene, tmp_path, capsys):
    torn = dataclasses.replace(scene, cameras=shifted(scene))
    with pytest.warns(UserWarning, match="the cameras fell apart"):
        warpcage.fit(torn, resolution=8, levels=1, epochs=0.01, progress=False, bounds=[[-1] * 3, [1] * 3])
    for name, each, doubted in (("torn", torn, True), ("right", scene, False)):
        each.save(tmp_path / name)
        main(["info", str(tmp_path / name), "--split", "all"])
        assert ("doubtful" in capsys.readouterr().out) == doubted
