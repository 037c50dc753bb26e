"""What lies around a field: background layers on concentric cubes, and an outer field of contracted space."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import PointsLike, WarpStruct, as_given, as_host_points, empty_array
from ..core.checks import checked_positive, checked_vector
from ..core.devices import half_texture, launch, resolve_device
from ..core.modules import Kernel
from ..core.names import counted
from ..core.threads import device_turn, in_turn
from ..errors import InputError
from ..kernels.field.background import BackgroundLayers, add_background, sample_background
from ..kernels.field.outer import OuterGrid, compose_outer, dim_pixels, sample_outer
from ..kernels.field.outer_bricks import BRICK_CELLS, BRICK_NODES, OuterBricks, fill_bricks, mark_bricks
from ..view.camera import Camera, camera_struct, tile_threads
from .bricks import texture_shape
from .io.field_file import LayerContents, OuterContents, surface_node_count
from .sparse import held_nodes, mask_columns, measure_skip


def seen_by_rays(
    kernel: Kernel, held: Any, center: np.ndarray, origins: PointsLike, directions: PointsLike, device: wp.Device
) -> Any:
    """Colours (n, 3) float32 that rays see, as an array of the origins' kind.
    origins: (n, 3), world units; directions: (n, 3) of any length but zero."""
    starts, along = as_host_points(origins, name="origins") - center, as_host_points(directions, name="directions")
    if starts.shape != along.shape:
        raise InputError(f"there must be as many directions as origins, got {len(along)} for {len(starts)}")
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    rays = [wp.array(each.astype(np.float32), dtype=wp.vec3, device=device) for each in (starts, along)]
    rgb = empty_array(len(starts), wp.vec3, device)
    launch(kernel, len(starts), [held, *rays], [rgb], device=device)  # origins from the centre, unit directions
    return as_given(rgb, origins)


class LayeredBackground:
    """Colour and opacity on concentric cubes, the last one opaque at infinity; values (layers, 6 side^2 + 2, 4)."""

    # Multi-sphere images (Plenoxels 2022, section 3.3) in the max norm; from outer cameras to the field all is empty.

    def __init__(
        self,
        center: ArrayLike,
        half: float,
        side: int,
        values: np.ndarray | wp.array,
        *,
        unseen: ArrayLike | None = None,
        device: wp.DeviceLike = None,
    ):
        self.device = resolve_device(values.device if device is None and isinstance(values, wp.array) else device)
        if int(side) != side or side < 2:
            raise InputError(f"a background has 2 cells or more along an edge, got {side}")
        node_count = surface_node_count(side)
        self.center = checked_vector(center, "a background's center").copy()  # (3,) float64, world units
        half = checked_positive(half, "a background's half side")
        # red, green, blue and optical depth (below 0: none; the last one unused), in kernels/field/background's order
        if not isinstance(values, wp.array):
            values = np.asarray(values, np.float32)
            if not np.isfinite(values).all():
                raise InputError("a background's values must be finite")
        shape = tuple(values.shape) + ((4,) if isinstance(values, wp.array) else ())
        if len(shape) != 3 or shape[0] < 2 or shape[1:] != (node_count, 4):
            raise InputError(
                f"a background of {side} cells along an edge has values (2 layers or more, "
                f"{node_count}, 4), got {shape}"
            )
        self.unseen = None if unseen is None else np.array(unseen, np.float32)  # what nodes hold that no picture showed
        if self.unseen is not None and (self.unseen.shape != (4,) or not np.isfinite(self.unseen).all()):
            raise InputError(f"a background's unseen must be (4,) and finite, got {self.unseen.tolist()}")
        layers = BackgroundLayers()
        layers.half, layers.side = half, int(side)
        if isinstance(values, wp.array):
            layers.values = values if values.device == self.device else values.to(self.device)
        else:
            with device_turn(self.device):
                layers.values = wp.array(values, dtype=wp.vec4, device=self.device)
        self.layers = layers  # positions in it are relative to the centre

    @property
    def half(self) -> float:
        """Half side of the innermost cube, world units."""
        return self.layers.half

    @property
    def side(self) -> int:
        """Cells along an edge of a cube."""
        return self.layers.side

    @property
    def layer_count(self) -> int:
        """Number of cubes."""
        return self.layers.values.shape[0]

    @property
    @in_turn
    def values(self) -> np.ndarray:
        """(layers, nodes, 4) float32 red, green, blue and optical depth."""
        return self.layers.values.numpy()

    @classmethod
    def from_contents(cls, contents: LayerContents, device: wp.DeviceLike = None) -> LayeredBackground:
        """The background of a file."""
        return cls(
            contents.center, contents.half, contents.side, contents.values, unseen=contents.unseen, device=device
        )

    def contents(self) -> LayerContents:
        """The layers on the host, for a file."""
        return LayerContents(self.center, self.half, self.side, self.values, self.unseen)

    @property
    def summary(self) -> str:
        """A short description."""
        return f"{self.layer_count} background layers"

    def __repr__(self) -> str:
        return f"LayeredBackground({self.layer_count} layers of 6x{self.side}x{self.side}, {self.device})"

    @in_turn
    def sample(self, origins: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Colours (n, 3) float32 that rays see of the layers; origins (n, 3), world units.
        directions: (n, 3), of any length but zero."""
        return seen_by_rays(sample_background, self.layers, self.center, origins, directions, self.device)

    def add_around(
        self, camera: Camera, rgb: wp.array, alpha: wp.array, depth: wp.array, masks: Sequence[wp.array] = ()
    ) -> None:
        """Put the background behind a view on black: rgb (h * w,) vec3, changed, alpha (h * w,).
        depth and masks are not used: all layers lie behind."""
        inputs = [self.layers, camera_struct(camera, self.center), alpha]
        launch(add_background, tile_threads(camera), inputs, [rgb], device=self.device)

    def to(self, device: wp.DeviceLike) -> LayeredBackground:
        """The same background on another device; this one if it is there already."""
        device = resolve_device(device)
        if device == self.device:
            return self
        return LayeredBackground(
            self.center, self.half, self.side, self.layers.values, unseen=self.unseen, device=device
        )


