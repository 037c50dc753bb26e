"""Render a posed field with nerfacc: an estimator of where samples lie, and the `rgb_sigma_fn` that nerfacc asks.

    python examples/nerfacc_render.py

`Deformer.sample` is all that a renderer of radiance fields needs: colour and density at points, of voxels or of a
field of your own (`warpcage.SampledField`). Needs torch and nerfacc (pip install torch nerfacc); rows of as many
samples a ray run on a CPU too. At the end its picture is compared with that of warpcage.
"""

import argparse
import sys

import numpy as np
import warp as wp

from warpcage import Cage, Camera, Deformer, VoxelField

argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
try:
    import nerfacc
    import torch
except ImportError as error:
    sys.exit(f"nerfacc_render.py needs {error.name}: pip install torch nerfacc")
wp.config.log_level = wp.LOG_WARNING  # no line for each module that Warp loads
SIDE, SAMPLES = 48, 256


def sampling(bounds, origins, directions):
    """Starts and ends (rays, SAMPLES) of even steps through a box (2, 3); of no length beside it."""
    near, far = ((side - origins) / directions for side in bounds)
    begin = torch.minimum(near, far).amax(dim=1, keepdim=True).clamp(min=0.0)
    end = torch.maximum(torch.maximum(near, far).amin(dim=1, keepdim=True), begin)
    edges = begin + (end - begin) * torch.linspace(0.0, 1.0, SAMPLES + 1)
    return edges[:, :-1], edges[:, 1:]


# A ball with a red and a blue half, bent by its cage.
x, y, z = np.meshgrid(*[(np.arange(40) + 0.5) / 20 - 1] * 3, indexing="ij")
sh = np.zeros((40, 40, 40, 9, 3), np.float32)
sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
density = 40.0 * np.clip((0.6 - np.sqrt(x**2 + y**2 + z**2)) / 0.1, 0.0, 1.0)
field = VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device="cpu")
rest = Cage.box([-0.7] * 3, [0.7] * 3, segments=2)
deformer = Deformer(field, rest, coordinates="mean_value", device="cpu")
deformer.pose(rest.bend(40, axis="x", towards="z"))

camera = Camera.look_at([2.5, 1.2, 1.0], [0, 0, 0], fov_degrees=45, width=SIDE, height=SIDE)
origins, directions = (torch.from_numpy(np.reshape(rays, (-1, 3)).astype(np.float32)) for rays in camera.rays())
starts, ends = sampling(torch.as_tensor(deformer.reached_bounds, dtype=torch.float32), origins, directions)


def rgb_sigma_fn(starts, ends, _):
    """What nerfacc asks: colours (rays, SAMPLES, 3) and densities (rays, SAMPLES) in the middle of steps."""
    points = origins[:, None] + 0.5 * (starts + ends)[..., None] * directions[:, None]
    rgb, sigma = deformer.sample(points.reshape(-1, 3), directions.repeat_interleave(SAMPLES, dim=0))
    return rgb.reshape(points.shape), sigma.reshape(starts.shape)


rgb, alpha, _, _ = nerfacc.rendering(starts, ends, rgb_sigma_fn=rgb_sigma_fn)
picture = (rgb + (1.0 - alpha)).reshape(SIDE, SIDE, 3).numpy()  # on white
error = np.mean((picture - deformer.render(camera, background="white").rgb) ** 2)
print(f"nerfacc's picture is within {-10 * np.log10(error):.1f} dB of warpcage's")
assert error < 1e-3 and 0.05 < float((alpha > 0.5).float().mean()) < 0.5
