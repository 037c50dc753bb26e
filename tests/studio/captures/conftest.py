"""What tests of captures find the cameras of: pictures, and a phone's video, of a walk around the table scene."""

import numpy as np
import pytest
from ground_truth import write_phone_video
from made import made_once
from scenes import table_pictures

from warpcage import Camera


def kept(path, cameras, **arrays):
    first = cameras[0]
    lens = [first.fx, first.fy, first.cx, first.cy, first.width, first.height]
    np.savez(path, lens=lens, poses=[camera.camera_to_world for camera in cameras], **arrays)


def cameras_of(held):
    *lens, width, height = held["lens"]
    return [Camera(*lens, int(width), int(height), pose) for pose in held["poses"]]


@pytest.fixture(scope="session")
def shots(pytestconfig):
    """Eight sharp pictures (8, 150, 200, 3) uint8 of a quarter of the walk, and their cameras."""

    def make(path):
        pictures, cameras = table_pictures(np.linspace(0.0, 0.25, 8))
        kept(path, cameras, pictures=pictures)

    with np.load(made_once(pytestconfig, "table_shots.npz", make)) as held:
        return held["pictures"], cameras_of(held)


@pytest.fixture(scope="session")
def phone_video(pytestconfig, tmp_path_factory):
    """The video, with a rolling shutter and every sixth frame blurred, and the true cameras of all its frames."""

    def make(path):
        video = path.with_suffix(".mp4")
        options = {"frames": 36, "size": (256, 192), "strips": 8, "blurred": 6, "exposures": 1}
        cameras = write_phone_video(video, device="cpu", **options)
        kept(path, cameras, video=np.frombuffer(video.read_bytes(), np.uint8))
        video.unlink()

    video = tmp_path_factory.mktemp("walk") / "walk.mp4"
    with np.load(made_once(pytestconfig, "table_video.npz", make)) as held:
        video.write_bytes(held["video"].tobytes())
        return video, cameras_of(held)
