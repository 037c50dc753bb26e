"""What lies around a voxel field: a sparse grid in contracted space, from the cameras to infinity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import empty_array
from ..core.checks import checked_vector
from ..core.devices import launch, resolve_device
from ..core.locks import device_turn, in_turn
from ..core.names import counted
from ..kernels.field.background import BackgroundLayers
from ..kernels.field.outer import OuterGrid, compose_outer, dim_pixels, sample_outer
from ..view.camera import Camera, camera_struct, tile_threads
from .around import seen_by_rays
from .files.contents import OuterContents, surface_node_count
from .sparse import measure_skip, values_on_device


class OuterField:
    """A sparse voxel grid of the space around a box, contracted into a cube (MeRF 2023, Eq. 8)."""

    # Outside the box, which is [-1, 1]^3 in box units, space is pressed into [-2, 2]^3, so that voxels grow with their
    # distance and the last ones reach to infinity. Colours do not depend on direction. What the grid holds before the
    # box hides the box, what it holds behind it shows where the box lets light through.

    def __init__(
        self,
        center: ArrayLike,
        half: ArrayLike,
        links: np.ndarray | wp.array,
        values: np.ndarray | wp.array,
        *,
        sky: ArrayLike | wp.array = (1.0, 1.0, 1.0),
        device: wp.DeviceLike = None,
    ):
        self.device = resolve_device(links.device if device is None and isinstance(links, wp.array) else device)
        # middle and half sides of the box: (3,) float64, world units
        self.center = checked_vector(center, "an outer field's center").copy()
        self.half = checked_vector(half, "an outer field's half sides").copy()
        if not (self.half > 0).all():
            raise ValueError(f"an outer field's half sides must be positive, got {self.half.tolist()}")
        # links: row of each voxel or -1
        shape = tuple(links.shape)
        if len(shape) != 3 or len(set(shape)) != 1 or shape[0] < 4:
            raise ValueError(f"an outer field's links must be (n, n, n), n at least 4, got {shape}")
        # values: red, green, blue, and density per unit of contracted length, those below zero counting as none
        rows = tuple(values.shape) + ((4,) if isinstance(values, wp.array) else ())
        if len(rows) != 2 or rows[1] != 4:
            raise ValueError(f"an outer field's values must be (rows, 4), got {rows}")
        with device_turn(self.device):
            grid = OuterGrid()
            grid.half, grid.sky = wp.vec3(*self.half), sky_layers(sky, self.device)
            grid.links = values_on_device(links, wp.int32, self.device)
            if isinstance(values, wp.array):
                grid.values = values if values.device == self.device else values.to(self.device)
            else:
                host = np.ascontiguousarray(values, np.float32)
                largest = int(np.asarray(links).max(initial=-1)) if isinstance(links, np.ndarray) else -1
                if not np.isfinite(host).all() or largest >= len(host):
                    raise ValueError("an outer field's values must be finite, one row for each that its links name")
                grid.values = wp.array(host, dtype=wp.vec4, device=self.device)
            grid.skip = measure_skip(grid.links)
        # positions in it are relative to the centre
        self.grid = grid

    @property
    def side(self) -> int:
        """Voxels along each side of contracted space; half of them stand for the box, and hold nothing."""
        return self.grid.links.shape[0]

    @property
    def voxel_count(self) -> int:
        """Voxels that hold values."""
        return self.grid.values.shape[0]

    @property
    @in_turn
    def sky(self) -> np.ndarray:
        """(6 s^2 + 2, 3) float32 colours at infinity."""
        return self.grid.sky.values.numpy()[0, :, :3]

    @property
    @in_turn
    def values(self) -> np.ndarray:
        """(rows, 4) float32 red, green, blue and density per unit of contracted length."""
        return self.grid.values.numpy()

    @classmethod
    def from_contents(cls, contents: OuterContents, device: wp.DeviceLike = None) -> OuterField:
        """The outer field of a file."""
        return cls(
            contents.center,
            contents.half,
            contents.links,
            contents.values,
            sky=contents.sky,
            device=resolve_device(device),
        )

    @in_turn
    def contents(self) -> OuterContents:
        """The grid on the host, for a file."""
        return OuterContents(self.center, self.half, self.grid.links.numpy(), self.grid.values.numpy(), self.sky)

    @property
    def summary(self) -> str:
        """What it is, in a few words."""
        return f"{counted(self.voxel_count, 'voxel')} around it in {self.side}^3 of contracted space"

    def __repr__(self) -> str:
        center = self.center.round(4).tolist()
        return f"OuterField({self.side}^3, {self.voxel_count} voxels around {center}, {self.device})"

    @in_turn
    def sample(self, origins: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Colours (n, 3) float32 that rays see of it, with nothing in the box, from origins (n, 3), world units.
        directions: (n, 3), of any length but zero."""
        return seen_by_rays(sample_outer, self.grid, self.center, origins, directions, self.device)

    def add_around(
        self, camera: Camera, rgb: wp.array, alpha: wp.array, depth: wp.array, masks: Sequence[wp.array] = ()
    ) -> None:
        """Put what is around the box before and behind a view on black: rgb, alpha and masks (h * w,), all changed.
        depth: (h * w,) float32 distance of what the view shows, inf where that is nothing."""
        light = empty_array(alpha.shape[0], wp.float32, self.device)
        inputs = [self.grid, camera_struct(camera, self.center), depth]
        launch(compose_outer, tile_threads(camera), inputs, [rgb, alpha, light], device=self.device)
        for mask in masks:
            launch(dim_pixels, mask.shape[0], [light], [mask], device=self.device)

    def to(self, device: wp.DeviceLike) -> OuterField:
        """The same on another device; this one if it is there already."""
        device = resolve_device(device)
        if device == self.device:
            return self
        grid = self.grid
        return OuterField(self.center, self.half, grid.links, grid.values, sky=grid.sky.values, device=device)


def sky_layers(sky: Any, device: wp.Device) -> Any:
    """BackgroundLayers of one layer, which begins at infinity, of a sky: one colour (3,), or (6 s^2 + 2, 3) of a cube.
    These in the order of kernels/field/background; or a Warp array (1, 6 s^2 + 2) of vec4."""
    if not isinstance(sky, wp.array):
        colours = np.asarray(sky, np.float32)
        if colours.shape == (3,):
            colours = np.broadcast_to(colours, (surface_node_count(2), 3))
        if colours.ndim != 2 or colours.shape[1] != 3 or not np.isfinite(colours).all():
            raise ValueError(f"an outer field's sky must be finite (3,) or (6 s^2 + 2, 3), got {colours.shape}")
        values = np.concatenate([colours, np.ones((len(colours), 1), np.float32)], axis=1)[None]
        sky = wp.array(np.ascontiguousarray(values), dtype=wp.vec4, device=device)
    nodes = sky.shape[-1]
    side = math.isqrt(max(0, (nodes - 2) // 6))
    if len(sky.shape) != 2 or side < 2 or nodes != surface_node_count(side):
        raise ValueError(f"an outer field's sky must hold 6 s^2 + 2 colours, s at least 2, got {nodes}")
    layers: Any = BackgroundLayers()
    layers.half, layers.side = 1.0, side
    layers.values = sky if sky.device == device else sky.to(device)
    return layers