class OuterField:
    """A sparse voxel grid of the space around a box, contracted into a cube (MeRF 2023, Eq. 8)."""

    # Outside the box, [-1, 1]^3, space is pressed into [-2, 2]^3: voxels grow with their distance, the last reach
    # infinity. What lies before the box hides it, what lies behind shows where it lets light through.

    def __init__(
        self,
        center: ArrayLike,
        half: ArrayLike,
        links: np.ndarray | WarpStruct,
        values: np.ndarray | wp.array,
        *,
        sky: ArrayLike | wp.array = (1.0, 1.0, 1.0),
        device: wp.DeviceLike = None,
    ):
        self.device = resolve_device(values.device if device is None and isinstance(values, wp.array) else device)
        self.center = checked_vector(center, "an outer field's center").copy()  # (3,) float64, world units, as `half`
        self.half = checked_vector(half, "an outer field's half sides").copy()
        if not (self.half > 0).all():
            raise InputError(f"an outer field's half sides must be positive, got {self.half.tolist()}")
        # the row of each voxel or -1; or Columns, of rows on this device in the order of memory
        shape = tuple(links.shape if isinstance(links, np.ndarray) else links.node_counts)
        if len(shape) != 3 or len(set(shape)) != 1 or shape[0] < 4:
            raise InputError(f"an outer field's links must be (n, n, n), n at least 4, got {shape}")
        rows = tuple(values.shape) + ((4,) if isinstance(values, wp.array) else ())  # r, g, b, density; below 0: none
        if len(rows) != 2 or rows[1] != 4:
            raise InputError(f"an outer field's values must be (rows, 4), got {rows}")
        with device_turn(self.device):
            grid = OuterGrid()
            grid.half, grid.sky = wp.vec3(*self.half), sky_layers(sky, self.device)
            if isinstance(links, np.ndarray):
                host = np.ascontiguousarray(values, np.float32)
                if not np.isfinite(host).all() or int(links.max(initial=-1)) >= len(host):
                    raise InputError("an outer field's values must be finite, one row for each that its links name")
                held = links >= 0
                grid.values = wp.array(host[links[held]], dtype=wp.vec4, device=self.device)
                grid.columns, _ = mask_columns(wp.array(held, dtype=wp.uint8, device=self.device))
            else:
                grid.columns, grid.values = links, values
            grid.skip = measure_skip(grid.columns)
        self.grid = grid  # positions in it are relative to the centre
        self._bricks: list[wp.Texture3D] | None = None  # of `shown_grid`, which holds its handle alone

    def shown_grid(self) -> Any:
        """The grid as frames read it: on CUDA with the texture of its values, made when it is first asked for."""
        if self.device.is_cuda and self._bricks is None:
            self._bricks = _texture_of_bricks(self.grid)
        return self.grid

    def forget_bricks(self) -> None:
        """Make the texture anew for the next frame: the values have changed."""
        self._bricks = None

    @property
    def side(self) -> int:
        """Voxels along each side of contracted space; half of them stand for the box, and hold nothing."""
        return int(self.grid.columns.node_counts[0])

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
        values = contents.links, contents.values
        return cls(contents.center, contents.half, *values, sky=contents.sky, device=device)

    @in_turn
    def contents(self) -> OuterContents:
        """The grid on the host, for a file."""
        links = np.full((self.side,) * 3, -1, np.int32)
        held = held_nodes(self.grid.columns)
        links[held] = np.arange(np.count_nonzero(held), dtype=np.int32)
        return OuterContents(self.center, self.half, links, self.grid.values.numpy(), self.sky)

    @property
    def summary(self) -> str:
        """A short description."""
        return f"{counted(self.voxel_count, 'voxel')} around it in {self.side}^3 of contracted space"

    def __repr__(self) -> str:
        center = self.center.round(4).tolist()
        return f"OuterField({self.side}^3, {self.voxel_count} voxels around {center}, {self.device})"

    @in_turn
    def sample(self, origins: ArrayLike, directions: ArrayLike) -> np.ndarray:
        """Colours (n, 3) float32 that rays see of it, with nothing in the box, from origins (n, 3), world units.
        directions: (n, 3), of any length but zero."""
        return seen_by_rays(sample_outer, self.shown_grid(), self.center, origins, directions, self.device)

    def add_around(
        self, camera: Camera, rgb: wp.array, alpha: wp.array, depth: wp.array, masks: Sequence[wp.array] = ()
    ) -> None:
        """Put what is around the box before and behind a view on black: rgb, alpha and masks (h * w,), all changed.
        depth: (h * w,) float32 distance of what the view shows, inf where that is nothing."""
        light = empty_array(alpha.shape[0], wp.float32, self.device)
        inputs = [self.shown_grid(), camera_struct(camera, self.center), depth]
        launch(compose_outer, tile_threads(camera), inputs, [rgb, alpha, light], device=self.device)
        for mask in masks:
            launch(dim_pixels, mask.shape[0], [light], [mask], device=self.device)

    def to(self, device: wp.DeviceLike) -> OuterField:
        """The same on another device; this one if it is there already."""
        device = resolve_device(device)
        if device == self.device:
            return self
        contents = self.contents()
        return OuterField(self.center, self.half, contents.links, contents.values, sky=contents.sky, device=device)


