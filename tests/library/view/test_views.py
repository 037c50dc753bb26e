"""Cameras that frame an object."""

import numpy as np
import pytest
from refusals import refused

from warpcage.view import framing_orbit


@pytest.mark.parametrize("width, height", [(64, 64), (90, 40), (40, 90)])
@pytest.mark.parametrize("up", [(0, 0, 1), (0, 1, 0), (1, 2, 3)])
def test_orbit_holds_every_point_and_wastes_no_room(width, height, up):
    points = np.random.default_rng(0).normal(size=(300, 3)) * (3.0, 0.5, 1.0) + (1e4, -2e3, 7.0)
    view = {"up": up, "fov_degrees": 50, "width": width, "height": height, "fill": 0.9}
    cameras = framing_orbit(points, 9, elevation_degrees=33, **view)
    assert len(cameras) == 9
    filled = []
    for camera in cameras:
        pixels, depth = camera.project(points)
        assert (depth > 0).all()
        share = np.abs(pixels - (width / 2, height / 2)) / (width / 2, height / 2)
        assert share.max() < 0.9 + 1e-6
        filled.append(share.max())
        # the same distance and height all around
        up_unit = np.asarray(up) / np.linalg.norm(up)
        assert (camera.center - cameras[0].center) @ up_unit == pytest.approx(0, abs=1e-6)
    assert max(filled) == pytest.approx(0.9, abs=1e-6)


def test_orbit_of_one_point_and_what_it_refuses():
    camera = framing_orbit([[1.0, 2.0, 3.0]], 1)[0]
    np.testing.assert_allclose(camera.project([[1.0, 2.0, 3.0]])[0], [[200, 200]], atol=1e-9)
    refused(lambda: framing_orbit(np.zeros((0, 3)), 1), match="at least one point")
    refused(lambda: framing_orbit([[0, 0, 0]], 1, fov_degrees=180), match="fov")
    refused(lambda: framing_orbit([[0, 0, 0]], 0), match="whole number of at least 1")
