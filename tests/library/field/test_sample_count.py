"""Samples of a march, counted manually."""

import numpy as np
import warp as wp
from ground_truth.sample_count import count_samples

from warpcage import Camera, VoxelField
from warpcage.core import launch
from warpcage.view import camera_array


def counts(field, cameras, stride=1, stop=1e-4):
    rays = len(cameras) * -(-cameras[0].width // stride) * -(-cameras[0].height // stride)
    held = [wp.empty(rays, dtype=wp.int32, device=field.device) for _ in range(2)]
    held_cameras = camera_array(cameras, field.center, field.device)
    launch(count_samples, rays, [field.grid, held_cameras, stride, field.step, stop], held, device=field.device)
    return [each.numpy().reshape(len(cameras), -(-cameras[0].height // stride), -1) for each in held]


def test_samples_of_a_block(device):
    """Through 9 cells of a block of ten voxels, two samples a cell; the first half of the voxels is empty."""
    links = np.arange(1000, dtype=np.int32).reshape(10, 10, 10)
    density = np.zeros((10, 10, 10), np.float32)
    density[5:] = 1e-3
    field = VoxelField(
        [[0, 0, 0], [10, 10, 10]], links, density.ravel(), np.zeros((1000, 9, 3), np.float32), device=device
    )
    ahead = Camera.look_at([-20, 5, 5], [5, 5, 5], fov_degrees=2, width=3, height=3)
    past = Camera.look_at([-20, 30, 5], [5, 30, 5], fov_degrees=2, width=3, height=3)
    marched, matter = counts(field, [ahead, past])
    assert marched[0, 1, 1] == 18 and not marched[1].any() and not matter[1].any()
    assert matter[0, 1, 1] == 10  # 5 cells from the last empty node on
    np.testing.assert_array_equal(counts(field, [ahead, past], stride=2)[0], marched[:, ::2, ::2])


def test_opaque_matter_ends_a_ray(device):
    field = VoxelField.from_dense(
        np.full((10, 10, 10), 50.0), np.zeros((10, 10, 10, 9, 3)), [[0, 0, 0], [10, 10, 10]], device=device
    )
    marched, matter = counts(field, [Camera.look_at([-20, 5, 5], [5, 5, 5], fov_degrees=2, width=1, height=1)])
    assert marched.item() == matter.item() == 1  # exp(-50 / 2) is less than what counts