def _texture_of_bricks(grid: Any) -> list[wp.Texture3D]:
    """The texture of an OuterGrid on CUDA, which gets it; none where it holds nothing."""
    cells, nodes, device = int(BRICK_CELLS), int(BRICK_NODES), grid.values.device
    count = -(-grid.skip.shape[0] // cells)
    marks = wp.zeros((count, count, count), dtype=wp.int32, device=device)
    launch(mark_bricks, grid.skip.size, [grid.skip], [marks], device=device)
    places = np.argwhere(marks.numpy())
    numbers = np.full((count, count, count), -1, np.int32)
    numbers[tuple(places.T)] = np.arange(len(places))
    bricks: Any = OuterBricks()
    bricks.numbers = wp.array(numbers, dtype=wp.int32, device=device)
    if not len(places):
        return []
    texture = half_texture(texture_shape(len(places)), device)
    listed = wp.array(places.astype(np.int32), dtype=wp.vec3i, device=device)
    inputs = [listed, grid.columns, grid.values, wp.uint64(texture.cuda_surface)]
    launch(fill_bricks, nodes**3 * len(places), inputs, device=device)
    wp.synchronize_stream(device.stream)  # frames of other streams may be the next to read it
    bricks.texture = texture.cuda_texture
    grid.bricks = bricks  # structs are copied as they are set
    return [texture]


def sky_layers(sky: Any, device: wp.Device) -> Any:
    """BackgroundLayers of one layer, which begins at infinity, of a sky: one colour (3,), or (6 s^2 + 2, 3) of a cube.
    These in the order of kernels/field/background; or a Warp array (1, 6 s^2 + 2) of vec4."""
    if not isinstance(sky, wp.array):
        colors = np.asarray(sky, np.float32)
        if colors.shape == (3,):
            colors = np.broadcast_to(colors, (surface_node_count(2), 3))
        if colors.ndim != 2 or colors.shape[1] != 3 or not np.isfinite(colors).all():
            raise InputError(f"an outer field's sky must be finite (3,) or (6 s^2 + 2, 3), got {colors.shape}")
        values = np.concatenate([colors, np.ones((len(colors), 1), np.float32)], axis=1)[None]
        sky = wp.array(np.ascontiguousarray(values), dtype=wp.vec4, device=device)
    nodes = sky.shape[-1]
    side = math.isqrt(max(0, (nodes - 2) // 6))
    if len(sky.shape) != 2 or side < 2 or nodes != surface_node_count(side):
        raise InputError(f"an outer field's sky must hold 6 s^2 + 2 colours, s at least 2, got {nodes}")
    layers: Any = BackgroundLayers()
    layers.half, layers.side = 1.0, side
    layers.values = sky if sky.device == device else sky.to(device)
    return layers
