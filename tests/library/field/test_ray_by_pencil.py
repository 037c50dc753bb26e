"""A ray through so few samples that a reader adds them up with a pencil."""

import numpy as np
import pytest

from warpcage import Camera, VoxelField

CAMERA = {"eye": (0, 0, -2), "target": (0, 0, 0), "up": (0, 1, 0), "width": 1, "height": 1}


def column(density, colors, device):
    """Two by two by five voxels whose centers are one unit apart, at z = 0 to 4: matter is between centers."""
    sh = np.zeros((2, 2, 5, 9, 3))
    sh[..., 0, :] = (np.array(colors) - 0.5) / 0.28209479  # the first basis function
    bounds = [[-1, -1, -0.5], [1, 1, 4.5]]
    return VoxelField.from_dense(np.full((2, 2, 5), density), sh, bounds, background="white", device=device)


def test_four_samples_that_halve_the_light(device):
    field = column(np.log(2), [[1, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 0], [1, 0, 0]], device)
    frame = field.render(Camera.look_at(**CAMERA), step=1.0)
    # at z = 0.5, 1.5, 2.5, 3.5, each the mean of two voxels: weights 1/2, 1/4, 1/8, 1/16, and 1/16 for what is behind
    red = 1 / 2 * 0.5 + 1 / 4 * 0 + 1 / 8 * 0 + 1 / 16 * 0.5
    green = 1 / 2 * 0.5 + 1 / 4 * 1 + 1 / 8 * 0.5 + 1 / 16 * 0
    assert frame.rgb[0, 0] == pytest.approx([red + 1 / 16, green + 1 / 16, 1 / 16], abs=1e-4)
    assert frame.alpha[0, 0] == pytest.approx(15 / 16, abs=1e-4)
    # 2.5, 3.5, 4.5 and 5.5 away: (2.5/2 + 3.5/4 + 4.5/8 + 5.5/16) * 16/15 = 48.5/15
    assert frame.depth[0, 0] == pytest.approx(48.5 / 15, abs=1e-3)


def test_a_veil_too_thin_for_a_color_is_grey(device):
    """Below 1/512 in all no color is looked up: 4 samples of 1/4000 add up to 1/1000 of mid-grey."""
    frame = column(1 / 4000, 5 * [[1, 0, 0]], device).render(Camera.look_at(**CAMERA), step=1.0, background="black")
    assert frame.alpha[0, 0] == pytest.approx(1e-3, rel=1e-3)
    assert frame.rgb[0, 0] == pytest.approx(3 * [5e-4], rel=1e-3)
