"""Poses of held-out views, fitted to a field that stays as it is: how it is compared where cameras are not exact."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import warp as wp

from ..core.checks import require_type
from ..core.devices import launch
from ..core.locks import device_turn
from ..field.surroundings import OuterField
from ..field.voxel_field import VoxelField
from ..kernels.fitting.background_loss import gather_background
from ..kernels.fitting.outer_loss import gather_outer
from ..scene.scene import Scene
from .batches import Batches
from .cameras import CameraRefinement
from .evaluation import comparison, in_world_of
from .memory import memory_limit
from .schedule import CameraRates

#: Steps, and pixels of each view that one looks at.
STEPS, PIXELS = 24, 4096

#: Side of the tiles that pixels are drawn in.
TILE = 2


def tuned_scene(field: VoxelField, scene: Scene) -> Scene:
    """A scene whose cameras are turned and shifted so that its pictures match a field best, in the field's world."""
    # A field that was fitted with refined cameras lies where those see it, and a held-out view has a camera that was
    # not refined. Its pose is found with the field fixed (Gauss-Newton on the photometric error, damped), as NeRF--
    # (Wang et al. 2021, section 4) and BARF (Lin et al. 2021, section 4) do for their figures. What is measured then is
    # the field, and no longer where the views are: say so beside the figure.
    require_type(scene, Scene, "views are tuned in")
    scene = in_world_of(field, scene)
    behind, images = comparison(field, scene)
    compared = scene
    if behind is None:
        compared = dataclasses.replace(scene, images=images, alphas=None, surroundings=None)
    device = field.device
    with device_turn(device):
        random = np.random.default_rng(0)
        limit = memory_limit(None, device)
        batches = Batches(compared, field.center, TILE, random, device, held=0, limit=limit)
        batches.take(np.arange(batches.tile_total, dtype=np.int32))
        refinement = CameraRefinement(compared.cameras, field.bounds, device, held=False)
        around = field.background_model if behind is None else None
        has_front = isinstance(around, OuterField)

        def gather(rays: Any, colours: wp.array, front: wp.array | None) -> None:
            if isinstance(around, OuterField):
                launch(gather_outer, colours.size, [around.grid, rays], [front, colours], device=device)
            elif around is not None:
                launch(gather_background, colours.size, [around.layers, rays], [colours], device=device)

        for step in range(STEPS):
            batches.rays.cameras = refinement.uploaded()
            sums = refinement.measure(
                field,
                batches.rays,
                batches.view_tiles,
                max(1, PIXELS // TILE**2),
                seed=step,
                random_background=False,
                gather=None if around is None else gather,
                has_front=has_front,
            )
            share = 1.0 if 2 * step < STEPS else 0.3
            refinement.step(sums, CameraRates(share, 0.0, 0.0), float(field.voxel_size.max()))
    return dataclasses.replace(scene, cameras=refinement.cameras)
