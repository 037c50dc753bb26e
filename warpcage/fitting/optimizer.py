"""Optimise a voxel field from posed images."""

from __future__ import annotations

import dataclasses
import math
import time

import numpy as np
import warp as wp

from ..core.checks import checked_bounds, require_type
from ..core.devices import lane_count, launch, load_modules, module_block_dim, resolve_device
from ..core.threads import CPU_THREADS, run_parallel
from ..field.sparse import mask_count
from ..field.voxel_field import VoxelField, field_from_mask
from ..kernels.field import refine as grid_refine
from ..kernels.field import skip as grid_skip
from ..kernels.field.render import record_weights
from ..kernels.fitting import active_tiles, visual_hull
from ..kernels.fitting import loss as field_loss
from ..kernels.fitting import loss_warps as field_loss_warps
from ..kernels.fitting import rmsprop as field_step
from ..kernels.fitting import variation as field_variation
from ..kernels.fitting.pictures import Pictures
from ..kernels.fitting.rmsprop import shrink_view_dependence
from ..scene.box import scene_box
from ..scene.scene import Scene
from ..view.frame import camera_array
from .background import BackgroundOptimizer, chosen_background, layers_that_fit
from .checkpoint import load_progress, require_writable, save_progress
from .level import ROW_NUMBERS, coefficient_rows, gradient_parts
from .memory import FitMemory, array_bytes, device_arrays, memory_limit, require_image_memory
from .options import checked_options, checked_seed
from .pictures import PRECISIONS, TrainingPictures, picture_bytes
from .plan import directional_rate, plan_batches, plan_grid
from .silhouettes import Silhouettes, keep_seen

#: A training march ends where less than this share of the light is left, as a render does.
STOP_TRANSMITTANCE = 1e-3

#: Steps from one pass over the SH coefficients that shrinks them to the next.
SHRINK_EVERY = 4

#: A CPU thread's own gradients are worth their memory up to this many.
MAX_SHARDS = 8


