"""A field that is not a voxel grid: a formula in a Warp function of your own, deformed through to_canonical.

    python examples/analytic_field.py

The samples of all rays stay on their device: `to_canonical` takes Warp arrays (or torch, CuPy, JAX through DLPack)
without a copy and returns Warp arrays. The formula is evaluated at the points, and along the directions, that result.
"""

import argparse

import numpy as np
import warp as wp

import warpcage

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads


@wp.func
def radiance(x: wp.vec3, direction: wp.vec3):
    """Colour and density of a ball with a soft edge, lighter where it faces the viewer."""
    facing = wp.max(-wp.dot(wp.normalize(x), direction), 0.0)
    stripes = 0.5 + 0.5 * wp.sin(12.0 * x[2] + 6.0 * x[0])
    return wp.vec3(0.3 + 0.7 * facing, 0.7 * stripes, 0.2), 40.0 * wp.clamp((0.5 - wp.length(x)) / 0.1, 0.0, 1.0)


@wp.kernel
def composite(points: wp.array2d(dtype=wp.vec3), directions: wp.array2d(dtype=wp.vec3), region: wp.array2d(dtype=int),
              dt: float, image: wp.array(dtype=wp.vec3)):  # fmt: skip
    ray = wp.tid()
    color = wp.vec3()
    light = float(1.0)  # noqa: UP018 (a variable to Warp, not a constant)
    for k in range(points.shape[1]):
        rgb, density = radiance(points[ray, k], directions[ray, k])
        kept = wp.exp(-wp.where(region[ray, k] == 1, 0.0, density) * dt)  # 1: what the moved cage left behind
        color += light * (1.0 - kept) * rgb
        light *= kept
    image[ray] = color + light * wp.vec3(1.0, 1.0, 1.0)


def main(size=48, steps=160, near=2.0, far=4.0):
    cage = warpcage.Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))
    nothing = warpcage.VoxelField.from_dense(np.zeros((2, 2, 2)), np.zeros((2, 2, 2, 9, 3)), cage.bounds)  # a stand-in
    deformer = warpcage.Deformer(nothing, cage, coordinates="mean_value", resolution=48, density="paper")

    def picture(eye, pose):
        origins, along = warpcage.Camera.look_at(eye, (0, 0, 0), width=size, height=size).rays()
        t = near + (np.arange(steps) + 0.5) * (far - near) / steps
        points = (origins[..., None, :] + t[:, None] * along[..., None, :]).reshape(-1, 3)
        arrays = [wp.array(a, dtype=wp.vec3) for a in (points, np.repeat(along.reshape(-1, 3), steps, axis=0))]
        mapped = [a.reshape((size * size, steps)) for a in deformer.pose(pose).to_canonical(*arrays, step=0.02)]
        image = wp.empty(size * size, dtype=wp.vec3)
        wp.launch(composite, dim=size * size, inputs=[*mapped, (far - near) / steps], outputs=[image])
        return image.numpy()

    turned, expected = picture((0, -3, 0), cage.rotate(90)), picture((-3, 0, 0), cage)  # a turn is a moved camera
    print(f"turned cage against moved camera: {np.abs(turned - expected).max():.4f}")
    assert np.abs(turned - expected).mean() < 2e-3
    assert np.abs(picture((0, -3, 0), cage.twist(90, axis="x")) - expected).mean() > 0.01


if __name__ == "__main__":
    main()
