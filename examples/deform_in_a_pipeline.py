"""A Deformer in a pipeline of your own: it tells another renderer colour and density of the deformed field.

    python examples/deform_in_a_pipeline.py

A renderer that asks for colour and density at points, seen along directions, asks `Deformer.sample`, of voxels as of
any other field (`warpcage.SampledField`, see analytic_field.py).
"""

import argparse

import numpy as np
import warp as wp

import warpcage
from warpcage.view.camera import Camera

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads


def make_field():
    """A ball of radius 0.5, red above and blue below; colours are 0.5 + the constant harmonic times its coefficient."""
    x, y, z = np.meshgrid(*[(np.arange(48) + 0.5) / 24 - 1] * 3, indexing="ij")
    density = np.where(x**2 + y**2 + z**2 < 0.25, 60.0, 0.0)
    sh = np.zeros((*density.shape, 9, 3))
    sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
    return warpcage.VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]])


def render(deformer, camera, steps=192, near=1.5, far=4.5):
    """A plain volume renderer in NumPy; only the line with deformer.sample knows about the deformation."""
    origins, directions = (rays.reshape(-1, 1, 3) for rays in camera.rays())
    dt = (far - near) / steps
    points = origins + directions * (near + (np.arange(steps)[:, None] + 0.5) * dt)
    points, directions = points.reshape(-1, 3), np.broadcast_to(directions, points.shape).reshape(-1, 3)

    rgb, density = deformer.sample(points, directions, step=dt)

    alpha = 1 - np.exp(-density.reshape(-1, steps) * dt)
    weights = alpha * np.cumprod(np.concatenate([np.ones((len(alpha), 1)), 1 - alpha[:, :-1]], axis=1), axis=1)
    image = (weights[..., None] * rgb.reshape(-1, steps, 3)).sum(axis=1) + 1 - weights.sum(axis=1, keepdims=True)
    return image.reshape(camera.height, camera.width, 3)


def main():
    field, camera = make_field(), Camera.look_at((0, -3, 0), (0, 0, 0), width=48, height=48)
    cage = warpcage.Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))
    deformer = warpcage.Deformer(field, cage, resolution=32)
    deformer.pose(cage.stretch(1.4).rotate(180, axis="y"))
    ours, theirs = render(deformer, camera), deformer.render(camera).rgb
    error = np.abs(ours - theirs).mean()
    print(f"mean difference to the library's own renderer: {error:.4f}")
    assert error < 0.02
    assert ours[16, 24].argmax() == 2 and ours[32, 24].argmax() == 0, "turned upside down: blue above, red below"


if __name__ == "__main__":
    main()
