"""What fits are compared with: the order of their tiles in whole numbers of Python, and the gradient of the photometric
loss as their kernels give it."""

import dataclasses

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from warpcage import Camera
from warpcage.fitting import gradient_parts
from warpcage.kernels.fitting import loss as field_loss
from warpcage.kernels.fitting import loss_warps as field_loss_warps
from warpcage.view import camera_array


def finished(fit):
    """The fit after all its steps."""
    while fit.step_count < fit.total_steps:
        fit.step()
    return fit


def mixed(value: int) -> int:
    value ^= value >> 16
    value = value * 0x85EBCA6B & 0xFFFFFFFF
    value ^= value >> 13
    value = value * 0xC2B2AE35 & 0xFFFFFFFF
    return value ^ value >> 16


def shuffled_place(place: int, count: int, key: int) -> int:
    bits = next(bits for bits in range(1, 16) if 4**bits >= count)
    mask = 2**bits - 1
    item = place
    while True:
        left, right = item >> bits, item & mask
        for turn in range(4):
            both = (key + turn * 0x9E3779B9 & 0xFFFFFFFF) ^ right << 8
            left, right = right, left ^ mixed(both) & mask
        item = left << bits | right
        if item < count:
            return item


def shuffled(items: np.ndarray, key: int) -> np.ndarray:
    """Items (n,) in the order of a key."""
    return np.array([items[shuffled_place(place, len(items), key)] for place in range(len(items))])


def moved_camera(camera, turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), zoom=0.0):
    """A camera turned in place, in radians, and shifted along its own axes, with `zoom` more in the logarithm of its
    focal length."""
    pose, factor = camera.camera_to_world.copy(), np.exp(zoom)
    pose[:3, 3] += pose[:3, :3] @ shift
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turn).as_matrix()
    return dataclasses.replace(camera, fx=factor * camera.fx, fy=factor * camera.fy, camera_to_world=pose)


def poses_of(cameras):
    return np.array([camera.camera_to_world for camera in cameras])


def two_cameras():
    """Views of 8 x 6 pixels of the cube from -1 to 1."""
    lens = {"fov_degrees": 38, "width": 8, "height": 6}
    return [Camera.look_at(eye, [0, 0, 0], **lens) for eye in ([3.0, 0.4, 0.5], [-1.0, 2.5, 1.2])]


def training_rays(cameras, images, alphas, field, device, side=1):
    pixels = np.concatenate([images - (1 - alphas[..., None]), alphas[..., None]], axis=-1).astype(np.float16)
    rays = field_loss.TrainingRays()
    rays.cameras = camera_array(cameras, field.center, device)
    rays.pictures.halves = wp.array(pixels, dtype=wp.vec4h, device=device)
    rays.height, rays.width = pixels.shape[1:3]
    rays.tile_size = 2
    rays.rays_per_side = side
    rays.tiles = wp.array(np.arange(len(cameras) * 12), dtype=wp.int32, device=device)
    rays.first_tile = 0
    return rays


def gradient_rows(gradients):
    """(rows, 25) NumPy, coefficients, then density, of what kernels add to."""
    density, coefficients = (part.numpy() for part in gradient_parts(gradients))
    return np.concatenate([coefficients, density[:, None]], axis=1)


def counted_views(rows, device):
    """Numbers of views (rows,) of voxels from 0 to 4, and factors on terms of density and of colour by these numbers
    (256, 2); both and the two arrays that kernels take."""
    random = np.random.default_rng(2)
    views, factors = random.integers(0, 5, rows), random.uniform(0.5, 2.0, (256, 2))
    arrays = [wp.array(views, dtype=wp.uint8, device=device), wp.array(factors, dtype=wp.vec2, device=device)]
    return views, factors, arrays


def photometric_gradient(
    field,
    rays,
    count,
    *,
    background=(1.0, 1.0, 1.0),
    random_background=0,
    seed=0,
    stop=0.0,
    scale=1.0,
    by_warps=False,
    own_background=None,
    grad_background=None,
    front=None,
    grad_front=None,
):
    """Gradient rows (rows, 25), coefficients, then density, and squared errors (count,) of a batch.

    own_background, grad_background, front, grad_front: Warp arrays.
    """
    device = field.device
    gradients = wp.zeros(25 * field.voxel_count, dtype=wp.float32, device=device)
    touched = wp.zeros(field.voxel_count, dtype=wp.uint8, device=device)
    error = wp.zeros(count, dtype=wp.float32, device=device)
    inputs = [rays, wp.vec3(*background), random_background, seed, field.step, stop, scale, own_background, front]
    if by_warps:
        wp.launch(
            field_loss_warps.accumulate_photometric_gradient_by_warps,
            dim=32 * count,
            device=device,
            block_dim=128,
            inputs=[0, field.grid, *inputs],
            outputs=[gradients, touched, error, grad_background, grad_front],
        )
        assert touched.numpy()[gradient_rows(gradients).any(axis=1)].all()
    else:
        wp.launch(
            field_loss.accumulate_photometric_gradient,
            dim=count,
            device=device,
            inputs=[0, field.grid, *inputs],
            outputs=[*gradient_parts(gradients), error, grad_background, grad_front],
        )
    return gradient_rows(gradients), error.numpy()
