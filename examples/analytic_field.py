"""A field that is not a voxel grid: a formula in a Warp kernel of your own, posed as warpcage.SampledField.

    python examples/analytic_field.py

The samples of all rays stay on their device: the kernel takes the Warp arrays that the Deformer makes, and fills
others. A function in torch or JAX reads the same arrays through DLPack (torch.from_dlpack), one in NumPy by `.numpy()`.
"""

import argparse

import numpy as np
import warp as wp

import warpcage

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads


@wp.kernel
def fill(points: wp.array(dtype=wp.vec3), directions: wp.array(dtype=wp.vec3),
         colors: wp.array(dtype=wp.vec3), densities: wp.array(dtype=float)):  # fmt: skip
    n = wp.tid()
    x = points[n]
    facing = wp.max(-wp.dot(wp.normalize(x), directions[n]), 0.0)
    colors[n] = wp.vec3(0.3 + 0.7 * facing, 0.35 + 0.35 * wp.sin(12.0 * x[2] + 6.0 * x[0]), 0.2)
    densities[n] = 40.0 * wp.clamp((0.5 - wp.length(x)) / 0.1, 0.0, 1.0)


def ball(points, directions):
    """Colours and densities of a striped ball with a soft edge, lighter where it faces the viewer."""
    found = [wp.empty(len(points), dtype=kind, device=points.device) for kind in (wp.vec3, float)]
    wp.launch(fill, dim=len(points), inputs=[points, directions], outputs=found, device=points.device)
    return found


def main(size=48):
    cage = warpcage.Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))
    field = warpcage.SampledField(ball, cage.bounds, step=0.0125)
    deformer = warpcage.Deformer(field, cage, coordinates="mean_value", resolution=48)

    def picture(eye, pose):
        return deformer.pose(pose).render(warpcage.Camera.look_at(eye, (0, 0, 0), width=size, height=size)).rgb

    turned, expected = picture((0, -3, 0), cage.rotate(90)), picture((-3, 0, 0), cage)  # a turn is a moved camera
    print(f"turned cage against moved camera: {np.abs(turned - expected).max():.4f}")
    assert np.abs(turned - expected).mean() < 2e-3
    assert np.abs(picture((0, -3, 0), cage.twist(90, axis="x")) - expected).mean() > 0.01


if __name__ == "__main__":
    main()
