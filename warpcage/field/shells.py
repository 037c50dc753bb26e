"""What lies around a field, near and far: voxels in nested cubes around its box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike, empty_array
from ..core.checks import checked_vector, require_ordinary_side
from ..core.devices import launch, resolve_device
from ..core.locks import device_turn, in_turn
from ..core.names import counted
from ..errors import InputError
from ..kernels.field import shells as kernels
from ..kernels.field.occupancy import SKIP_LIMIT
from ..kernels.field.outer import dim_pixels
from ..view.camera import Camera, camera_struct, tile_threads
from .io.shell_file import ShellContents
from .sparse import spread_distances
from .surroundings import LayeredBackground, OuterField, seen_by_rays, sky_layers

#: Nodes of a brick.
BRICK_NODES = int(kernels.BRICK_NODES)


class BrickLayout:
    """Bricks and the rows of their nodes. places: (bricks, 4) first entry of the table, cube after cube along x, and
    size; nodes: (bricks, 729) uint8, 0 where a brick asks for none."""

    def __init__(self, cubes: int, side: int, places: np.ndarray, nodes: wp.array):
        device = nodes.device
        self.cubes, self.side, self.nodes = cubes, side, nodes
        self.places = wp.array(np.ascontiguousarray(places, np.int32), dtype=wp.vec4i, device=device)
        shape = (cubes * side, side, side)
        self.table = wp.full(shape, -1, dtype=wp.int32, device=device)
        distance = wp.full(shape, int(SKIP_LIMIT), dtype=wp.uint8, device=device)
        count, entries = len(places), [self.table, self.places]
        launch(kernels.fill_table, count, [self.places], [self.table, distance], device=device)
        self.skip = spread_distances(distance)
        launch(kernels.share_nodes, count * BRICK_NODES, entries, [nodes], device=device)
        launch(kernels.adopt_nodes, count * BRICK_NODES, entries, [nodes], device=device)
        counts = wp.zeros(max(count, 1), dtype=wp.int32, device=device)
        launch(kernels.count_owned, count, [nodes], [counts], device=device)
        wp.utils.array_scan(counts, counts, inclusive=True)
        self.rows = int(counts[-1:].numpy()[0])
        self.links = empty_array((count, BRICK_NODES), wp.int32, device)
        self.sizes = empty_array(self.rows, wp.uint8, device)  # of each row's brick
        launch(kernels.link_owned, count, [self.places, nodes, counts], [self.links, self.sizes], device=device)
        launch(kernels.link_borrowed, count * BRICK_NODES, [*entries, nodes], [self.links], device=device)

    @property
    def held_bytes(self) -> int:
        """Device memory of it."""
        return 5 * self.table.size + self.places.shape[0] * (16 + 5 * BRICK_NODES) + self.rows


class ShellField:
    """Voxels around a box in nested cubes, each twice as large as the one within."""

    # Cube 0 is that of the box's longest side. Bricks of 8^3 voxels exist where there is anything; colours have one
    # slope by the direction from which they are seen.

    def __init__(
        self,
        center: ArrayLike,
        half: ArrayLike,
        layout: BrickLayout,
        values: np.ndarray | wp.array,
        slopes: np.ndarray | wp.array,
        *,
        sky: ArrayLike | wp.array = (1.0, 1.0, 1.0),
    ):
        self.device = wp.get_device(layout.table.device)
        self.center = checked_vector(center, "the center of nested cubes").copy()  # (3,) float64, world units
        self.half = checked_vector(half, "the half sides of nested cubes").copy()
        if not (self.half > 0).all():
            raise InputError(f"the half sides of nested cubes must be positive, got {self.half.tolist()}")
        require_ordinary_side(2.0 * float(self.half.max()), "the box of nested cubes")
        self.layout = layout
        with device_turn(self.device):
            grid: Any = kernels.Shells()
            grid.half, grid.cubes, grid.sky = wp.vec3(*self.half), layout.cubes, sky_layers(sky, self.device)
            grid.table, grid.skip, grid.places, grid.links = layout.table, layout.skip, layout.places, layout.links
            grid.values, grid.slopes = (_on_device(each, layout.rows, self.device) for each in (values, slopes))
        self.grid = grid  # positions in it are relative to the centre

    @property
    def brick_count(self) -> int:
        """Bricks of 8^3 voxels."""
        return self.layout.places.shape[0]

    @property
    def voxel_count(self) -> int:
        """Voxels that hold values."""
        return self.layout.rows

    @property
    def side(self) -> int:
        """Voxels along a side of a cube, where they are finest."""
        return 8 * self.layout.side

    @property
    @in_turn
    def sky(self) -> np.ndarray:
        """(6 s^2 + 2, 3) float32 colours at infinity."""
        return self.grid.sky.values.numpy()[0, :, :3]

    @property
    @in_turn
    def values(self) -> np.ndarray:
        """(rows, 4) float32 red, green, blue and density per half side of the cube."""
        return self.grid.values.numpy()

    @property
    @in_turn
    def slopes(self) -> np.ndarray:
        """(rows, 3) float32 change of the colours along x, y and z of the direction."""
        return self.grid.slopes.numpy()[:, :3]

    @classmethod
    def from_contents(cls, contents: ShellContents, device: wp.DeviceLike = None) -> ShellField:
        """The nested cubes of a file."""
        device = resolve_device(device)
        nodes = wp.array(np.ascontiguousarray(contents.nodes, np.uint8), dtype=wp.uint8, device=device)
        layout = BrickLayout(contents.cubes, contents.side, contents.places, nodes)
        return cls(contents.center, contents.half, layout, contents.values, contents.slopes, sky=contents.sky)

    @in_turn
    def contents(self) -> ShellContents:
        """The bricks on the host, for a file."""
        layout = self.layout
        nodes = layout.nodes.numpy() == int(kernels.OWNED)
        places = layout.places.numpy()
        arrays = self.grid.values.numpy(), self.grid.slopes.numpy()[:, :3], self.sky
        return ShellContents(self.center, self.half, layout.cubes, layout.side, places, nodes, *arrays)

    @property
    def summary(self) -> str:
        """What it is, in a few words."""
        return f"{counted(self.voxel_count, 'voxel')} around it in {self.layout.cubes} nested cubes of {self.side}^3"

    def __repr__(self) -> str:
        center = self.center.round(4).tolist()
        return (
            f"ShellField({self.layout.cubes}x{self.side}^3, {self.voxel_count} voxels around {center}, {self.device})"
        )

    @in_turn
    def sample(self, origins: PointsLike, directions: PointsLike) -> np.ndarray:
        """Colours (n, 3) float32 that rays see of it, with nothing in the box, from origins (n, 3), world units.
        directions: (n, 3), of any length but zero."""
        return seen_by_rays(kernels.sample_shells, self.grid, self.center, origins, directions, self.device)

    def add_around(
        self, camera: Camera, rgb: wp.array, alpha: wp.array, depth: wp.array, masks: Sequence[wp.array] = ()
    ) -> None:
        """Put what is around the box before and behind a view on black: rgb, alpha and masks (h * w,), all changed.
        depth: (h * w,) float32 distance of what the view shows, inf where that is nothing."""
        light = empty_array(alpha.shape[0], wp.float32, self.device)
        inputs = [self.grid, camera_struct(camera, self.center), depth]
        launch(kernels.compose_shells, tile_threads(camera), inputs, [rgb, alpha, light], device=self.device)
        for mask in masks:
            launch(dim_pixels, mask.shape[0], [light], [mask], device=self.device)

    def to(self, device: wp.DeviceLike) -> ShellField:
        """The same on another device; this one if it is there already."""
        device = resolve_device(device)
        return self if device == self.device else ShellField.from_contents(self.contents(), device)


def _on_device(rows: np.ndarray | wp.array, count: int, device: wp.Device) -> wp.array:
    """Four numbers of each row as vec4; arrays of three are filled up with 0."""
    if isinstance(rows, wp.array):
        return rows
    host = np.asarray(rows, np.float32)
    if host.ndim != 2 or len(host) != count or host.shape[1] not in (3, 4) or not np.isfinite(host).all():
        raise InputError(f"nested cubes of {count} rows need finite numbers for each of them, got {host.shape}")
    host = np.pad(host, ((0, 0), (0, 4 - host.shape[1])))
    return wp.array(np.ascontiguousarray(host), dtype=wp.vec4, device=device)


#: What may lie around a field.
Surroundings: TypeAlias = LayeredBackground | OuterField | ShellField
