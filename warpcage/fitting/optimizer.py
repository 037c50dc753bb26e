"""Optimise a voxel field from posed images."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.checks import checked_bounds, checked_whole, require_type
from ..core.devices import HeldOnDevice, resolve_device
from ..core.modules import load_modules
from ..core.reports import Progress, reports_progress
from ..core.threads import in_turn
from ..errors import InputError
from ..field.sparse import mask_count
from ..field.voxel_field import VoxelField
from ..kernels.field import occupancy, refine
from ..kernels.fitting import batches, loss, loss_warps, rmsprop, visual_hull
from ..scene.box import FoundBox, find_looks, scene_box
from ..scene.scene import Scene
from ..view.camera import Camera
from ..view.camera_path import RefinedCameras
from .batches import PRECISIONS, Batch, Batches, TrainingPictures, counted_pixels, counted_tile_size, shard_count
from .cameras import CAMERA_RAYS, HALF_LOOKS, CameraErrors, CameraRefinement, CameraSums, ray_bytes
from .level import Level, Look, level_memory
from .memory import FitMemory, children_count, finer_shapes, finest, memory_limit, memory_text
from .options import VIEW_OPTIONS, checked_options
from .schedule import LEVEL_GROWTH, Pace, Schedule, least_weight, outer_side, plan_batches, plan_grid
from .silhouettes import Silhouettes, possible_voxels
from .surroundings import (
    MEMORY_SHARE,
    BackgroundOptimizer,
    OuterOptimizer,
    chosen_background,
    layers_that_fit,
    mean_color,
)

#: The cells per node of the first level are those of this grid: its own resolution follows from the memory.
SMALLEST_GRID = (2, 2, 2)


class FieldOptimizer(HeldOnDevice):
    """Plenoxels' optimisation of a VoxelField, step by step.

    It goes from coarse to fine by RMSProp with total variation, and prunes voxels by their rendering weight
    (Fridovich-Keil and Yu et al. 2022, section 3). Use `fit` unless you need the steps.

    Args:
        scene: The images with their cameras.
        device: Warp device. None is CUDA where there is one.
        seed: Seed of the pixel order and the backgrounds. On the CPU the same seed, scene and number of cores give the
            same field to the bit.
        bounds: (2, 3) box of the object, world units. None finds it.
        progress: A function is called with (done, total, message) before kernels are compiled; see `fit`.
        options: `quality`, and fields of FitOptions by name, which have priority over it.

    Raises:
        ValueError: For options out of range, a scene with nothing in it, or too little memory.

    Attributes:
        scene: The scene.
        options: All options, with the number of levels that the fit has, and its tiles' size.
        device: The Warp device.
        bounds: (2, 3) box of the field, world units.
        found: Where the object is, and why.
        shapes: (nx, ny, nz) voxels of each level; made coarser during the fit where memory is short.
        planned: (nx, ny, nz) voxels of each level if memory were not short.
        memory_limit: Bytes that the fit may take, beside the layers or the outer field.
        psnr: Of the last measured batch, in dB.
        camera_errors: Camera errors that a fit with `refine_cameras="auto"` has measured; None before and otherwise.
    """

    @reports_progress
    def __init__(
        self,
        scene: Scene,
        *,
        device: wp.DeviceLike = None,
        seed: int = 0,
        bounds: ArrayLike | None = None,
        progress: bool | Progress = False,
        **options: Any,
    ):
        require_type(scene, Scene, "a fit needs")
        self.scene = scene
        self.options = checked_options(options)
        pixels = counted_pixels(scene)
        self.device = resolve_device(device)
        self.seed = checked_whole(seed, "the seed", 0)
        self.given = {
            "seed": self.seed,
            "bounds": None if bounds is None else np.asarray(bounds, np.float64).tolist(),
            **dataclasses.asdict(self.options),
        }
        self.random = np.random.default_rng(self.seed)
        self.psnr = float("nan")
        self.shards = shard_count(self.device)
        self.random_background, around = chosen_background(scene, self.options.background)
        self.memory_limit = memory_limit(self.options.max_memory, self.device)
        gradients = loss if self.device.is_cpu else loss_warps
        load_modules([visual_hull, refine, occupancy, batches, gradients, rmsprop], self.device, progress)

        silhouettes = None if scene.alphas is None else Silhouettes(scene, self.device)
        if bounds is None:
            self.found = scene_box(scene, silhouettes)
        else:
            self.found = FoundBox(checked_bounds(bounds), find_looks(scene.cameras), "as given")
        box = self.found.bounds
        layer_side, around_bytes = 0, 0
        if around == "layers":
            layer_side, around_bytes = layers_that_fit(scene, self.options, self.shards, self.memory_limit)
        elif around == "outer":
            around_bytes = int(MEMORY_SHARE * self.memory_limit)
        self.memory_limit -= around_bytes
        grid = plan_grid(scene, self.options, box, around is not None)
        tile_size = counted_tile_size(scene.weights, self.options.tile_size)
        self.options = dataclasses.replace(self.options, levels=grid.levels, tile_size=tile_size)
        if around != "outer":
            self.options = dataclasses.replace(self.options, **dict.fromkeys(VIEW_OPTIONS, 0.0))
        # what changes nothing is no part of a checkpoint's fingerprint: those of before these options stay readable
        limited = self.options.epochs * pixels > self.options.most_rays
        has_outer = scene.alphas is None and self.options.background in ("auto", "outer")
        idle = () if has_outer else VIEW_OPTIONS
        for name in idle if limited else (*idle, "most_rays"):
            del self.given[name]
        if self.options.level_growth is None:  # as it always was; checkpoints hold the steps of their levels
            self.given["level_growth"] = LEVEL_GROWTH
        self.bounds, self.shapes, self.variation = grid.bounds, grid.shapes, grid.variation
        self.counted_variation = grid.counted_variation
        self.planned = list(grid.shapes)

        self.batches = Batches(
            scene,
            self.bounds.mean(axis=0),
            self.options.tile_size,
            self.random,
            self.device,
            held=0 if silhouettes is None else silhouettes.held_bytes,
            limit=self.memory_limit,
        )
        mask = self._first_mask(silhouettes)
        del silhouettes  # its tables are as large as the images
        self.current = Level(mask, self.bounds, scene.background, self.shards, self.options.variation_views)
        del mask
        self.has_around = around is not None
        if around == "outer":  # which begins with this colour too, and would explain all if the field did not
            self.current.paint(mean_color(scene))
        self._activate_tiles()
        batch_tiles, level_steps = plan_batches(self.options, pixels, self.batches.active_tiles, around == "outer")
        self.batches.size(batch_tiles)
        side = outer_side(scene, self.options, grid)  # of an outer field
        self.schedule = Schedule(self.options, level_steps, grid.scarcity, side / max(grid.shapes[-1]))
        self.background: BackgroundOptimizer | OuterOptimizer | None = None
        if around == "outer":
            self.background = OuterOptimizer(
                mean_color(scene),
                self.bounds,
                scene.cameras,
                self.options,
                side,
                around_bytes,
                self.batches.batch_rays,
                self.shards,
                self.device,
            )
        if around == "layers":
            self.background = BackgroundOptimizer(
                mean_color(scene),
                scene.surroundings is not None,
                self.bounds,
                self.options,
                layer_side,
                self.batches.batch_rays,
                self.shards,
                self.device,
            )

        self.refinement: CameraRefinement | None = None
        self.camera_errors: CameraErrors | None = None
        if self.options.refine_cameras is True:
            self.start_refinement()

    def start_refinement(self) -> None:
        """Refine cameras from now on, in memory that levels to come leave."""
        self.refinement = CameraRefinement(self.scene.cameras, self.bounds, self.device)
        self.refinement.attach(self.rays)
        self.memory_limit -= ray_bytes(self.camera_tiles * len(self.scene) * self.options.tile_size**2)

    def _first_mask(self, silhouettes: Silhouettes | None) -> wp.array:
        """Voxels of the first level; pictures at 8 bits per channel, then coarser voxels, where memory is short."""
        while True:
            shape = self.shapes[0]
            mask = possible_voxels(
                silhouettes, self.scene.cameras, self.bounds, shape, self.options.view_share, self.device
            )
            rows = mask_count(mask)
            fixed, counted = self.batches.held_bytes, self.options.variation_views > 0
            memory = level_memory(SMALLEST_GRID, self.shards, fixed, self.batches.mark_bytes, counted=counted)
            shapes, coarse_pictures = finest(
                memory,
                self.pictures.spare_bytes,
                lambda held, rows=rows: held.first_shapes(self.shapes, rows, self.memory_limit),
            )
            if coarse_pictures:
                self.batches.keep_pictures(PRECISIONS[-1])
            if shapes is None:
                raise memory.without(self.pictures.spare_bytes).refusal(rows, shape, self.memory_limit)
            if shapes == self.shapes:
                return mask
            self.shapes = shapes

    # State

    @property
    def field(self) -> VoxelField:
        """The field so far."""
        return self.current.field

    @property
    def size_text(self) -> str:
        """How fine the field is so far, for people."""
        return "x".join(str(n) for n in self.field.resolution)

    @property
    def pictures(self) -> TrainingPictures:
        """The scene's pictures on the device, at the precision that memory allows."""
        return self.batches.pictures

    @property
    def rays(self) -> Any:
        """TrainingRays, what the losses take of the batches."""
        return self.batches.rays

    @property
    def tile_total(self) -> int:
        """Tiles of all pictures."""
        return self.batches.tile_total

    @property
    def active_tiles(self) -> int:
        """Tiles that see anything of the field."""
        return self.batches.active_tiles

    @property
    def batch_rays(self) -> int:
        """Rays per batch."""
        return self.batches.batch_rays

    @property
    def cameras(self) -> list[Camera]:
        """The scene's cameras, refined so far where `refine_cameras` is chosen."""
        return self.scene.cameras if self.refinement is None else self.refinement.cameras

    @property
    def refined_cameras(self) -> RefinedCameras | None:
        """Those cameras with the names of their pictures and their exposures. None where none are refined."""
        held = self.refinement
        if held is None:
            return None
        exposures = held.gains.copy(), held.offsets.copy()
        return RefinedCameras(list(self.scene.names), held.cameras, *exposures, list(held.given))

    @property
    def level(self) -> int:
        """Index of the level that the fit has reached."""
        return self.schedule.level

    @property
    def level_steps(self) -> list[int]:
        """Steps of each level."""
        return self.schedule.level_steps

    @property
    def level_done(self) -> bool:
        """Whether the steps of the level are done."""
        return self.schedule.level_done

    @property
    def step_count(self) -> int:
        """Steps done."""
        return self.schedule.step_count

    @property
    def total_steps(self) -> int:
        """Steps of all levels."""
        return self.schedule.total_steps

    @property
    def held_bytes(self) -> int:
        """Device memory of the fit between two steps."""
        return self._fixed_bytes() + self.current.held_bytes

    def _fixed_bytes(self) -> int:
        """Device memory that does not depend on the grid."""
        return self.batches.held_bytes + (0 if self.background is None else self.background.held_bytes)

    def memory(self) -> FitMemory:
        """What levels of the fit take, as their owners state it."""
        fixed = self.batches.held_bytes if isinstance(self.background, OuterOptimizer) else self._fixed_bytes()
        return self.current.memory(fixed, self.batches.mark_bytes)  # outer fields have a limit of their own

    def peak_bytes(self, rows: int) -> int:
        """The most device memory that the fit takes: that of its last level.

        Args:
            rows: Voxels of that level which hold values.

        Returns:
            Bytes.
        """
        around = self.background.held_bytes if isinstance(self.background, OuterOptimizer) else 0
        return around + min(self.memory().level_bytes(rows, self.shapes[-1]), self.memory_limit)

    def pace(self) -> Pace:
        """A measure of how long the fit takes, which counts no step yet."""
        return Pace(self.schedule, [max(shape) for shape in self.shapes], self.has_around, self.device)

    @property
    def coarser(self) -> str | None:
        """One line that says how much coarser than planned the levels so far are, and why. None where none is."""
        reached, planned = self.shapes[self.level], self.planned[self.level]
        if math.prod(reached) >= math.prod(planned):
            return None
        sizes = " instead of ".join("x".join(str(n) for n in shape) for shape in (reached, planned))
        return f"the field has {sizes} voxels: more do not fit into {memory_text(self.memory_limit)} or one launch"

    # Levels

    def _activate_tiles(self) -> None:
        """Batches of the tiles that see the field; of all of them where what is around it is fitted too: every
        pixel shows something."""
        self.batches.activate(None if self.has_around else self.field)

    def _refine(self) -> None:
        """On to the next level: prune, halve the voxels, interpolate; pictures at 8 bits per channel, then larger
        voxels, where memory is short."""
        level, coarse = self.current, self.field.resolution
        level.release()  # one level's state at a time
        kept = level.weighty_mask(self.batches.picture_rays, self.options.prune_weight / max(coarse))
        self.schedule.level += 1
        look = self._finest_look(kept)
        self.shapes[self.level] = look.shape
        level.refine(look)
        del look
        if self.background is not None:
            self.background.start_level(self.level, self.batches.picture_rays, self.field)
        level.allocate()
        self._activate_tiles()

    def _finest_look(self, kept: wp.array) -> Look:
        """A look at the next level at the finest resolution whose voxels fit into memory, if need be with pictures of
        the lowest precision; at this level's where none is worth its time. kept: voxels with children."""
        level, coarse, rays = self.current, self.field.resolution, self.batches.picture_rays
        rows, kept_rows, share = self.field.voxel_count, mask_count(kept), 0.0  # of children that the last look left

        def fits(memory: FitMemory, shape: tuple[int, ...], count: int | None = None) -> bool:
            """Whether a look does, and a level of so many voxels after it; None is as many as the last look found."""
            children = children_count(kept_rows, coarse, shape)
            left = math.ceil(share * children) if count is None else count
            needed = max(
                memory.look_bytes(rows, coarse, children, shape),
                memory.level_bytes(left, shape),
                memory.change_bytes(rows, coarse, left, shape),
            )
            return needed <= self.memory_limit and memory.countable(left, shape)

        def finest_within(memory: FitMemory, shapes: list[tuple[int, ...]]) -> Look | None:
            nonlocal share
            for shape in shapes:
                if fits(memory, shape):
                    look = level.look(shape, kept, rays, least_weight(self.options, max(shape)))
                    count = mask_count(look.mask)
                    if fits(memory, shape, count):
                        return look
                    share = count / max(1, children_count(kept_rows, coarse, shape))
            return None

        memory, shapes = self.memory(), list(finer_shapes(coarse, self.shapes[self.level]))
        look = finest_within(memory, shapes)
        sparing = memory.without(self.pictures.spare_bytes)
        finer = shapes if look is None else shapes[: shapes.index(look.shape)]
        if self.pictures.spare_bytes and any(fits(sparing, shape) for shape in finer):
            del look
            bits = self.pictures.bits
            self.batches.keep_pictures(PRECISIONS[-1])
            look = finest_within(sparing, finer)
            if look is None:  # they buy nothing
                self.batches.keep_pictures(bits)
                look = finest_within(memory, shapes[len(finer) :])
        if look is None:
            look = level.look(coarse, kept, rays, least_weight(self.options, max(coarse)))
        return look

    def _thin_out(self) -> None:
        """Remove what no view shows, and keep the optimiser's state of the rest."""
        level, rows, memory = self.current, self.field.voxel_count, self.memory()
        level.release_gradients()
        if self.background is not None:
            self.background.thin_out(self.batches.picture_rays, self.field)
        mask = level.weighty_mask(self.batches.picture_rays, self.options.keep_weight, counts=True)
        fits = memory.thinning_bytes(rows, mask_count(mask), self.field.resolution) <= self.memory_limit
        if fits:
            level.keep(mask)
        level.allocate_gradients()
        if fits:
            self._activate_tiles()

    @in_turn
    def restore(self, mask: wp.array[Any, Any], bits: int) -> None:
        """Rows for a mask and fresh state: what a checkpoint fills.

        Args:
            mask: (nx, ny, nz) uint8, voxels that hold values.
            bits: Of the pictures per channel.
        """
        self.batches.keep_pictures(bits)
        self.current.restart(mask)
        self._activate_tiles()

    # Steps

    @in_turn
    def step(self) -> None:
        """One batch: gradients and a step of RMSProp. Refines first when a level is done.

        Raises:
            ValueError: When all steps are done.
        """
        if self.schedule.is_done:
            raise InputError(f"all {self.total_steps} steps are done")
        if self.schedule.refines:
            self._refine()
        if self.schedule.thins_out:
            self._thin_out()
        self.batches.advance(self.schedule.rays_per_side)
        self.accumulate_gradients()
        self._apply_gradients()
        self._refine_cameras()
        self.schedule.step_count += 1

    def accumulate_gradients(self) -> None:
        """Add the gradients of the current batch to those of the field and its surroundings, and note its errors."""
        behind = grad_behind = front = grad_front = None
        if self.background is not None:
            self.background.prepare(self.rays, self.pictures.surroundings)
            behind, grad_behind = self.background.behind, self.background.grad_behind
            front, grad_front = self.background.front, self.background.grad_front
        batch = Batch(
            rays=self.rays,
            squared_error=self.batches.squared_error,
            seed=self._step_seed(),
            random_background=self.random_background and self.schedule.supervises_opacity,
            behind=behind,
            grad_behind=grad_behind,
            front=front,
            grad_front=grad_front,
        )
        variation = self.counted_variation if self.current.views.counts.size else self.variation
        self.current.accumulate(batch, variation, self.options.variation_share, self.random)
        if self.background is not None:
            self.background.accumulate(self.rays, self.random)

    def _apply_gradients(self) -> None:
        rates = self.schedule.rates()
        if self.background is not None:
            self.background.apply(rates)
        self.current.apply(rates, self.options.beta)

    def _refine_cameras(self) -> None:
        """Move the cameras, where a step of theirs is due."""
        if self.schedule.checks_cameras:
            self._check_cameras()
        if self.refinement is None or not (rates := self.schedule.camera_rates()):
            return
        sums = self._look(self.refinement, self.rays, self.batches.view_tiles, self.camera_tiles)
        self.refinement.step(sums, rates, float(self.field.voxel_size.max()))
        self.refinement.attach(self.rays)

    def _check_cameras(self) -> None:
        """Find out if cameras are off, and refine them from now on if so."""
        # the last level is to come, so that there is memory for this
        held = CameraRefinement(self.scene.cameras, self.bounds, self.device)
        tiles = HALF_LOOKS * self.camera_tiles
        self.camera_errors = held.errors(
            self.rays, self.batches.view_tiles, lambda rays, starts: self._look(held, rays, starts, tiles)
        )
        if self.camera_errors:
            self.start_refinement()

    def _look(self, refinement: CameraRefinement, rays: Any, view_tiles: np.ndarray, tiles: int) -> CameraSums:
        """What a sample of so many tiles says of every camera."""
        around = self.background
        return refinement.measure(
            self.field,
            rays,
            view_tiles,
            tiles,
            seed=self._step_seed(),
            random_background=self.random_background,
            gather=None if around is None or around.behind is None else around.gather,
            has_front=around is not None and around.front is not None,
            ignored=self.batches.ignored_views,
        )

    @property
    def camera_tiles(self) -> int:
        """Tiles by which each camera is looked at before one of its steps."""
        return max(1, round(CAMERA_RAYS * self.schedule.camera_every * self.batches.batch_tiles / len(self.scene)))

    def _step_seed(self) -> int:
        """Of what is drawn in this step."""
        return (self.seed * 1_000_003 + self.step_count) % (2**31 - 1)

    @in_turn
    def measure_psnr(self) -> float:
        """PSNR in dB of the last batch over all pixels of the images. Pixels that see no voxel count as right."""
        self.psnr = self.batches.psnr()
        return self.psnr

    @in_turn
    def finish(self) -> VoxelField:
        """Prune what no view shows, record rendering weights, and return the field.

        What is left is what a cage has to enclose: faint floaters would stay behind when the object moves.
        """
        field = self.current.finish(self.batches.picture_rays, self.options.keep_weight)
        field.up, field.straightening = self.scene.up, self.scene.straightening
        field.supersampling = self.options.supersampling
        if self.background is not None:
            field.background_model = self.background.result(self.batches.picture_rays, field)
        field.refined_cameras = self.refined_cameras
        return field
