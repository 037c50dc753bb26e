"""Fit nested cubes of voxels around the box of a field together with the field."""

from __future__ import annotations

import math
import pathlib
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view, empty_array
from ..core.devices import launch
from ..core.files import require_numbers
from ..errors import InputError
from ..field.io.field_file import surface_node_count
from ..field.io.shell_file import MAX_BRICKS, require_apart
from ..field.shells import BRICK_NODES, BrickLayout, ShellField
from ..field.surroundings import sky_layers
from ..field.voxel_field import VoxelField
from ..kernels.field import shells
from ..kernels.field.background import refine_layers
from ..kernels.fitting import shells_loss
from ..kernels.fitting.background_loss import accumulate_layer_variation, apply_layer_rmsprop
from ..view.camera import Camera, camera_array
from .batches import PictureRays, ShardedWork, launch_shards, sum_shards
from .memory import MOST_ITEMS
from .options import FitOptions
from .schedule import Rates
from .surroundings import (
    COLOR_BYTES,
    EPSILON,
    FRONT_BYTES,
    FRONT_DISTANCE,
    FRONT_SHARE,
    MOST_SKY,
    NEAREST_SHARE,
    SKY_RATE,
    SKY_SIDE,
    SKY_VARIATION,
    VALUE_BYTES,
    VARIATION_SIDE,
    checked_sky,
)

#: Cells of a brick, and along its side; and what a node is that has a row.
BRICK_CELLS, CELLS, OWNED = int(shells.BRICK_CELLS), int(shells.BRICK), int(shells.OWNED)

#: Device memory of a brick beside its rows: its place, its nodes and their links; and of an entry of the table.
BRICK_BYTES, ENTRY_BYTES = 16 + 5 * BRICK_NODES, 5

#: Optical depth of half the side of a cube at the start.
START_DEPTH = 0.01

#: Rows of a brick's children for each of their cells that are kept: sheets have more nodes than cells.
NODES_A_CELL = 1.4

#: Weight of the variation of slopes relative to that of colours.
SLOPE_VARIATION = 1.0


