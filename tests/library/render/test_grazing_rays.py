"""Rays almost along the sides of a grid, which would reach it after more steps than can be counted, end."""

import multiprocessing

import numpy as np

from warpcage import Cage, Camera, Deformer, VoxelField

#: Seconds that a picture of a few pixels may take, kernels compiled before.
LIMIT = 120


def small_field(device):
    density = np.full((6, 6, 6), 40.0, np.float32)
    sh = np.zeros((6, 6, 6, 9, 3), np.float32)
    sh[..., 0, :] = 1.0
    return VoxelField.from_dense(density, sh, [[-0.5] * 3, [0.5] * 3], device=device)


def grazing_camera(slope):
    """A pixel whose ray passes beside the grid and has a direction of `slope` along y, which it never makes up for."""
    camera = Camera.look_at([-3.0, 2.0, 0.0], [3.0, 2.0, 0.0], up=[0.0, 0.0, 1.0], fov_degrees=20, width=1, height=1)
    pose = camera.camera_to_world.copy()
    pose[:3, 2] = [1.0, -slope, 0.0]
    pose[:3, 0] = np.cross(pose[:3, 1], pose[:3, 2])
    return Camera(camera.fx, camera.fy, camera.cx, camera.cy, 1, 1, pose)


def draw(device, queue):
    """Of a field, and of a deformed one."""
    field, cage = small_field(device), Cage.box([-0.7] * 3, [0.7] * 3)
    deformer = Deformer(field, cage, resolution=12, coordinates="mean_value").pose(cage.stretch(1.2))
    slopes = (5e-8, -5e-8, 1e-9, 1e-11)
    for each in (field, deformer):
        queue.put([float(each.render(grazing_camera(slope), background="black").alpha.max()) for slope in slopes])


def test_rays_almost_along_the_sides_of_a_grid_end(device):
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=draw, args=(device, queue))
    process.start()
    try:
        alphas = [queue.get(timeout=LIMIT) for _ in range(2)]
    finally:
        process.kill()
        process.join()
    assert alphas == [[0.0] * 4] * 2
