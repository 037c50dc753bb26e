"""One level of a fit: a field, what optimises the values of its voxels, and the plain field that a fit starts from."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array
from ..core.devices import lane_count, launch
from ..errors import InputError
from ..field.io.field_file import LUMINANCE_NUMBERS, Y0
from ..field.render import STOP_TRANSMITTANCE
from ..field.sparse import gathered, link_mask, mask_nodes, place_grid
from ..field.voxel_field import VoxelField
from ..kernels.field import refine as grid_refine
from ..kernels.field.grid import VoxelGrid
from ..kernels.field.march import record_weights
from ..kernels.fitting import rmsprop
from ..kernels.fitting.loss import accumulate_photometric_gradient
from ..kernels.fitting.loss_warps import accumulate_photometric_gradient_by_warps
from .batches import Batch, PictureRays, ShardedWork, ViewCounts, launch_shards, sum_shards
from .memory import FitMemory
from .schedule import Rates
from .silhouettes import dilated


def field_from_mask(
    bounds: ArrayLike, mask: wp.array, density: float, *, background: str | ArrayLike, device: wp.DeviceLike
) -> tuple[VoxelField, wp.array]:
    """A grey field of one density at the set nodes of a mask (nx, ny, nz) uint8, and its nodes (rows,) int32."""
    links, nodes = link_mask(mask)
    rows = nodes.shape[0]
    field = VoxelField(
        bounds,
        links,
        wp.full(rows, density, dtype=wp.float32, device=device),
        wp.zeros((rows, LUMINANCE_NUMBERS), dtype=wp.float32, device=device),
        background=background,
        device=device,
    )
    return field, nodes


COEFFICIENTS = int(rmsprop.COEFFICIENTS)

#: Numbers of a row's gradient: the coefficients and the density; and items of the optimiser's step for a row.
ROW_NUMBERS, ROW_PARTS = int(rmsprop.GRADIENT_ROW), int(rmsprop.ROW_PARTS)

#: Bytes per row of the field: density, coefficients and the place of its node.
FIELD_ROW_BYTES = 4 + 4 * COEFFICIENTS + 4

#: Bytes per row of one shard's gradients, of the second moments, and of the mark of rows that a gradient touched.
GRADIENT_BYTES, MOMENT_BYTES, MARK_BYTES = 4 * ROW_NUMBERS, 2 * ROW_NUMBERS, 1

#: Bytes per row of the number of views that show it.
COUNT_BYTES = 1

#: Bytes of the field per node of the box (its row), and per cell (how far a march may skip).
LINK_BYTES, SKIP_BYTES = 4, 1

#: Voxels along the longest side for which the weights of the total variation are meant.
VARIATION_SIDE = 256.0

#: Optical depth of half the box at the start.
START_DEPTH = 0.1

#: Keeps a step finite where the second moment is almost zero.
EPSILON = 1e-12


@dataclasses.dataclass(frozen=True)
class Look:
    """Which voxels of a finer grid (nx, ny, nz) pictures show."""

    mask: wp.array  # (nx, ny, nz) uint8, those voxels
    links: wp.array  # (nx, ny, nz) int32, rows of all that were looked at
    counts: wp.array | None  # (rows,) uint8, how many pictures show each, 255 at most; None counts none

    @property
    def shape(self) -> tuple[int, ...]:
        """(nx, ny, nz)."""
        return tuple(self.mask.shape)


def weighty_mask(shape: tuple[int, ...], nodes: wp.array, weights: wp.array, threshold: float) -> wp.array:
    """(nx, ny, nz) uint8 mask of the nodes (rows,), flat indices, with a weight (rows,) from a threshold on, and of
    their neighbours among the nodes."""
    rows, device = nodes.shape[0], nodes.device
    mask = wp.zeros(shape, dtype=wp.uint8, device=device)
    launch(grid_refine.mark_weighty_nodes, rows, [nodes, weights, threshold], [mask.flatten()], device=device)
    near = dilated(mask)
    mask.zero_()
    launch(grid_refine.take_nodes, rows, [nodes, near.flatten()], [mask.flatten()], device=device)
    return mask


class Level:
    """The rows of the level that a fit has reached: their values, gradients and second moments.
    25 numbers of each row: the 24 coefficients of all rows, then their densities."""

    def __init__(self, mask: wp.array, bounds: np.ndarray, background: np.ndarray, shards: int, views: float = 0.0):
        self.shards = shards  # arrays of gradients, one for each CPU thread
        self.field, self.nodes = _started(mask, bounds, background)  # nodes: (rows,) int32, flat
        self.views = ViewCounts(views, self.field.device)  # of the rows
        self.gradients: list[wp.array] = []  # (25 rows,) float32 for each shard; none while pruning
        # touched: (rows,), 1 where there is a gradient; moments: (25 rows,) bfloat16, none while the level changes
        self.touched, self.moments = _marks(0, self.field.device), _moments(0, self.field.device)
        self.allocate()

    # Memory

    def allocate(self) -> None:
        """Fresh gradients and second moments."""
        self.allocate_gradients()
        self.moments = _moments(self.field.voxel_count, self.field.device)

    def allocate_gradients(self) -> None:
        """Fresh gradients."""
        rows, device = self.field.voxel_count, self.field.device
        self.gradients = [wp.zeros(rows * ROW_NUMBERS, dtype=wp.float32, device=device) for _ in range(self.shards)]
        self.touched = _marks(rows, device)

    def release_gradients(self) -> None:
        """Free the memory of the gradients, which are zero between steps."""
        self.gradients = []

    def release(self) -> None:
        """Free the memory of gradients and second moments."""
        self.release_gradients()
        self.moments = _moments(0, self.field.device)

    @property
    def held_bytes(self) -> int:
        """Device memory of the level while it is optimised."""
        rows = row_bytes(self.shards) * self.field.voxel_count
        return rows + node_bytes(self.field.resolution) + self.views.held_bytes

    def memory(self, fixed: int, tiles: int) -> FitMemory:
        """What this level and others take. See `level_memory`."""
        return level_memory(self.field.resolution, self.shards, fixed, tiles, counted=self.views.is_used)

    # Rows

    def restart(self, mask: wp.array) -> None:
        """Rows for a mask (nx, ny, nz) uint8 with fresh state, whatever was there before."""
        self.release()
        self.field, self.nodes = _started(mask, self.field.bounds, self.field.background)
        self.views.forget()
        self.allocate()

    def paint(self, color: np.ndarray) -> None:
        """Give all rows one colour (3,), from all directions."""
        red, green, blue = (np.asarray(color, np.float64) - 0.5) / Y0
        orange, difference = 0.5 * (red - blue), (green - 0.5 * (red + blue)) / 1.5
        row = np.zeros(COEFFICIENTS, np.float32)
        row[[0, 16, 20]] = green - difference, orange, difference
        self.field.grid.sh.assign(np.tile(row, (self.field.voxel_count, 1)))

    def look(self, shape: tuple[int, ...], kept: wp.array, picture_rays: PictureRays, least: float) -> Look:
        """Which voxels of a finer grid (nx, ny, nz) pictures show, by densities interpolated from this one.
        kept: uint8 mask over the nodes of this grid, voxels with children; least: rendering weight that shows one."""
        device, ratio = kept.device, wp.vec3(*(n / m for n, m in zip(shape, kept.shape, strict=True)))
        mask = empty_array(shape, wp.uint8, device)
        launch(grid_refine.refine_mask, mask.size, [ratio, kept], [mask], device=device)
        grid = VoxelGrid()
        grid.links, nodes = link_mask(mask)
        rows = nodes.shape[0]
        grid.density = empty_array(rows, wp.float32, device)
        inputs = [self.field.grid, wp.vec3i(*shape), nodes]
        launch(grid_refine.resample_rows, rows, inputs, [grid.density, None], device=device)
        place_grid(grid, self.field.bounds)
        counts = wp.zeros(rows, dtype=wp.uint8, device=device) if self.views.is_used else None
        # as fields of this resolution march
        inputs = [grid, 0.5 * min(grid.voxel_size), STOP_TRANSMITTANCE]
        stride = picture_rays.stride(max(shape))
        weights = picture_rays.record(record_weights, inputs, stride, rows, self.shards, counts)
        return Look(weighty_mask(shape, nodes, weights, least), grid.links, counts)

    def refine(self, look: Look) -> None:
        """Values at the voxels of a look, interpolated; gradients and second moments stay released."""
        coarse = self.field
        fine, self.nodes = _started(look.mask, coarse.bounds, coarse.background)
        launch(
            grid_refine.resample_rows,
            fine.voxel_count,
            [coarse.grid, wp.vec3i(*fine.resolution), self.nodes],
            [fine.grid.density, fine.grid.sh],
            device=fine.device,
        )
        self.field = fine
        self.views.forget()
        if look.counts is not None:
            self.views.take(look.counts, gathered(look.links.flatten(), self.nodes))

    def keep(self, mask: wp.array) -> wp.array:
        """Only the rows of a mask (nx, ny, nz) uint8 over the grid, with their second moments where there are any;
        gradients stay released. Returns which each was before, (rows,) int32."""
        coarse, device, self.nodes = self.field, mask.device, mask_nodes(mask)
        rows, count = gathered(coarse.grid.links.flatten(), self.nodes), self.nodes.shape[0]
        _require_rows(count)
        bounds, background, grid = coarse.bounds, coarse.background, coarse.grid
        density, sh = empty_array(count, wp.float32, device), empty_array((count, COEFFICIENTS), wp.float32, device)
        inputs = [rows, grid.density, _fours(grid.sh)]
        launch(rmsprop.gather_numbers, ROW_PARTS * count, inputs, [density, _fours(sh)], device=device)
        del self.field, coarse, grid, inputs  # one grid at a time
        if self.moments.size:
            moments = empty_array(count * ROW_NUMBERS, wp.bfloat16, device)
            inputs = [rows, *_quads(self.moments)]
            launch(rmsprop.gather_numbers, ROW_PARTS * count, inputs, _quads(moments), device=device)
            self.moments = moments
        self.views.follow(rows)
        self.field = VoxelField(bounds, link_mask(mask)[0], density, sh, background=background, device=device)
        return rows

    def finish(self, picture_rays: PictureRays, threshold: float) -> VoxelField:
        """The field of the voxels that matter to pictures, with its rendering weights.
        threshold: rendering weight from which a voxel matters."""
        self.release()
        weights = self.measure_weights(picture_rays)
        rows = self.keep(weighty_mask(self.field.resolution, self.nodes, weights, threshold))
        self.field.weights = gathered(weights, rows)
        return self.field

    def measure_weights(
        self, picture_rays: PictureRays, pixel_stride: int = 1, counts: wp.array | None = None
    ) -> wp.array:
        """(rows,) float32, the largest rendering weight that pictures' pixels give to each voxel.
        pixel_stride: every how many pixels there is a ray, along both sides; counts: as of PictureRays.record."""
        inputs = [self.field.grid, self.field.step, STOP_TRANSMITTANCE]
        rows = self.field.voxel_count
        return picture_rays.record(record_weights, inputs, pixel_stride, rows, self.shards, counts)

    def weighty_mask(self, picture_rays: PictureRays, threshold: float, *, counts: bool = False) -> wp.array:
        """(nx, ny, nz) uint8 mask of the voxels with a rendering weight from a threshold on, and their neighbours.
        Of those that have a row. counts: whether the pictures that show each row are counted on the way."""
        stride = picture_rays.stride(max(self.field.resolution))
        added = self.views.begin(self.field.voxel_count) if counts else None
        weights = self.measure_weights(picture_rays, stride, added)
        return weighty_mask(self.field.resolution, self.nodes, weights, threshold)

    # Steps

    def accumulate(
        self, batch: Batch, weights: tuple[float, float, float], share: float, random: np.random.Generator
    ) -> None:
        """Add the gradients of a batch's photometric loss, which writes its squared errors, and of the total variation.
        weights: of density, SH degrees 0 and 1, and 2 and 3, per voxel of the box; share: of rows that it takes."""
        field, device = self.field, self.field.device
        photometric = [
            batch.rays,
            wp.vec3(*map(float, field.background)),
            int(batch.random_background),
            batch.seed,
            field.step,
            STOP_TRANSMITTANCE,
            1.0 / (3.0 * batch.size),
            batch.behind,
            batch.front,
        ]
        varied = max(1, int(share * field.voxel_count))
        # a share of the rows stands for all of them
        boost = field.voxel_count / varied / float(np.prod(field.resolution)) * (max(field.resolution) / VARIATION_SIDE)
        variation = ShardedWork(
            rmsprop.accumulate_variation_gradient,
            varied,
            [
                field.grid,
                self.nodes,
                int(random.integers(field.voxel_count)),
                1.0 / (0.5 * float((field.bounds[1] - field.bounds[0]).max())),
                *(weight * boost for weight in weights),
                self.views.counts,
                self.views.factors,
            ],
            [[gradients, self.touched] for gradients in self.gradients],
            items=ROW_NUMBERS,
        )
        works = [variation] if max(weights) > 0 else []
        if device.is_cpu:
            outputs = [
                [*gradient_parts(gradients), batch.squared_error, batch.grad_behind, batch.grad_front]
                for gradients in self.gradients
            ]
            inputs = [field.grid, *photometric]
            works.insert(0, ShardedWork(accumulate_photometric_gradient, batch.size, inputs, outputs))
        else:
            launch(
                accumulate_photometric_gradient_by_warps,
                lane_count(device) * batch.size,
                [field.grid, *photometric],
                [self.gradients[0], self.touched, batch.squared_error, batch.grad_behind, batch.grad_front],
                device=device,
            )
        launch_shards(works, self.shards, device)

    def apply(self, rates: Rates, beta: float) -> None:
        """One step of RMSProp by the gradients, which are cleared; beta: decay of the second moments."""
        field = self.field
        voxel = float(field.voxel_size.max())
        if field.device.is_cpu:  # its photometric gradient leaves no marks
            self.touched.fill_(1)
        total = sum_shards(self.gradients)
        inputs = [
            rates.density / voxel,
            wp.vec4(*rates.sh),
            beta,
            EPSILON * voxel,  # a density's gradient is a length
            EPSILON,
            self.touched,
            *_quads(total),
            *_quads(self.moments),
        ]
        outputs = [field.grid.density, _fours(field.grid.sh)]
        launch(rmsprop.apply_rmsprop, ROW_PARTS * field.voxel_count, inputs, outputs, device=field.device)
        self.touched.zero_()
        if rates.directional_kept < 1:
            inputs = [rates.directional_kept]
            items = COEFFICIENTS * field.voxel_count
            launch(rmsprop.shrink_view_dependence, items, inputs, [field.grid.sh], device=field.device)


def row_bytes(shards: int) -> int:
    """Device memory per row of a level that is optimised with `shards` arrays of gradients."""
    return FIELD_ROW_BYTES + shards * GRADIENT_BYTES + MOMENT_BYTES + MARK_BYTES


def node_bytes(shape: tuple[int, ...]) -> int:
    """Device memory of a level for a grid of (nx, ny, nz), whatever rows it has."""
    return LINK_BYTES * math.prod(shape) + SKIP_BYTES * math.prod(n - 1 for n in shape)


def level_memory(shape: tuple[int, ...], shards: int, fixed: int, tiles: int, *, counted: bool = False) -> FitMemory:
    """What levels of any resolution take; shape (nx, ny, nz) is for the cells per node, shards are arrays of gradients.
    fixed: bytes beside the grid; tiles: bytes of a number for each tile of the pictures; counted: whether views are."""
    return FitMemory(
        fixed=fixed,
        node=node_bytes(shape) / math.prod(shape),
        row=row_bytes(shards) + (COUNT_BYTES if counted else 0),
        field_row=FIELD_ROW_BYTES,
        moment_row=MOMENT_BYTES,
        shards=shards,
        tiles=tiles,
        row_numbers=ROW_NUMBERS,
    )


def gradient_parts(gradients: wp.array) -> tuple[wp.array, wp.array]:
    """Densities (rows,) and coefficients (rows, 24) of gradients (25 rows,) float32, without a copy."""
    rows = gradients.size // ROW_NUMBERS
    density = array_view(gradients, wp.float32, rows, offset=4 * COEFFICIENTS * rows)
    return density, array_view(gradients, wp.float32, (rows, COEFFICIENTS))


def _fours(sh: wp.array) -> wp.array:
    """Coefficients (rows, 24) as (rows, 6) of four, without a copy."""
    return array_view(sh, wp.vec4, (sh.shape[0], ROW_PARTS - 1))


def _quads(values: wp.array) -> tuple[wp.array, wp.array]:
    """Densities (rows,) and coefficients (rows, 6) of four, of numbers (25 rows,) in float32 or bfloat16."""
    rows, halved = values.size // ROW_NUMBERS, values.dtype == wp.bfloat16
    density = array_view(values, values.dtype, rows, offset=(2 if halved else 4) * COEFFICIENTS * rows)
    return density, array_view(values, rmsprop.four_bfloats if halved else wp.vec4, (rows, ROW_PARTS - 1))


def _started(mask: wp.array, bounds: np.ndarray, background: np.ndarray) -> tuple[VoxelField, wp.array]:
    """A grey field with a row for each voxel of a mask, and its nodes."""
    density = START_DEPTH / (0.5 * float((bounds[1] - bounds[0]).max()))
    field, nodes = field_from_mask(bounds, mask, density, background=background, device=mask.device)
    _require_rows(field.voxel_count)
    return field, nodes


def _require_rows(rows: int) -> None:
    if not rows:
        raise InputError(
            "nothing is left to render after pruning: all images may show the background alone, or "
            "not fit their cameras"
        )


def _moments(rows: int, device: wp.Device) -> wp.array:
    return wp.zeros(rows * ROW_NUMBERS, dtype=wp.bfloat16, device=device)


def _marks(rows: int, device: wp.Device) -> wp.array:
    return wp.zeros(rows, dtype=wp.uint8, device=device)
