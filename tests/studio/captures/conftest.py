"""What tests of captures find the cameras of: pictures, and a phone's video, of a walk around the table scene."""

import pathlib

import numpy as np
import pytest
from ground_truth import phone_cameras
from made import made_once
from scenes import PHONE_VIDEO, table_pictures

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
def phone_video():
    """The video, whose rays would take 20 s to cast anew, and the true cameras of all its frames."""
    count = PHONE_VIDEO["frames"]
    times = [place * (1.0 / (count - 1)) for place in range(count)]
    return pathlib.Path(__file__).parent / "phone_video.mp4", phone_cameras(times, PHONE_VIDEO["size"])