class FieldOptimizer:
    """Plenoxels' optimisation of a VoxelField, step by step: coarse to fine, RMSProp, total variation, pruning by
    rendering weight (Fridovich-Keil and Yu et al. 2022, section 3).

    scene: Scene. device: Warp device, None is CUDA where there is one. seed: of the pixel order and the backgrounds;
    on the CPU the same seed, scene and number of cores give the same field to the bit. bounds: (2, 3) world units, None
    finds the object. options: quality, and FitOptions fields by name, which come before it.

    Use `fit` unless you need the steps. `.field` is the field so far, `.psnr` of the last measured batch,
    `.step_count` of `.total_steps`, `.shapes` the levels' resolutions and `.pictures.bits` a channel of the pictures
    what memory allows so far. Raises ValueError for options out of range or a scene with nothing in it.
    """

    def __init__(self, scene: Scene, *, device=None, seed: int = 0, bounds=None, **options):
        require_type(scene, Scene, "a fit needs")
        self.scene = scene
        self.options = checked_options(options)
        self.device = resolve_device(device)
        self.seed = checked_seed(seed)
        self.given = {
            "seed": self.seed,
            "bounds": None if bounds is None else np.asarray(bounds, np.float64).tolist(),
            **dataclasses.asdict(self.options),
        }
        self.random = np.random.default_rng(self.seed)
        self.psnr = float("nan")
        self.step_count = 0
        self.level = 0
        self.shards = min(CPU_THREADS, MAX_SHARDS) if self.device.is_cpu else 1
        self.random_background, self.layered = chosen_background(scene, self.options.background)
        self.memory_limit = memory_limit(self.options.max_memory, self.device)

        gradients = field_loss if self.device.is_cpu else field_loss_warps
        load_modules(
            [visual_hull, grid_refine, grid_skip, active_tiles, gradients, field_variation, field_step], self.device
        )
        self._silhouettes = None if scene.alphas is None else Silhouettes(scene, self.device)
        if bounds is None:
            bounds = scene_box(scene)
            if self._silhouettes is not None:
                bounds = self._silhouettes.bound(bounds)
        if self.layered:
            self.background_side, layer_bytes = layers_that_fit(scene, self.options, self.shards, self.memory_limit)
            self.memory_limit -= layer_bytes
        grid = plan_grid(scene, self.options, checked_bounds(bounds), self.layered)
        self.options = dataclasses.replace(self.options, levels=grid.levels)
        self.bounds, self.shapes, self.scarcity = grid.bounds, grid.shapes, grid.scarcity
        self.variation_density, self.variation_sh = grid.variation
        self._upload_images()
        self._start_level(self._first_mask(), None)
        self._allocate_state()
        self._activate_tiles()
        self._plan()
        self.background = (
            None
            if not self.layered
            else BackgroundOptimizer(
                scene,
                self.pictures,
                self.bounds,
                self.options,
                self.background_side,
                self.batch_rays,
                self.shards,
                self.device,
            )
        )

    # Set-up

    def _upload_images(self) -> None:
        scene, size = self.scene, self.options.tile_size
        count, height, width = scene.images.shape[:3]
        self.rays = rays = field_loss.TrainingRays()
        rays.cameras = camera_array(scene.cameras, self.bounds.mean(axis=0), self.device)
        rays.height, rays.width = height, width
        rays.tile_size = size
        rays.rays_per_side = 1
        self.tile_total = count * -(-height // size) * -(-width // size)
        held = array_bytes(device_arrays(self))
        needed = {bits: held + picture_bytes(scene, bits) for bits in PRECISIONS}
        require_image_memory(needed[PRECISIONS[-1]], self.memory_limit)
        self.pictures = TrainingPictures(
            scene, next(bits for bits in PRECISIONS if needed[bits] <= self.memory_limit), self.device
        )
        rays.pictures = self.pictures.seen

    def keep_pictures(self, bits: int) -> None:
        """Go on with the pictures at another precision, one of PRECISIONS."""
        if bits != self.pictures.bits:
            self.rays.pictures = Pictures()  # lets go of those before
            self.pictures.keep(bits)
            self.rays.pictures = self.pictures.seen

    def _finest(self, memory: FitMemory, choice):
        """The shape, or shapes, that `choice` makes of what memory there is; None where it makes none.

        Where pictures of the lowest precision leave room for more voxels they are kept so from then on.
        """
        shape, finer = (choice(memory.without(spare)) for spare in (0, self.pictures.spare_bytes))
        if finer is None or (shape is not None and np.prod(finer, dtype=float) <= np.prod(shape, dtype=float)):
            return shape
        self.keep_pictures(PRECISIONS[-1])
        return finer

    def _first_mask(self) -> wp.array:
        """Voxels of the first level; pictures at 8 bits a channel, then coarser voxels, where memory would not do."""
        silhouettes, self._silhouettes = self._silhouettes, None  # its tables are as large as the images
        self._start_level(wp.ones((2, 2, 2), dtype=wp.uint8, device=self.device), None)
        self._allocate_state()
        while True:
            memory = FitMemory.of(self)  # what a node and a row take
            mask = self._possible_voxels(silhouettes)
            rows = mask_count(mask)
            shapes = self._finest(
                memory, lambda held, rows=rows: held.first_shapes(self.shapes, rows, self.memory_limit)
            )
            if shapes is None:
                memory.without(self.pictures.spare_bytes).refuse(rows, self.shapes[0], self.memory_limit)
            if shapes == self.shapes:
                return mask
            self.shapes = shapes

    def _possible_voxels(self, silhouettes) -> wp.array:
        """Voxels of the first level that enough cameras see, inside all silhouettes where there are any."""
        if silhouettes is None:
            mask = wp.ones(self.shapes[0], dtype=wp.uint8, device=self.device)
        else:
            mask = silhouettes.carve(self.bounds, self.shapes[0])
        least = max(1, math.ceil(self.options.view_share * len(self.scene)))
        keep_seen(self.bounds, self.scene.cameras, least, mask)
        if not mask_count(mask):
            raise ValueError(
                "no camera sees the bounds of the field: check the bounds and the cameras' axes"
                if silhouettes is None
                else "no voxel of the bounds lies inside all silhouettes: check bounds, cameras and alphas"
            )
        return mask if silhouettes is None else self._dilated(mask)

    def _plan(self) -> None:
        options = self.options
        self.batch_tiles, self.level_steps = plan_batches(
            options, math.prod(self.scene.images.shape[:3]), self.active_tiles
        )
        self.batch_rays = self.batch_tiles * options.tile_size**2
        self.squared_error = wp.zeros(self.batch_rays, dtype=wp.float32, device=self.device)
        self.total_steps = sum(self.level_steps)
        self.directional = directional_rate(self.total_steps) if options.directional is None else options.directional

    # Levels

    def _start_level(self, mask: wp.array, coarse: VoxelField | None) -> None:
        """A field of the rows of a mask, filled from a coarser one where there is one."""
        start_density = 0.1 / (0.5 * float((self.bounds[1] - self.bounds[0]).max()))
        field, self.nodes = field_from_mask(
            self.bounds, mask, start_density, background=self.scene.background, device=self.device
        )
        if not field.voxel_count:
            raise ValueError(
                "nothing is left to render after pruning: all images may show the background alone, or "
                "not fit their cameras"
            )
        if coarse is not None:
            launch(
                grid_refine.resample_rows,
                field.voxel_count,
                [coarse.grid, _ratio(field, coarse), self.nodes],
                [field.grid.density, field.grid.sh],
                device=self.device,
            )
        self.field = field

    def _allocate_state(self) -> None:
        self._allocate_gradients()
        self.moments = wp.zeros((self.field.voxel_count, ROW_NUMBERS), dtype=wp.bfloat16, device=self.device)

    def _allocate_gradients(self) -> None:
        rows = self.field.voxel_count
        self.gradients = [
            wp.zeros((rows, ROW_NUMBERS), dtype=wp.float32, device=self.device) for _ in range(self.shards)
        ]
        self.touched = wp.zeros(rows, dtype=wp.uint8, device=self.device)

    def _activate_tiles(self) -> None:
        if self.layered:  # every pixel shows something
            self.tile_ids, self.active_tiles = np.arange(self.tile_total, dtype=np.int32), self.tile_total
            self._shuffle_tiles()
            return
        active = wp.zeros(self.tile_total, dtype=wp.int32, device=self.device)
        inputs = [self.field.grid, self.rays.cameras, self.rays.tile_size, 2.0 * self.field.step]
        launch(active_tiles.mark_active_tiles, self.tile_total, inputs, [active], device=self.device)
        self.tile_ids = np.flatnonzero(active.numpy()).astype(np.int32)
        if len(self.tile_ids) == 0:
            raise ValueError("no camera sees the bounds of the field: check the bounds and the cameras' axes")
        self.active_tiles = len(self.tile_ids)
        self._shuffle_tiles()

    def _shuffle_tiles(self) -> None:
        self.rays.tiles = wp.array(self.random.permutation(self.tile_ids), dtype=wp.int32, device=self.device)
        self.cursor = 0

    def _dilated(self, mask: wp.array) -> wp.array:
        result = wp.empty_like(mask)
        launch(grid_refine.dilate_mask, mask.size, [mask], [result], device=self.device)
        return result

    def measure_weights(self, pixel_stride: int = 1) -> wp.array:
        """(rows,) float32 largest rendering weight that any training ray gives each voxel."""
        rows = self.field.voxel_count
        camera = self.scene.cameras[0]
        count = len(self.scene) * -(-camera.width // pixel_stride) * -(-camera.height // pixel_stride)
        shards = [wp.zeros(rows, dtype=wp.float32, device=self.device) for _ in range(self.shards)]
        edges = [count * i // self.shards for i in range(self.shards + 1)]
        inputs = [self.field.grid, self.rays.cameras, pixel_stride, self.field.step, STOP_TRANSMITTANCE]
        wp.load_module(record_weights.module, device=self.device)
        run_parallel(
            [
                lambda begin=begin, end=end, weights=weights: wp.launch(
                    record_weights,
                    dim=end - begin,
                    inputs=[begin, *inputs],
                    outputs=[weights],
                    device=self.device,
                    block_dim=module_block_dim(record_weights),
                )
                for begin, end, weights in zip(edges, edges[1:], shards, strict=False)
            ],
            self.shards,
        )
        for other in shards[1:]:
            launch(field_step.join_maximum, rows, [other], [shards[0]], device=self.device)
        return shards[0]

    def _pruned_mask(self, threshold: float) -> wp.array:
        """The voxels whose rendering weight reaches a threshold, and their neighbours, among those that there are."""
        stride = max(1, int(0.5 * self.field.resolution[0] ** -1 * self.scene.images.shape[2]))
        weights = self.measure_weights(stride)
        mask = wp.zeros(self.field.resolution, dtype=wp.uint8, device=self.device)
        launch(
            grid_refine.mark_weighty_nodes,
            self.field.voxel_count,
            [self.nodes, weights, threshold],
            [mask],
            device=self.device,
        )
        mask = self._dilated(mask)
        launch(grid_refine.keep_linked, mask.size, [self.field.grid.links], [mask], device=self.device)
        return mask

    def _refine(self) -> None:
        """On to the next level: prune, halve the voxels, interpolate; pictures at 8 bits a channel, then less fine
        voxels, where the memory would not do."""
        self.level += 1
        coarse, memory = self.field.resolution, FitMemory.of(self)
        self.gradients = self.moments = None  # one level's state at a time: this is where memory peaks
        pruned = self._pruned_mask(self.options.prune_weight / max(coarse))
        rows, kept = self.field.voxel_count, mask_count(pruned)
        shape = self._finest(
            memory, lambda held: held.refinement(rows, kept, coarse, self.shapes[self.level], self.memory_limit)
        )
        self.shapes[self.level] = coarse if shape is None else shape
        if shape is not None:
            mask = wp.empty(shape, dtype=wp.uint8, device=self.device)
            ratio = wp.vec3(*(n / m for n, m in zip(shape, coarse, strict=True)))
            launch(grid_refine.refine_mask, mask.size, [ratio, pruned], [mask], device=self.device)
            self._start_level(mask, self.field)
        if self.background is not None:
            self.background.start_level(self.level)
        self._allocate_state()
        self._activate_tiles()

    def restore_field(self, mask: wp.array) -> None:
        """Rows for a mask, with fresh optimiser state: what a checkpoint fills."""
        self.gradients = self.moments = None
        self._start_level(mask, None)
        self._allocate_state()
        self._activate_tiles()

    def _thin_out(self) -> None:
        """Drop what no view shows, and keep the optimiser's state of the rest."""
        memory = FitMemory.of(self)
        self.gradients = None  # cleared between steps
        mask = self._pruned_mask(self.options.keep_weight)
        needed = memory.thinning_bytes(
            self.field.voxel_count,
            mask_count(mask),
            self.field.resolution,
            self.moments.capacity / self.field.voxel_count,
        )
        if needed > self.memory_limit:
            self._allocate_gradients()
            return
        links, moments = self.field.grid.links, self.moments
        self._start_level(mask, self.field)
        self.moments = wp.empty((self.field.voxel_count, ROW_NUMBERS), dtype=wp.bfloat16, device=self.device)
        launch(
            field_step.gather_moments,
            self.moments.size,
            [links, self.nodes, moments],
            [self.moments],
            device=self.device,
        )
        del links, moments
        self._allocate_gradients()
        self._activate_tiles()

    # Steps

    @property
    def level_done(self) -> bool:
        return self.step_count >= sum(self.level_steps[: self.level + 1])

    def step(self) -> None:
        """One batch: gradients, RMSProp step; refines when a level is done."""
        if self.step_count >= self.total_steps:
            raise ValueError(f"all {self.total_steps} steps are done")
        if self.level_done and self.level + 1 < self.options.levels:
            self._refine()
        if self.step_count == self.total_steps - round((1.0 - self.options.keep_at) * self.level_steps[-1]):
            self._thin_out()
        if self.cursor + self.batch_tiles > self.active_tiles:
            self._shuffle_tiles()
        self.rays.first_tile = self.cursor
        # coarse voxels are wider than a pixel's parts
        self.rays.rays_per_side = self.options.supersampling if self.level + 1 == self.options.levels else 1
        self.cursor += self.batch_tiles
        self._accumulate_gradients()
        self._apply_gradients()
        self.step_count += 1

    def _accumulate_gradients(self) -> None:
        options, field = self.options, self.field
        behind, grad_behind = None, None
        if self.background is not None:
            self.background.prepare(self.rays)
            behind, grad_behind = self.background.behind, self.background.grad_behind
        photometric = [
            self.rays,
            wp.vec3(*map(float, field.background)),
            int(self.random_background),
            (self.seed * 1_000_003 + self.step_count) % (2**31 - 1),
            field.step,
            STOP_TRANSMITTANCE,
            1.0 / (3.0 * self.batch_rays),
            behind,
        ]
        cells = float(np.prod(field.resolution))
        scale = max(field.resolution) / 256.0
        variation_rows = max(1, int(options.variation_share * field.voxel_count))
        boost = field.voxel_count / variation_rows / cells * scale
        first_row = int(self.random.integers(field.voxel_count))
        unit = 1.0 / (0.5 * float((self.bounds[1] - self.bounds[0]).max()))
        coefficients = coefficient_rows(field.grid.sh)
        if not self.device.is_cpu:
            launch(
                field_loss_warps.accumulate_photometric_gradient_by_warps,
                lane_count(self.device) * self.batch_rays,
                [field.grid, coefficients, *photometric],
                [self.gradients[0], self.touched, self.squared_error, grad_behind],
                device=self.device,
            )
        vary = self.variation_density > 0 or self.variation_sh > 0
        variation = [
            field.grid,
            coefficients,
            self.nodes,
            first_row,
            unit,
            self.variation_density * boost,
            self.variation_sh * boost,
        ]

        def shard(index: int) -> None:
            gradients = self.gradients[index]
            begin, end = (self.batch_rays * i // self.shards for i in (index, index + 1))
            if self.device.is_cpu:
                wp.launch(
                    field_loss.accumulate_photometric_gradient,
                    dim=end - begin,
                    inputs=[begin, field.grid, *photometric],
                    outputs=[*gradient_parts(gradients), self.squared_error, grad_behind],
                    device=self.device,
                )
            begin, end = (ROW_NUMBERS * (variation_rows * i // self.shards) for i in (index, index + 1))
            if end > begin and vary:
                wp.launch(
                    field_variation.accumulate_variation_gradient,
                    dim=end - begin,
                    inputs=[begin, *variation],
                    outputs=[gradients, self.touched],
                    device=self.device,
                )

        if self.device.is_cpu:  # before the threads, so that each is compiled once
            wp.load_module(field_loss, device=self.device)
            wp.load_module(field_variation, device=self.device)
        run_parallel([lambda i=i: shard(i) for i in range(self.shards)], self.shards)
        if self.background is not None:
            self.background.accumulate(self.rays, self.random)

    def _apply_gradients(self) -> None:
        options, field = self.options, self.field
        progress = (self.step_count / max(1, self.total_steps - 1)) ** options.decay_power
        if self.background is not None:
            self.background.apply(progress)
        if self.device.is_cpu:
            self.touched.fill_(1)
        voxel = float(field.voxel_size.max())
        rate_density = _log_interpolate(options.rate_density, options.rate_density_end, progress) / voxel
        rate_sh = _log_interpolate(options.rate_sh, options.rate_sh_end, progress)
        total, *others = (gradients.flatten() for gradients in self.gradients)
        for other in others:
            launch(field_step.add_gradients, total.size, [other], [total], device=self.device)
        inputs = [
            rate_density,
            rate_sh,
            self.directional * rate_sh,
            options.beta,
            1e-12 * voxel,
            1e-12,  # a density's gradient is a length
            self.touched,
            self.gradients[0],
            self.moments,
        ]
        launch(
            field_step.apply_rmsprop,
            total.size,
            inputs,
            [field.grid.density, coefficient_rows(field.grid.sh)],
            device=self.device,
        )
        self.touched.zero_()
        if self.scarcity > 1 and options.shrink_sh > 0 and self.step_count % SHRINK_EVERY == 0:
            kept = max(0.0, 1.0 - rate_sh * options.shrink_sh * self.scarcity) ** SHRINK_EVERY
            launch(shrink_view_dependence, 3 * field.voxel_count, [kept], [field.grid.sh], device=self.device)

    def measure_psnr(self) -> float:
        """PSNR in dB of the last batch, over all pixels of the images: those that see no voxel count as right."""
        error = float(self.squared_error.numpy().mean()) / 3.0 * self.active_tiles / self.tile_total
        self.psnr = -10.0 * math.log10(max(error, 1e-12))
        return self.psnr

    def finish(self) -> VoxelField:
        """Prune what no view shows, record rendering weights, and return the field.

        What is left is what a cage has to enclose: faint floaters would stay behind when the object moves.
        """
        self.gradients = self.moments = None
        mask = self._pruned_mask(self.options.keep_weight)
        self._start_level(mask, self.field)
        self.field.weights = self.measure_weights()
        self.field.up = self.scene.up
        self.field.supersampling = self.options.supersampling
        if self.background is not None:
            self.field.background_model = self.background.result()
        return self.field


def fit(
    scene: Scene,
    *,
    quality: str = "standard",
    device=None,
    seed: int = 0,
    progress: bool = True,
    bounds=None,
    checkpoint=None,
    checkpoint_seconds: float = 60.0,
    **options,
) -> VoxelField:
    """Optimise a VoxelField from a Scene.

    quality: "fast", "standard" or "high" (see fit_options.QUALITIES and the README for times and dB).
    device: Warp device, None is CUDA where there is one. seed: see FieldOptimizer. progress: a bar with the PSNR of the
    last batch. bounds: (2, 3) world units of the object, None finds it (visual hull where the images have alpha).
    checkpoint: file (.npz) that holds the progress, written every checkpoint_seconds, whole or not at all. Where it is
    there already the fit goes on from it; when the fit is done it is removed.
    options: FitOptions fields by name, e.g. resolution=256, epochs=12, max_memory="4GB" (for which the precision of the
    pictures on the device and the resolution are chosen).

    Raises ValueError for a scene with nothing in it, options out of range, or a checkpoint of another scene or options.
    """
    from tqdm import tqdm

    if checkpoint is not None:
        checkpoint = require_writable(checkpoint)
    optimizer = FieldOptimizer(scene, device=device, seed=seed, bounds=bounds, quality=quality, **options)
    if checkpoint is not None and checkpoint.exists():
        load_progress(optimizer, checkpoint)
    with tqdm(total=optimizer.total_steps, initial=optimizer.step_count, desc="fit", disable=not progress) as bar:
        shown = saved = time.monotonic()
        while optimizer.step_count < optimizer.total_steps:
            optimizer.step()
            bar.update()
            if progress and time.monotonic() - shown > 1.0:
                shown = time.monotonic()
                size = "x".join(str(n) for n in optimizer.field.resolution)
                bar.set_postfix_str(f"{optimizer.measure_psnr():.2f} dB at {size}")
            if checkpoint is not None and time.monotonic() - saved > checkpoint_seconds:
                save_progress(optimizer, checkpoint)
                saved = time.monotonic()
    optimizer.measure_psnr()
    field = optimizer.finish()
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    return field


def _ratio(fine: VoxelField, coarse: VoxelField) -> wp.vec3:
    """Voxels of one field a voxel of another over the same bounds, along each axis."""
    return wp.vec3(*(n / m for n, m in zip(fine.resolution, coarse.resolution, strict=True)))


def _log_interpolate(start: float, end: float, progress: float) -> float:
    return math.exp((1.0 - progress) * math.log(start) + progress * math.log(end))
