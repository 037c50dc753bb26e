"""Render a posed field with nerfacc: an estimator of where samples lie, and the `rgb_sigma_fn` that nerfacc asks.

    python examples/nerfacc_render.py

`PosedField` is all that a renderer of radiance fields needs: colour and density at points, looked up where the pose
took them from. Needs torch and nerfacc (pip install torch nerfacc); rows of as many samples a ray run on a CPU too. At
the end its picture is compared with that of warpcage.
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


class PosedField:
    """A posed Deformer (density="paper") as nerfacc takes fields."""

    def __init__(self, deformer):
        self.deformer, self.bounds = deformer, torch.as_tensor(deformer.reached_bounds, dtype=torch.float32)

    def sampling(self, origins, directions):
        """Starts and ends (rays, SAMPLES) of even steps through the box of the posed field; of no length beside it."""
        near, far = ((side - origins) / directions for side in self.bounds)
        begin = torch.minimum(near, far).amax(dim=1, keepdim=True).clamp(min=0.0)
        end = torch.maximum(torch.maximum(near, far).amin(dim=1, keepdim=True), begin)
        edges = begin + (end - begin) * torch.linspace(0.0, 1.0, SAMPLES + 1)
        return edges[:, :-1], edges[:, 1:]

    def rgb_sigma_fn(self, origins, directions):
        """What nerfacc asks: colours (rays, SAMPLES, 3) and densities (rays, SAMPLES) in the middle of steps."""

        def ask(starts, ends, _):
            along = directions[:, None].expand(*starts.shape, 3).reshape(-1, 3).contiguous()
            points = (origins[:, None] + 0.5 * (starts + ends)[..., None] * directions[:, None]).reshape(-1, 3)
            places, toward, region = self.deformer.to_canonical(points, along)
            rgb, sigma = self.deformer.field.sample(places, toward)
            sigma = torch.where(region == 1, 0.0, sigma)  # what the pose took away
            return rgb.reshape(*starts.shape, 3), sigma.reshape(starts.shape)

        return ask


# A ball with a red and a blue half, bent by its cage.
x, y, z = np.meshgrid(*[(np.arange(40) + 0.5) / 20 - 1] * 3, indexing="ij")
sh = np.zeros((40, 40, 40, 9, 3), np.float32)
sh[..., 0, :] = np.where(z[..., None] > 0, [1.5, -1.5, -1.5], [-1.5, -1.5, 1.5])
density = 40.0 * np.clip((0.6 - np.sqrt(x**2 + y**2 + z**2)) / 0.1, 0.0, 1.0)
field = VoxelField.from_dense(density, sh, [[-1, -1, -1], [1, 1, 1]], device="cpu")
rest = Cage.box([-0.7] * 3, [0.7] * 3, segments=2)
deformer = Deformer(field, rest, coordinates="mean_value", density="paper", device="cpu")
deformer.pose(rest.bend(40, axis="x", towards="z"))

camera = Camera.look_at([2.5, 1.2, 1.0], [0, 0, 0], fov_degrees=45, width=SIDE, height=SIDE)
origins, directions = (torch.from_numpy(np.reshape(rays, (-1, 3)).astype(np.float32)) for rays in camera.rays())
posed = PosedField(deformer)
starts, ends = posed.sampling(origins, directions)
rgb, alpha, _, _ = nerfacc.rendering(starts, ends, rgb_sigma_fn=posed.rgb_sigma_fn(origins, directions))
picture = (rgb + (1.0 - alpha)).reshape(SIDE, SIDE, 3).numpy()  # on white
error = np.mean((picture - deformer.render(camera, background="white").rgb) ** 2)
print(f"nerfacc's picture is within {-10 * np.log10(error):.1f} dB of warpcage's")
assert error < 1e-3 and 0.05 < float((alpha > 0.5).float().mean()) < 0.5
