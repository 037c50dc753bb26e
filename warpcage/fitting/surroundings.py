"""Fit what is around the box of a field together with the field: an outer field, or background layers."""

from __future__ import annotations

import math
import pathlib
from typing import Any

import numpy as np
import warp as wp

from ..core.arrays import array_view, empty_array
from ..core.devices import launch, octet_items
from ..core.names import FIT_BACKGROUNDS, checked_choice
from ..core.npz import require_numbers
from ..errors import InputError
from ..field.io.field_file import surface_node_count
from ..field.sparse import column_rows, gathered, held_nodes, mask_columns, mask_count
from ..field.surroundings import LayeredBackground, OuterField, sky_layers
from ..field.voxel_field import VoxelField
from ..kernels.field import refine as grid_refine
from ..kernels.field.background import BackgroundLayers, refine_layers
from ..kernels.field.outer import mark_outer_nodes, resample_outer
from ..kernels.fitting import background_loss, outer_loss
from ..kernels.fitting.background_loss import accumulate_layer_variation, apply_layer_rmsprop
from ..scene.scene import Scene
from ..view.camera import Camera, camera_array
from .batches import PictureRays, ShardedWork, ViewCounts, launch_shards, sum_shards
from .level import EPSILON, VARIATION_SIDE, weighty_mask
from .memory import FitMemory
from .options import FitOptions
from .schedule import Rates, least_weight

#: Opacity of all layers in front of the last one together, at the start.
START_OPACITY = 0.5

#: Where this share of the pictures' border pixels has the scene's background colour, nothing else is taken to be there.
PLAIN_SHARE, PLAIN_DIFFERENCE = 0.95, 2.5 / 255

#: Share of the memory of a fit that layers may take, and least cells along an edge that the images ask for.
LAYERS_MEMORY_SHARE, MIN_SIDE = 0.25, 16

#: Bytes of a node's colour and optical depth, and of a colour.
LAYER_NODE_BYTES, LAYER_COLOR_BYTES = 16, 12

#: Nodes that differ from the start by no more than this were met by no ray: interpolation rounds.
UNMET_DIFFERENCE = 1e-6

#: Every how many pixels the mean colour takes one.
COLOR_STRIDE = 8


def chosen_background(scene: Scene, kind: str) -> tuple[bool, str | None]:
    """Whether random colours are behind a field in a fit; and "layers", "outer" or None, what is fitted beside it."""
    checked_choice(kind, "background", FIT_BACKGROUNDS)
    if kind == "auto":
        if scene.alphas is None:
            return False, None if _is_plain(scene) else "outer"  # plain: its border shows the background alone
        return True, None if scene.surroundings is None else "layers"
    if kind == "layers" and scene.alphas is not None and scene.surroundings is None:
        raise InputError(
            "the pictures' own background is cut away by their opacity: background layers need whole "
            "pictures (masks=False) or split ones (masks='split')"
        )
    if kind == "outer" and scene.alphas is not None:
        raise InputError("an outer field needs whole pictures: load them with masks=False, or fit background='layers'")
    if kind == "random" and scene.alphas is None:
        raise InputError("the pictures have no opacity: random backgrounds need it, fit with background='layers'")
    is_random = kind == "random" or (kind == "layers" and scene.alphas is not None)
    return is_random, kind if kind in ("layers", "outer") else None


def _is_plain(scene: Scene) -> bool:
    same = count = 0
    for index, image in enumerate(scene.images):
        image = scene.cut(index, image)
        counts = np.ones(image.shape[:2], bool) if scene.weights is None else scene.cut(index, scene.weights[index]) > 0
        for border in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
            plain = (np.abs(image[border] - scene.background) < PLAIN_DIFFERENCE).all(axis=-1)
            same, count = same + (plain & counts[border]).sum(), count + counts[border].sum()
    return bool(same >= PLAIN_SHARE * count > 0)


def layers_that_fit(scene: Scene, options: FitOptions, shards: int, limit: int) -> tuple[int, int]:
    """Cells along a layer's edge, and the bytes that the layers, their moments and their gradients then take.
    shards: arrays of gradients, one for each CPU thread; limit: bytes that the fit may take."""
    side = options.background_side
    if side is None:
        focal = float(np.median([camera.fx for camera in scene.cameras]))  # pixels per unit of a face's half side
        least = min(MIN_SIDE, options.max_background_side)
        side = int(np.clip(2.0 * focal * options.background_detail, least, options.max_background_side))
    surface_bytes = options.background_layers * LAYER_NODE_BYTES * (2 + shards)  # values, moments and gradients
    side = max(2, min(side, math.isqrt(int(limit * LAYERS_MEMORY_SHARE / (6 * surface_bytes)))))
    return side, surface_bytes * surface_node_count(side)