class ShellOptimizer:
    """RMSProp on the nested cubes of a fit, one step with each of the field's.
    `prepare`, `accumulate` and `apply` make a step, in this order."""

    def __init__(
        self,
        color: np.ndarray,
        bounds: np.ndarray,
        cameras: list[Camera],
        options: FitOptions,
        side: int,  # voxels along a side of a cube in the last level
        limit: int,  # bytes that the nested cubes may take
        batch_rays: int,
        shards: int,  # arrays of gradients, one for each CPU thread
        device: wp.Device,
    ):
        self.options, self.shards, self.device, self.limit = options, shards, device, limit
        self.batch_rays, self.cameras = batch_rays, cameras
        self.center, self.half = bounds.mean(axis=0), 0.5 * (bounds[1] - bounds[0])
        first = max(1, round(side / CELLS / 2 ** (options.levels - 1)))  # bricks along a side in the first level
        brick = BRICK_NODES * row_bytes(shards) + BRICK_BYTES
        while first > 1 and options.shell_count * first**3 * brick > limit:  # all exist until they are looked at
            first -= 1
        centers = np.stack([camera.center for camera in cameras]) - self.center
        layout = self._whole(options.shell_count, first)
        cells = empty_array((layout.places.shape[0], BRICK_CELLS), wp.uint8, device)
        nearest = NEAREST_SHARE * float(np.linalg.norm(centers, axis=1).min())
        least = max(1, math.ceil(FRONT_SHARE * len(cameras)))
        inputs = [wp.vec3(*self.half), first, layout.places, camera_array(cameras, self.center, device)]
        launch(shells.mark_seen_cells, cells.size, [*inputs, nearest, FRONT_DISTANCE, least], [cells], device=device)
        layout, _ = self._divided(layout, cells, np.zeros(layout.places.shape[0], bool))
        start = np.array([*color, START_DEPTH], np.float32)
        values = np.broadcast_to(start, (layout.rows, 4))
        sky = sky_layers(np.broadcast_to(start[:3], (surface_node_count(SKY_SIDE), 3)), device).values
        self.outer = ShellField(self.center, self.half, layout, values, np.zeros((layout.rows, 3)), sky=sky)
        self._allocate()
        # before and behind the box for each ray (a front has the light that passes too), and the gradients by both
        self.front, self.grad_front = (wp.zeros(batch_rays, dtype=wp.vec4, device=device) for _ in range(2))
        self.behind, self.grad_behind = (wp.zeros(batch_rays, dtype=wp.vec3, device=device) for _ in range(2))

    def _whole(self, cubes: int, side: int) -> BrickLayout:
        """A brick in each entry of a table, without nodes."""
        entries = np.stack(np.meshgrid(*map(np.arange, (cubes * side, side, side)), indexing="ij"), axis=-1)
        places = np.concatenate([entries.reshape(-1, 3), np.ones((entries.size // 3, 1))], axis=1)
        return BrickLayout(
            cubes, side, places, wp.zeros((len(places), BRICK_NODES), dtype=wp.uint8, device=self.device)
        )

    # Bricks

    def _divided(self, layout: BrickLayout, cells: wp.array, split: np.ndarray) -> tuple[BrickLayout, wp.array]:
        """Bricks of the cells (bricks, 512) that are kept, those of `split` (bricks,) divided into eight.
        Also (bricks,) vec2i the brick and the octant that each comes from."""
        kept = self._octants(cells) > 0
        whole = np.flatnonzero(kept.any(axis=1) & ~split)
        parent, octant = np.nonzero(kept & split[:, None])
        places = layout.places.numpy()
        finer = int((split & (places[:, 3] == 1)).any())
        places = places << finer  # a table twice as fine
        corners = np.stack([octant >> 2, (octant >> 1) & 1, octant & 1], axis=1)
        halves = places[parent].copy()
        halves[:, 3] >>= 1
        halves[:, :3] += corners * halves[:, 3:]
        joined = np.concatenate([places[whole], halves])
        parents = np.concatenate(
            [np.stack([whole, np.full(len(whole), -1)], axis=1), np.stack([parent, octant], axis=1)]
        )
        order = np.lexsort(joined[:, 2::-1].T)  # memory order of the table
        origins = wp.array(parents[order].astype(np.int32), dtype=wp.vec2i, device=self.device)
        nodes = wp.zeros((len(joined), BRICK_NODES), dtype=wp.uint8, device=self.device)
        launch(shells_loss.mark_nodes, len(joined) * BRICK_CELLS, [origins, cells], [nodes], device=self.device)
        return BrickLayout(layout.cubes, layout.side << finer, joined[order], nodes), origins

    def _octants(self, cells: wp.array) -> np.ndarray:
        """(bricks, 8) int32 cells that are kept."""
        counts = wp.zeros((cells.shape[0], 8), dtype=wp.int32, device=self.device)
        launch(shells_loss.count_octants, counts.size, [cells], [counts], device=self.device)
        return counts.numpy()

    def _weighty(self, picture_rays: PictureRays, field: VoxelField, threshold: float) -> wp.array:
        """(bricks, 512) uint8, the cells whose rendering weight reaches a threshold in some view."""
        outer, rows = self.outer, self.outer.layout.rows
        stride = max(1, int(0.5 * min(picture_rays.width, picture_rays.height) / outer.side))
        inputs = [outer.grid, field.grid, picture_rays.cameras, stride, field.step]
        kernels = shells_loss.record_shell_weights, shells_loss.record_counted_shell_weights
        weights = picture_rays.record(kernels, inputs, stride, rows, self.shards)
        cells = empty_array((outer.brick_count, BRICK_CELLS), wp.uint8, self.device)
        inputs = [outer.layout.links, weights, threshold]
        launch(shells_loss.mark_weighty_cells, cells.size, inputs, [cells], device=self.device)
        return cells

    def _affordable(self, cells: wp.array, wanted: np.ndarray) -> np.ndarray:
        """(bricks,) bool, which of the bricks that should be divided can be: those that earn most first."""
        octants = self._octants(cells)
        layout, rows = self.outer.layout, row_bytes(self.shards)
        whole = octants.sum(axis=1) * (NODES_A_CELL * rows) + BRICK_BYTES * octants.any(axis=1)
        divided = octants.sum(axis=1) * (8 * NODES_A_CELL * rows) + BRICK_BYTES * (octants > 0).sum(axis=1)
        held = 2 * VALUE_BYTES * layout.rows + layout.held_bytes  # of the bricks before, until the new ones are there
        left = self.limit - held - 8 * ENTRY_BYTES * layout.table.size - whole.sum()
        order = np.argsort(-np.where(wanted, self.earned(), -1.0), kind="stable")
        affordable = np.zeros(len(wanted), bool)
        bricks = np.cumsum((octants > 0).sum(axis=1)[order]) + np.count_nonzero(octants.any(axis=1))
        affordable[order[(np.cumsum((divided - whole)[order]) <= left) & (bricks * BRICK_NODES <= MOST_ITEMS)]] = True
        return affordable & wanted

    def earned(self) -> np.ndarray:
        """(bricks,) float32, what bricks have earned since they were made."""
        return np.sum([each.numpy() for each in self._earned], axis=0)

    def _rebuild(self, cells: wp.array, split: np.ndarray, *, moments: bool) -> None:
        """Go on with the bricks of the cells that are kept, and their values; with their moments, or fresh ones."""
        before = self.outer
        layout, parents = self._divided(before.layout, cells, split)
        old = [before.grid.values, before.grid.slopes, *((self.moments, self.slope_moments) if moments else ())]
        new = []
        for source in old:
            target = wp.zeros(layout.rows, dtype=wp.vec4, device=self.device)
            inputs = [before.layout.links, source, parents, layout.nodes, layout.links]
            count = layout.links.shape[0] * BRICK_NODES
            launch(shells_loss.resample_rows, count, inputs, [target], device=self.device)
            new.append(target)
        self.outer = ShellField(self.center, self.half, layout, new[0], new[1], sky=before.grid.sky.values)
        if moments:
            self.moments, self.slope_moments = new[2:]
            self._allocate_gradients()
        else:
            self._allocate()

    def _release(self) -> None:
        """Free the memory of gradients and second moments."""
        empty = wp.zeros(0, dtype=wp.vec4, device=self.device)
        self.gradients: list[wp.array] = []
        self.slope_gradients: list[wp.array] = []
        self.moments = self.slope_moments = empty
        self.sky_gradients, self.sky_moments = [], wp.zeros((0, 0), dtype=wp.vec4, device=self.device)

    def _allocate(self) -> None:
        """Fresh gradients and second moments."""
        rows = self.outer.layout.rows
        self.moments, self.slope_moments = (wp.zeros(rows, dtype=wp.vec4, device=self.device) for _ in range(2))
        self.sky_moments = wp.zeros_like(self.outer.grid.sky.values)
        self.sky_gradients = [wp.zeros_like(self.sky_moments) for _ in range(self.shards)]
        ones = wp.vec4(1.0, 1.0, 1.0, 1.0)  # the variation goes on where no ray goes, and carries colours there
        self.everywhere = wp.full(self.sky_moments.shape, ones, dtype=wp.vec4, device=self.device)
        self._allocate_gradients()

    def _allocate_gradients(self) -> None:
        rows = self.outer.layout.rows
        self.gradients, self.slope_gradients = (
            [wp.zeros(rows, dtype=wp.vec4, device=self.device) for _ in range(self.shards)] for _ in range(2)
        )
        bricks = self.outer.brick_count
        self._earned = [wp.zeros(bricks, dtype=wp.float32, device=self.device) for _ in range(self.shards)]

    @property
    def held_bytes(self) -> int:
        """Device memory of the bricks, their optimiser, and what is before and behind the rays of a batch."""
        layout = self.outer.layout
        bricks = row_bytes(self.shards) * layout.rows + layout.held_bytes + 4 * self.shards * self.outer.brick_count
        sky = VALUE_BYTES * (3 + self.shards) * self.sky_moments.size
        return bricks + sky + 2 * (FRONT_BYTES + COLOR_BYTES) * self.batch_rays

    # Levels

    def start_level(self, level: int, picture_rays: PictureRays, field: VoxelField) -> None:
        """Prune by what pictures see, and divide bricks, those first that earn most; field: of the level before."""
        cells = self._weighty(picture_rays, field, self.options.prune_weight / self.outer.side)
        split = self._affordable(cells, np.ones(self.outer.brick_count, bool))
        self._release()
        side = min(2 * self.outer.grid.sky.side, MOST_SKY)
        if side != self.outer.grid.sky.side:
            sky = empty_array((1, surface_node_count(side)), wp.vec4, self.device)
            launch(refine_layers, sky.size, [self.outer.grid.sky, side], [sky], device=self.device)
            self.outer.grid.sky = sky_layers(sky, self.device)
        self._rebuild(cells, split, moments=False)

    def thin_out(self, picture_rays: PictureRays, field: VoxelField) -> None:
        """Remove what no picture shows, and keep the second moments of the rest."""
        cells = self._weighty(picture_rays, field, self.options.keep_weight)
        self.gradients, self.slope_gradients = [], []
        self._rebuild(cells, np.zeros(self.outer.brick_count, bool), moments=True)

    def divide(self, picture_rays: PictureRays, field: VoxelField) -> None:
        """Divide the bricks that earn most, where pixels are finer than their voxels, and prune the rest."""
        options, earned = self.options, self.earned()
        cells = self._weighty(picture_rays, field, options.prune_weight / self.outer.side)
        self.gradients, self.slope_gradients = [], []
        top = np.zeros(len(earned), bool)
        top[np.argsort(-earned, kind="stable")[: round(options.shell_divided * len(earned))]] = True
        if self.outer.layout.side == MAX_BRICKS:  # no finer table
            top &= self.outer.layout.places.numpy()[:, 3] > 1
        top[top] = self._pixels_wide(np.flatnonzero(top)) > options.shell_footprint
        self._rebuild(cells, self._affordable(cells, top), moments=True)

    def _pixels_wide(self, bricks: np.ndarray) -> np.ndarray:
        """(bricks,) width of a voxel in pixels of the nearest view that has the middle of its brick, 0 where none."""
        side = self.outer.layout.side
        places = self.outer.layout.places.numpy()[bricks]
        units = self.half.max() * 2.0 ** (places[:, 0] // side)
        corners = np.stack([places[:, 0] % side, places[:, 1], places[:, 2]], axis=1)
        middles = ((corners + 0.5 * places[:, 3:]) * 2.0 / side - 1.0) * units[:, None] + self.center
        voxels = 2.0 * units / side * places[:, 3] / CELLS
        widest = np.zeros(len(bricks))
        for camera in self.cameras:
            local = (middles - camera.center) @ camera.rotation
            ahead = np.maximum(local[:, 2], 1e-9)
            column, row = camera.fx * local[:, 0] / ahead + camera.cx, camera.fy * local[:, 1] / ahead + camera.cy
            seen = (local[:, 2] > 0) & (np.abs(column / camera.width - 0.5) < 0.5)
            seen &= np.abs(row / camera.height - 0.5) < 0.5
            widest = np.maximum(widest, np.where(seen, camera.fx * voxels / ahead, 0.0))
        return widest

    # Steps

    def prepare(self, rays: Any, surroundings: Any) -> None:
        """Fill `front` and `behind` before a batch's march of the field; rays: TrainingRays from its first tile on.
        surroundings are not used: the pictures are whole."""
        self.gather(rays, self.behind, self.front)

    def gather(self, rays: Any, behind: wp.array, front: wp.array | None) -> None:
        """Fill `behind` (rays,) vec3 and `front` (rays,) vec4 with what TrainingRays see around the box."""
        inputs, outputs = [self.outer.grid, rays], [front, behind]
        launch(shells_loss.gather_shells, behind.size, inputs, outputs, device=self.device)

    def accumulate(self, rays: Any, random: np.random.Generator) -> None:
        """Add the gradients of the batch, after the field's march, and of the total variation.
        random: chooses the first cell that gets one of the total variation."""
        options, bricks, side = self.options, self.outer.brick_count, self.outer.side
        grid, sky = self.outer.grid, self.outer.grid.sky
        by_front = options.front_opacity / self.batch_rays
        by_sky = options.sky_follows * 2.0 / (3.0 * self.batch_rays)  # the photometric loss is a mean over channels
        around = [self.front, self.behind, self.grad_front, self.grad_behind]
        photometric = [grid, rays, *around, by_front, by_sky]
        cells = bricks * BRICK_CELLS
        varied = max(1, int(options.variation_share * cells))
        boost = cells / varied / (side**2 * VARIATION_SIDE)
        color = options.variation_outer * boost
        scales = [color, options.variation_outer_density * boost, SLOPE_VARIATION * color]
        variation = [grid, int(random.integers(max(1, cells))), *scales]
        weight = SKY_VARIATION * options.variation_outer / sky.values.size
        sky_variation = [sky, self.everywhere, 0, weight, 0.0]
        grids = [list(each) for each in zip(self.gradients, self.slope_gradients, strict=True)]
        skies = [[each] for each in self.sky_gradients]
        every = [[*grids[n], self._earned[n], *skies[n]] for n in range(self.shards)]
        works = [
            ShardedWork(shells_loss.accumulate_shell_gradient, self.batch_rays, photometric, every),
            ShardedWork(accumulate_layer_variation, sky.values.size, sky_variation, skies),
        ]
        if bricks:
            works.append(ShardedWork(shells_loss.accumulate_shell_variation, varied, variation, grids))
        launch_shards(works, self.shards, self.device)

    def apply(self, rates: Rates) -> None:
        """One step of RMSProp by the gradients, which are cleared."""
        beta, grid = self.options.beta, self.outer.grid
        total = sum_shards([_numbers(gradients) for gradients in self.sky_gradients])
        inputs = [SKY_RATE * rates.outer, beta, EPSILON, total, _numbers(self.sky_moments)]
        launch(apply_layer_rmsprop, total.size, inputs, [_numbers(grid.sky.values)], device=self.device)
        for gradients in (self.gradients, self.slope_gradients):
            sum_shards([_numbers(each) for each in gradients])
        density = rates.outer_density * 0.5 * self.outer.side
        inputs = [rates.outer, density, self.options.shell_slope_rate * rates.outer, beta, EPSILON]
        totals = [self.outer.layout.sizes, self.gradients[0], self.slope_gradients[0]]
        outputs = [self.moments, self.slope_moments, grid.values, grid.slopes]
        launch(shells_loss.apply_shell_rmsprop, self.outer.layout.rows, [*inputs, *totals], outputs, device=self.device)

    # State

    def state(self) -> dict[str, np.ndarray]:
        """Bricks, values and second moments, for a checkpoint."""
        layout, grid = self.outer.layout, self.outer.grid
        return {
            "shells_side": np.array(layout.side, np.int32),
            "shells_places": layout.places.numpy(),
            "shells_nodes": np.packbits((layout.nodes.numpy() == OWNED).ravel()),
            "shells_values": np.concatenate([grid.values.numpy(), grid.slopes.numpy()], axis=1),
            "shells_moments": np.concatenate([self.moments.numpy(), self.slope_moments.numpy()], axis=1),
            "shells_earned": self.earned(),
            "outer_sky": grid.sky.values.numpy()[0],
            "outer_sky_moments": self.sky_moments.numpy()[0],
        }

    def restore(self, contents: dict[str, np.ndarray], level: int, path: pathlib.Path) -> None:
        """Take over the state of a level from a checkpoint's arrays; path: for errors."""
        side = int(require_numbers(contents, "shells_side", (), path))
        if not 1 <= side <= MAX_BRICKS:
            raise InputError(f"nested cubes of {side} bricks along a side")
        places = require_numbers(contents, "shells_places", (None, 4), path).astype(np.int32)
        require_apart(places, self.options.shell_count, side, path)
        size = len(places) * BRICK_NODES
        packed = require_numbers(contents, "shells_nodes", (-(-size // 8),), path)
        nodes = np.unpackbits(packed, count=size).reshape(-1, BRICK_NODES)
        layout = BrickLayout(
            self.options.shell_count, side, places, wp.array(nodes, dtype=wp.uint8, device=self.device)
        )
        values, moments = (
            require_numbers(contents, name, (layout.rows, 8), path) for name in ("shells_values", "shells_moments")
        )
        earned = require_numbers(contents, "shells_earned", (len(places),), path)
        if not all(np.isfinite(each).all() for each in (values, moments, earned)) or moments.min(initial=0.0) < 0:
            raise InputError("the nested cubes hold values that cannot be")
        sky, sky_moments = checked_sky(contents, level, path)
        self._release()
        colors = wp.array(sky, dtype=wp.vec4, device=self.device)
        self.outer = ShellField(self.center, self.half, layout, values[:, :4], values[:, 4:], sky=colors)
        self._allocate()
        self.sky_moments.assign(sky_moments)
        self.moments.assign(np.ascontiguousarray(moments[:, :4], np.float32))
        self.slope_moments.assign(np.ascontiguousarray(moments[:, 4:], np.float32))
        self._earned[0].assign(earned.astype(np.float32))

    def result(self, picture_rays: PictureRays, field: VoxelField) -> ShellField:
        """The nested cubes so far, pruned, colours in [0, 1] and densities of at least 0."""
        cells = self._weighty(picture_rays, field, self.options.keep_weight)
        self._release()
        self._rebuild(cells, np.zeros(self.outer.brick_count, bool), moments=False)
        self._release()
        values, sky = self.outer.values, self.outer.grid.sky.values
        values[:, :3] = np.clip(values[:, :3], 0.0, 1.0)
        values[:, 3] = np.maximum(values[:, 3], 0.0)
        self.outer.grid.values.assign(values)
        sky.assign(np.clip(sky.numpy(), 0.0, 1.0))
        return self.outer


def row_bytes(shards: int) -> int:
    """Device memory of a voxel while it is optimised: values, moments, gradients and its size."""
    return 2 * VALUE_BYTES * (2 + shards) + 1


def _numbers(array: wp.array) -> wp.array:
    """The numbers of an array of vec4, one after another, without a copy."""
    return array_view(array, wp.float32, (4 * array.size,))