class BackgroundOptimizer:
    """RMSProp on the layers behind a field, one step with each of the field's.
    `prepare`, `accumulate` and `apply` make a step, in this order."""

    #: Nothing is before the field.
    front = grad_front = None

    def __init__(
        self,
        color: np.ndarray,
        split: bool,  # False: field and layers explain every ray together; True: layers explain the surroundings alone
        bounds: np.ndarray,
        options: FitOptions,
        side: int,  # cells along a layer's edge in the last level
        batch_rays: int,
        shards: int,  # arrays of gradients, one for each CPU thread
        device: wp.Device,
    ):
        self.options, self.device, self.batch_rays, self.shards = options, device, batch_rays, shards
        self.center, self.half = bounds.mean(axis=0), 0.5 * float((bounds[1] - bounds[0]).max())
        self.sides = [max(2, round(side / 2 ** (options.levels - 1 - level))) for level in range(options.levels)]
        self.start = np.empty(4, np.float32)  #: of each node
        self.start[:3] = color
        self.start[3] = -math.log(1.0 - START_OPACITY) / (options.background_layers - 1)
        self.layers = self._untouched(0)
        self.gradients: list[wp.array] = []  # (layers, nodes) vec4 for each shard, as the second moments
        self.moments = wp.zeros(0, dtype=wp.vec4, device=device)
        self._allocate()
        self.behind = None if split else wp.zeros(batch_rays, dtype=wp.vec3, device=device)  # not needed where split
        self._grad_behind = wp.zeros(batch_rays, dtype=wp.vec3, device=device)

    def start_level(self, level: int, picture_rays: PictureRays, field: VoxelField) -> None:
        """Layers of a level, interpolated from the ones before; gradients and moments start anew.
        The rest is not used: layers are not pruned."""
        self._release()
        coarse, self.layers = self.layers, self._untouched(level)
        values = self.layers.values
        launch(refine_layers, values.size, [coarse, self.layers.side], [values], device=self.device)
        del coarse
        self._allocate()

    def _untouched(self, level: int) -> Any:
        """BackgroundLayers of a level as they start."""
        layers: Any = BackgroundLayers()
        layers.half, layers.side = self.half, self.sides[level]
        shape = (self.options.background_layers, surface_node_count(layers.side))
        layers.values = wp.full(shape, wp.vec4(*self.start), dtype=wp.vec4, device=self.device)
        return layers

    def _release(self) -> None:
        """Free the memory of gradients and second moments."""
        self.gradients, self.moments = [], wp.zeros(0, dtype=wp.vec4, device=self.device)

    def _allocate(self) -> None:
        """Fresh gradients and second moments."""
        shape = self.layers.values.shape
        self.moments = wp.zeros(shape, dtype=wp.vec4, device=self.device)
        self.gradients = [wp.zeros(shape, dtype=wp.vec4, device=self.device) for _ in range(self.shards)]

    @property
    def held_bytes(self) -> int:
        """Device memory of the layers of this level, and of the colours behind a batch."""
        colors = self.batch_rays * (1 if self.behind is None else 2)
        return LAYER_NODE_BYTES * self.layers.values.size * (2 + self.shards) + LAYER_COLOR_BYTES * colors

    @property
    def grad_behind(self) -> wp.array | None:
        """(rays,) vec3, where the field's march leaves the loss's gradient by `behind`. None where that is None."""
        return None if self.behind is None else self._grad_behind

    def prepare(self, rays: Any, surroundings: Any) -> None:
        """Fill `behind`, or compare with the surroundings that masks split off, None for whole pictures.
        Before the field's march of a batch; rays: TrainingRays that begin at its first tile."""
        if self.behind is not None:
            self.gather(rays, self.behind)
        else:
            inputs = [self.layers, rays, surroundings, 1.0 / (3.0 * self.batch_rays)]
            outputs = [self._grad_behind]
            launch(background_loss.compare_surroundings, self.batch_rays, inputs, outputs, device=self.device)

    def gather(self, rays: Any, behind: wp.array, front: wp.array | None = None) -> None:
        """Fill `behind`, (rays,) vec3, with what TrainingRays see of the layers; front is not used."""
        launch(background_loss.gather_background, behind.size, [self.layers, rays], [behind], device=self.device)

    def accumulate(self, rays: Any, random: np.random.Generator) -> None:
        """Add the gradients of the batch, after the field's march, and of the total variation.
        random: chooses the first node that gets one of the total variation."""
        options = self.options
        nodes = self.layers.values.size
        varied = max(1, int(options.variation_share * nodes))
        boost = nodes / varied / nodes
        variation = [
            self.layers,
            self.moments,
            int(random.integers(nodes)),
            options.variation_background * boost,
            options.variation_background_depth * boost,
        ]
        outputs = [[gradients] for gradients in self.gradients]
        photometric = [self.layers, rays, self._grad_behind]
        launch_shards(
            [
                ShardedWork(background_loss.accumulate_background_gradient, self.batch_rays, photometric, outputs),
                ShardedWork(background_loss.accumulate_layer_variation, varied, variation, outputs),
            ],
            self.shards,
            self.device,
        )

    def thin_out(self, picture_rays: PictureRays, field: VoxelField) -> None:
        """Nothing: layers are not pruned."""

    def apply(self, rates: Rates) -> None:
        """One step of RMSProp by the gradients, which are cleared."""
        total = sum_shards([_numbers(gradients) for gradients in self.gradients])
        inputs = [rates.background, self.options.beta, EPSILON, total, _numbers(self.moments)]
        outputs = [_numbers(self.layers.values)]
        launch(background_loss.apply_layer_rmsprop, total.size, inputs, outputs, device=self.device)

    def state(self) -> dict[str, np.ndarray]:
        """Values and second moments of the nodes that a ray has met, for a checkpoint."""
        values = self.layers.values.numpy()
        met = (np.abs(values - self.start) > UNMET_DIFFERENCE).any(axis=-1)
        return {
            "layers_met": np.packbits(met.ravel()),
            "layers_values": values[met],
            "layers_moments": self.moments.numpy()[met],
        }

    def restore(self, contents: dict[str, np.ndarray], level: int, path: pathlib.Path) -> None:
        """Take over the state of a level from a checkpoint's arrays; path: for errors."""
        self._release()
        self.layers = self._untouched(level)
        self._allocate()
        shape = self.moments.shape
        size = shape[0] * shape[1]
        packed = require_numbers(contents, "layers_met", (-(-size // 8),), path)
        met = np.unpackbits(packed, count=size).astype(bool).reshape(shape)
        for name, target in (("layers_values", self.layers.values), ("layers_moments", self.moments)):
            rows = require_numbers(contents, name, (int(met.sum()), 4), path)
            if not np.isfinite(rows).all() or (name == "layers_moments" and rows.min(initial=0.0) < 0):
                raise InputError(f"{name} holds values that cannot be")
            values = target.numpy()
            values[met] = rows
            target.assign(values)

    def result(self, picture_rays: PictureRays, field: VoxelField) -> LayeredBackground:
        """The layers so far, colours in [0, 1] and optical depths of at least 0; the arguments are not used."""
        values = self.layers.values.numpy()
        values[..., :3] = np.clip(values[..., :3], 0.0, 1.0)
        values[..., 3] = np.maximum(values[..., 3], 0.0)
        return LayeredBackground(
            self.center, self.half, self.layers.side, values, unseen=self.start, device=self.device
        )


def mean_color(scene: Scene) -> np.ndarray:
    """(3,) mean colour of a scene's pictures, or of what masks split off them, where they count."""
    thinned = slice(None), slice(None, None, COLOR_STRIDE), slice(None, None, COLOR_STRIDE)
    if scene.surroundings is None or scene.alphas is None:
        colors, shares = scene.images[thinned], None
    else:
        colors, shares = scene.surroundings[thinned], 1.0 - scene.alphas[thinned]
    if scene.weights is not None:
        counts = scene.weights[thinned] > 0.0
        colors, shares = colors * counts[..., None], counts if shares is None else counts * shares
    if shares is None:
        return colors.reshape(-1, 3).mean(axis=0)
    return colors.reshape(-1, 3).sum(axis=0) / max(float(shares.sum()), 1.0)


#: Share of the memory of a fit that an outer field may take.
MEMORY_SHARE = 0.4

#: Optical depth of a unit of contracted length at the start.
START_DEPTH = 0.1

#: Nothing stands nearer to a camera than this share of its distance to the middle of the box.
NEAREST_SHARE = 0.2

#: What a camera sees from nearer than this share of its distance to the middle of the box must be seen by this share of
#: all cameras: floaters before cameras are seen by few.
FRONT_DISTANCE, FRONT_SHARE = 0.7, 0.2

#: Cells of the sky along an edge in the first level, and most of them. The learning rate and the weight of the total
#: variation of its colours, relative to those of the voxels' colours.
SKY_SIDE, MAX_SKY, SKY_RATE, SKY_VARIATION = 4, 32, 4.0, 1.0

#: Of the sky in a checkpoint.
SKY_NAMES = ("outer_sky", "outer_sky_moments")

#: Bytes of a value, a gradient or a moment; of a row's place; of a node's skip and share of a block of 31 nodes; of a
#: ray's front; of a colour.
VALUE_BYTES, PLACE_BYTES, NODE_BYTES, FRONT_BYTES, COLOR_BYTES = 16, 4, 1.3, 16, 12


class OuterOptimizer:
    """RMSProp on the outer field of a fit, one step with each of the field's.
    `prepare`, `accumulate` and `apply` make a step, in this order."""

    def __init__(
        self,
        color: np.ndarray,
        bounds: np.ndarray,
        cameras: list[Camera],
        options: FitOptions,
        side: int,  # voxels along a side of contracted space in the last level
        limit: int,  # bytes that the outer field may take
        batch_rays: int,
        shards: int,  # arrays of gradients, one for each CPU thread
        device: wp.Device,
    ):
        self.options, self.shards, self.device, self.limit = options, shards, device, limit
        self.batch_rays = batch_rays
        self.center, self.half = bounds.mean(axis=0), 0.5 * (bounds[1] - bounds[0])
        self.color = np.asarray(color, np.float32)  # of all voxels at the start, and of the sky
        self.cameras = cameras
        self.views = ViewCounts(options.variation_outer_views, device)
        unit = 2 ** (options.levels - 1)
        self.sides = [max(1, side // unit) * 2**level for level in range(options.levels)]  # coarser if memory is short
        self.sides = [max(4, each) for each in self.sides]
        while self.sides[0] > 4 and self._memory().level_bytes(self.sides[0] ** 3, (self.sides[0],) * 3) > limit:
            self.sides = [max(4, each * 7 // 8) for each in self.sides]
        self.gradients: list[wp.array] = []  # (rows,) vec4 for each shard, as the second moments
        self.sky_gradients: list[wp.array] = []
        self.moments = wp.zeros(0, dtype=wp.vec4, device=device)
        self.nodes = wp.zeros(0, dtype=wp.int32, device=device)  # flat index of each row's node
        colors = np.broadcast_to(self.color, (surface_node_count(SKY_SIDE), 3))
        self.outer = self._started(self.possible(self.sides[0]), sky_layers(colors, device).values)
        self._allocate()
        # before and behind the box for each ray (a front has the light that passes too), and the gradients by both
        self.front, self.grad_front = (wp.zeros(batch_rays, dtype=wp.vec4, device=device) for _ in range(2))
        self.behind, self.grad_behind = (wp.zeros(batch_rays, dtype=wp.vec3, device=device) for _ in range(2))

    def possible(self, side: int) -> wp.array:
        """(side, side, side) uint8 mask of voxels that may hold anything, by where cameras stand and look."""
        centers = np.stack([camera.center for camera in self.cameras]) - self.center
        nearest = NEAREST_SHARE * float(np.linalg.norm(centers, axis=1).min())
        least = max(1, math.ceil(FRONT_SHARE * len(self.cameras)))
        mask = empty_array((side, side, side), wp.uint8, self.device)
        cameras = camera_array(self.cameras, self.center, self.device)
        inputs = [wp.vec3(*self.half), cameras, nearest, FRONT_DISTANCE, least]
        launch(mark_outer_nodes, mask.size, inputs, [mask], device=self.device)
        return mask

    def _started(self, mask: wp.array, sky: wp.array) -> OuterField:
        """An outer field as it starts, of a mask's voxels, which become `nodes`, and a sky."""
        columns, self.nodes = mask_columns(mask)
        start = wp.vec4(*map(float, self.color), START_DEPTH)
        values = wp.full(self.nodes.shape[0], start, dtype=wp.vec4, device=self.device)
        return OuterField(self.center, self.half, columns, values, sky=sky, device=self.device)

    def _release(self) -> None:
        """Free the memory of gradients and second moments."""
        self.gradients, self.moments = [], wp.zeros(0, dtype=wp.vec4, device=self.device)
        self.sky_gradients, self.sky_moments = [], wp.zeros((0, 0), dtype=wp.vec4, device=self.device)

    def _allocate(self) -> None:
        """Fresh gradients and second moments."""
        self.moments = wp.zeros(self.nodes.shape[0], dtype=wp.vec4, device=self.device)
        self.sky_moments = wp.zeros_like(self.outer.grid.sky.values)
        self.sky_gradients = [wp.zeros_like(self.sky_moments) for _ in range(self.shards)]
        ones = wp.vec4(1.0, 1.0, 1.0, 1.0)  # the variation goes on where no ray goes, and carries colours there
        self.everywhere = wp.full(self.sky_moments.shape, ones, dtype=wp.vec4, device=self.device)
        self._allocate_gradients()

    def _allocate_gradients(self) -> None:
        rows = self.nodes.shape[0]
        self.gradients = [wp.zeros(rows, dtype=wp.vec4, device=self.device) for _ in range(self.shards)]

    # Memory

    @property
    def held_bytes(self) -> int:
        """Device memory of the grid, its optimiser, and what is before and behind the rays of a batch."""
        rows, side = self.nodes.shape[0], self.outer.side
        grid = row_bytes(self.shards) * rows + self.outer.grid.columns.blocks.capacity + (side - 1) ** 3
        return grid + self._fixed_bytes(self.outer.grid.sky.side) + self.views.held_bytes

    def _fixed_bytes(self, sky_side: int) -> int:
        """Device memory of a sky and its optimiser, and of what is before and behind the rays of a batch."""
        sky = VALUE_BYTES * (3 + self.shards) * surface_node_count(sky_side)
        return sky + 2 * (FRONT_BYTES + COLOR_BYTES) * self.batch_rays

    def _memory(self) -> FitMemory:
        """What other levels take."""
        return FitMemory(
            fixed=self._fixed_bytes(MAX_SKY),
            node=NODE_BYTES,
            row=row_bytes(self.shards) + (1 if self.views.is_used else 0),
            field_row=VALUE_BYTES + PLACE_BYTES,
            moment_row=VALUE_BYTES,
            shards=self.shards,
            tiles=0,
            row_numbers=1,
        )

    # Levels

    def start_level(self, level: int, picture_rays: PictureRays, field: VoxelField) -> None:
        """Prune by what pictures see, and go on to the voxels of a level, interpolated from those before; prune again.
        field: of that level."""
        self._release()
        coarse, side = self.outer, self.outer.side
        kept = self._weighty_mask(picture_rays, field, self.options.prune_weight / side)
        planned = (self.sides[level],) * 3
        shape = self._memory().refinement(self.nodes.shape[0], mask_count(kept), (side,) * 3, planned, self.limit)
        if shape is None:
            self.sides[level] = side
        else:
            self.sides[level] = shape[0]
            finer = empty_array(shape, wp.uint8, self.device)
            ratio = wp.vec3(*(3 * [shape[0] / side]))
            launch(grid_refine.refine_mask, finer.size, [ratio, kept], [finer], device=self.device)
            kept = finer
        self._resample(coarse, kept, min(2 * coarse.grid.sky.side, MAX_SKY))
        del coarse, kept
        # finer voxels separate better what is behind others
        self._keep(self._weighty_mask(picture_rays, field, least_weight(self.options, self.outer.side), counts=True))
        self._allocate()

    def _resample(self, coarse: OuterField, mask: wp.array, sky_side: int) -> None:
        """The field at the voxels of a mask of another side, and its sky, interpolated from what it was."""
        sky = coarse.grid.sky.values
        if sky_side != coarse.grid.sky.side:
            sky = empty_array((1, surface_node_count(sky_side)), wp.vec4, self.device)
            launch(refine_layers, sky.size, [coarse.grid.sky, sky_side], [sky], device=self.device)
        self.outer = self._started(mask, sky)
        inputs = [coarse.grid, self.nodes, self.outer.side]
        launch(resample_outer, self.nodes.shape[0], inputs, [self.outer.grid.values], device=self.device)
        self.views.forget()

    def _keep(self, mask: wp.array) -> None:
        """Only the voxels of a mask over the grid, with their second moments where there are any."""
        before, sky, values = self.outer.grid.columns, self.outer.grid.sky.values, self.outer.grid.values
        del self.outer
        columns, self.nodes = mask_columns(mask)
        rows = column_rows(before, self.nodes)
        values = gathered(values, rows)
        if self.moments.size:
            self.moments = gathered(self.moments, rows)
        self.views.follow(rows)
        self.outer = OuterField(self.center, self.half, columns, values, sky=sky, device=self.device)

    def thin_out(self, picture_rays: PictureRays, field: VoxelField) -> None:
        """Remove what no picture shows, and keep the second moments of the rest."""
        self.gradients = []
        self._keep(self._weighty_mask(picture_rays, field, self.options.keep_weight, counts=True))
        self._allocate_gradients()

    def _weighty_mask(
        self, picture_rays: PictureRays, field: VoxelField, threshold: float, *, counts: bool = False
    ) -> wp.array:
        """The voxels whose rendering weight reaches a threshold in some view, and their neighbours. counts: as of
        Level.weighty_mask."""
        outer, rows = self.outer, self.nodes.shape[0]
        inputs, added = [outer.grid, field.grid, field.step], self.views.begin(rows) if counts else None
        stride = picture_rays.stride(outer.side)
        weights = picture_rays.record(outer_loss.record_outer_weights, inputs, stride, rows, self.shards, added)
        return weighty_mask((outer.side,) * 3, self.nodes, weights, threshold)

    # Steps

    def prepare(self, rays: Any, surroundings: Any) -> None:
        """Fill `front` and `behind` before a batch's march of the field; rays: TrainingRays from its first tile on.
        surroundings are not used: the pictures are whole."""
        self.gather(rays, self.behind, self.front)

    def gather(self, rays: Any, behind: wp.array, front: wp.array | None) -> None:
        """Fill `behind` (rays,) vec3 and `front` (rays,) vec4 with what TrainingRays see around the box."""
        inputs, outputs = [self.outer.grid, rays], [front, behind]
        launch(outer_loss.gather_outer, octet_items(self.device, behind.size), inputs, outputs, device=self.device)

    def accumulate(self, rays: Any, random: np.random.Generator) -> None:
        """Add the gradients of the batch, after the field's march, and of the total variation.
        random: chooses the first row that gets one of the total variation."""
        options, rows, side = self.options, self.nodes.shape[0], self.outer.side
        sky = self.outer.grid.sky
        by_front = options.front_opacity / self.batch_rays
        by_sky = options.sky_follows * 2.0 / (3.0 * self.batch_rays)  # the photometric loss is a mean over channels
        around = [self.front, self.behind, self.grad_front, self.grad_behind]
        photometric = [self.outer.grid, rays, *around, by_front, by_sky]
        varied = max(1, int(options.variation_share * rows))
        boost = max(1, rows) / varied / side**3 * (side / VARIATION_SIDE)
        variation = [
            self.outer.grid,
            self.nodes,
            int(random.integers(max(1, rows))),
            options.variation_outer * boost,
            options.variation_outer_density * boost,
            self.views.counts,
            self.views.factors,
        ]
        nodes = sky.values.size
        weight = SKY_VARIATION * options.variation_outer / nodes
        sky_variation = [sky, self.everywhere, 0, weight, 0.0]
        grids, skies = ([[each] for each in kind] for kind in (self.gradients, self.sky_gradients))
        both = [[*grid, *each] for grid, each in zip(grids, skies, strict=True)]
        works = [
            ShardedWork(
                outer_loss.accumulate_outer_gradient, octet_items(self.device, self.batch_rays), photometric, both
            ),
            ShardedWork(accumulate_layer_variation, nodes, sky_variation, skies),
        ]
        if rows:
            works.append(ShardedWork(outer_loss.accumulate_outer_variation, varied, variation, grids))
        launch_shards(works, self.shards, self.device)

    def apply(self, rates: Rates) -> None:
        """One step of RMSProp by the gradients, which are cleared."""
        rows = self.nodes.shape[0]
        total = sum_shards([_numbers(gradients) for gradients in self.sky_gradients])
        inputs = [SKY_RATE * rates.outer, self.options.beta, EPSILON, total, _numbers(self.sky_moments)]
        outputs = [_numbers(self.outer.grid.sky.values)]
        launch(apply_layer_rmsprop, total.size, inputs, outputs, device=self.device)
        if not rows:  # the sky alone is left
            return
        total = self.gradients[0]
        sum_shards([_numbers(gradients) for gradients in self.gradients])
        inputs = [rates.outer, rates.outer_density * 0.25 * self.outer.side, self.options.beta, EPSILON]
        outputs = [total, self.moments, self.outer.grid.values]
        launch(outer_loss.apply_outer_rmsprop, rows, inputs, outputs, device=self.device)
        self.outer.forget_bricks()

    # State

    def state(self) -> dict[str, np.ndarray]:
        """Values and second moments, for a checkpoint."""
        return self.views.state("outer_views") | {
            "outer_sides": np.array(self.sides, np.int32),
            "outer_occupancy": np.packbits(held_nodes(self.outer.grid.columns).ravel()),
            "outer_values": self.outer.values,
            "outer_moments": self.moments.numpy(),
            "outer_sky": self.outer.grid.sky.values.numpy()[0],
            "outer_sky_moments": self.sky_moments.numpy()[0],
        }

    def restore(self, contents: dict[str, np.ndarray], level: int, path: pathlib.Path) -> None:
        """Take over the state of a level from a checkpoint's arrays; path: for errors."""
        sides = [int(side) for side in require_numbers(contents, "outer_sides", (len(self.sides),), path)]
        if any(not 4 <= side <= planned for side, planned in zip(sides, self.sides, strict=True)):
            raise InputError(f"outer fields of {sides} voxels along a side, {self.sides} planned")
        side = sides[level]
        packed = require_numbers(contents, "outer_occupancy", (-(-(side**3) // 8),), path)
        occupied = np.unpackbits(packed, count=side**3).reshape(side, side, side)
        rows = int(occupied.sum())
        values, moments = (
            require_numbers(contents, name, (rows, 4), path) for name in ("outer_values", "outer_moments")
        )
        if not (np.isfinite(values).all() and np.isfinite(moments).all()) or moments.min(initial=0.0) < 0:
            raise InputError("the outer field holds values that cannot be")
        nodes = surface_node_count(min(SKY_SIDE * 2**level, MAX_SKY))
        sky, sky_moments = (require_numbers(contents, name, (nodes, 4), path) for name in SKY_NAMES)
        if not (np.isfinite(sky).all() and np.isfinite(sky_moments).all()) or sky_moments.min() < 0:
            raise InputError("the sky holds values that cannot be")
        self.sides = sides
        self._release()
        colors = wp.array(np.ascontiguousarray(sky[None], np.float32), dtype=wp.vec4, device=self.device)
        self.outer = self._started(wp.array(occupied, dtype=wp.uint8, device=self.device), colors)
        self.views.restore(contents, "outer_views", rows, path)
        self._allocate()
        self.sky_moments.assign(np.ascontiguousarray(sky_moments[None], np.float32))
        self.outer.grid.values.assign(values.astype(np.float32))
        self.moments.assign(moments.astype(np.float32))

    def result(self, picture_rays: PictureRays, field: VoxelField) -> OuterField:
        """The outer field so far, pruned, colours in [0, 1] and densities of at least 0."""
        self._release()
        self._keep(self._weighty_mask(picture_rays, field, self.options.keep_weight))
        values, sky = self.outer.values, self.outer.grid.sky.values
        values[:, :3] = np.clip(values[:, :3], 0.0, 1.0)
        values[:, 3] = np.maximum(values[:, 3], 0.0)
        self.outer.grid.values.assign(values)
        sky.assign(np.clip(sky.numpy(), 0.0, 1.0))
        return self.outer


def row_bytes(shards: int) -> int:
    """Device memory of a voxel while it is optimised: value, moment, gradients and its place."""
    return VALUE_BYTES * (2 + shards) + PLACE_BYTES


def _numbers(array: wp.array) -> wp.array:
    """The numbers of an array of vec4, one after another, without a copy."""
    return array_view(array, wp.float32, (4 * array.size,))
