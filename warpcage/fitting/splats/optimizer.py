"""Fit Gaussian splats to posed images, step by step."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ...core.arrays import empty_array, struct_array
from ...core.checks import checked_whole, require_type
from ...core.devices import HeldOnDevice, captured, launch, resolve_device
from ...core.modules import load_modules
from ...core.names import counted
from ...core.reports import Progress, reports_progress
from ...core.threads import device_turn, in_turn
from ...errors import InputError
from ...field.io.field_file import Y0
from ...kernels.fitting import splat_growth, splat_step
from ...kernels.fitting.batches import Pictures
from ...kernels.splats import composite, composite_cpu, fit, project, tiles
from ...scene.scene import Scene
from ...splats.fit import SplatGradients
from ...splats.io.contents import MIN_OPACITY, SplatContents, logits_of, opacities_of
from ...splats.render import IMAGE_BLUR, MAX_ENTRIES, PROJECT_WORK, splat_lens, tile_count, tile_grid
from ...splats.splat_field import SplatField
from ...view.camera import Camera
from ..batches import MIN_ERROR, PRECISIONS, TrainingPictures, counted_pixels, picture_bytes
from ..memory import memory_limit, memory_text, require_image_memory
from .growth import GrowingSplats
from .loss import PictureExposures, PictureLoss
from .options import checked_splat_options
from .schedule import SplatSchedule
from .start import Start, fitted_scene, scene_units, shrunk_camera, starting_splats

#: Nothing nearer to a camera than this is drawn, of the distance of the cameras from what they look at.
NEAR = 0.01

#: Room for entries of splats in tiles, of the most that any picture was seen to have; and for how few at least.
ROOM_SHARE, MIN_ROOM = 1.25, 1 << 16

#: Pictures that are counted to find that room, and the share of it above which it is found anew.
COUNTED_VIEWS, FULL_SHARE = 24, 0.85

#: Pictures are kept at 16 bits a channel where they take at most this share of the memory.
PICTURE_SHARE = 0.05

#: Steps after which it is found anew how small splats may be, and what that costs for a splat.
FLOORS_EVERY, FLOOR_WORK = 100, 200

#: Bytes of an entry while it is sorted.
ENTRY_BYTES = 16


class TrainingView(SplatGradients):
    """Draws splats by a lens on the device, without the host between, and takes slopes back to their sums."""

    def __init__(self, width: int, height: int, device: wp.Device):
        super().__init__(device)
        self.pixels = width * height
        self.grid = tile_grid(width, height)
        self.room = MIN_ROOM
        self.most = wp.zeros(1, dtype=wp.int64, device=device)  # entries of any picture yet
        self.missed = wp.zeros(2, dtype=wp.int32, device=device)  # whether this picture has too many, and how many had

    def count_entries(self, splats: Any, count: int, lens: wp.array) -> int:
        """Entries of the picture of a lens, (1,) Lens."""
        return super()._count(self.grid, *self._project(splats, lens, count, project.project_by_lens))

    def draw_by(self, splats: Any, count: int, lens: wp.array) -> tuple[wp.array, wp.array, wp.array]:
        """Colours (h * w,) on black, opacities (h * w,), and the view (3 n,) of the first `count` splats."""
        seen = self._project(splats, lens, count, project.project_by_lens)
        total = self._count(self.grid, *seen)
        rgb, alpha, _ = self._draw_entries(self.grid, seen, total, wp.vec3())
        return rgb, alpha, seen[1]

    def _count(self, grid: Any, count: int, view: wp.array, depths: wp.array, order: wp.array) -> int:
        """All entries on a CPU; on CUDA the room for them, as the host does not wait for their number."""
        if self.device.is_cpu:
            return super()._count(grid, count, view, depths, order)
        counts, ends = self._counts.take(count), self._ends.take(count)
        launch(tiles.count_tiles, count, [view, depths, order, grid], [counts], device=self.device)
        wp.utils.array_scan(counts, ends)
        inputs, outputs = [count, self.room, ends], [self.most, self.missed]
        launch(splat_step.check_room, 1, inputs, outputs, device=self.device)
        return self.room

    def _write(self, grid: Any, total: int, seen: tuple) -> tuple[wp.array, wp.array]:
        if self.device.is_cuda:  # places that no entry takes are sorted behind all tiles
            self._keys.take(2 * total).fill_(tile_count(grid))
        return super()._write(grid, total, seen)


class SplatFit(HeldOnDevice):
    """Fits Gaussian splats to the images of a Scene.

    Kheradmand et al., "3D Gaussian Splatting as Markov Chain Monte Carlo" (NeurIPS 2024), on the slopes of Kerbl et al.
    (SIGGRAPH 2023): L1 and structural dissimilarity, dead splats that begin anew as copies of living ones, and as many
    splats at the end as asked for. Use `fit` with representation="splats" unless you need the steps.

    Args:
        scene: The images with their cameras.
        device: Warp device. None is CUDA where there is one.
        seed: Seed of the order of pictures, of where splats begin and grow, and of the noise. On the CPU the same seed
            and scene give the same splats to the bit, with as many threads where they begin on a quick fit of voxels.
        first: Splats to begin with. None follows the option `start`.
        weights: (n, h, w) in [0, 1], how much each pixel of the pictures counts, in place of `Scene.weights`. None
            takes those.
        progress: A function is called with (done, total, message) before kernels are compiled; see `fit`.
        options: `quality`, and fields of SplatFitOptions by name, which have priority over it.

    Raises:
        ValueError: For options out of range, a scene with nothing in it, or too little memory.

    Attributes:
        options: All options.
        device: The Warp device.
        step_count: Steps done.
        total_steps: Steps of the whole fit.
        psnr: Of the last measured picture, in dB.
        source: Where the splats began, for people.
    """

    coarser = None  # a fit of voxels says here that its field is coarser than planned

    @reports_progress
    def __init__(
        self,
        scene: Scene,
        *,
        device: wp.DeviceLike = None,
        seed: int = 0,
        first: Start | None = None,
        weights: ArrayLike | None = None,
        progress: bool | Progress = False,
        **options: Any,
    ):
        require_type(scene, Scene, "a fit needs")
        self.options = checked_splat_options(options)
        scene = fitted_scene(scene)
        self.scene = scene = scene if weights is None else dataclasses.replace(scene, weights=weights)
        self.device, self.seed = resolve_device(device), checked_whole(seed, "the seed", 0)
        self.step_count, self.psnr = 0, float("nan")
        self.memory_limit = memory_limit(self.options.max_memory, self.device)
        modules = [composite_cpu] if self.device.is_cpu else [composite]
        load_modules([*modules, project, tiles, fit, splat_step, splat_growth], self.device, progress)
        self._center, self._unit, extent = scene_units(scene)
        self.most_splats = self._planned_splats()
        if first is None:
            wanted = self.options.start
            first = starting_splats(scene, most=self.most_splats, seed=self.seed, device=self.device, kind=wanted)
        self.source = first.source
        self.given = {
            "seed": self.seed,
            "first": hashlib.blake2b(np.ascontiguousarray(first.centers).tobytes(), digest_size=16).hexdigest(),
            **dataclasses.asdict(self.options),
        }
        self.growing = GrowingSplats(self._contents(first), self.most_splats, self.options.degree, self.device)
        self._first_count = self.growing.count
        height, width = scene.images.shape[1:3]
        self.schedule = SplatSchedule(self.options, len(scene), (width, height), extent, self._background(), self.seed)
        self.total_steps = self.schedule.total_steps
        self._counts = self._planned_counts()
        self._plan = self.schedule.table(self._counts, self.device)
        self._counter = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._step: wp.array = empty_array(1, splat_step.SplatStep, self.device)
        self._lens: wp.array = empty_array(1, project.Lens, self.device)
        self._colors: wp.array = empty_array(self.growing.room, wp.vec3, self.device)
        bases = (self.options.degree + 1) ** 2
        self._weights_of_bases: wp.array = empty_array((self.growing.room, bases), wp.float32, self.device)
        floors = self.growing.room if self.options.least_scale > 0.0 else 0
        self._floors: wp.array = empty_array(floors, wp.float32, self.device)
        bits = PRECISIONS[0] if picture_bytes(scene, 16) <= PICTURE_SHARE * self.memory_limit else PRECISIONS[-1]
        self._pictures = TrainingPictures(scene, bits, self.device)
        self._exposures = PictureExposures(len(scene) if self.options.exposure else 0, self.device)
        self._graph: Any = None
        self._drawn: tuple[wp.array, wp.array] | None = None  # colours and opacity of the last step's picture
        self._is_warm = False  # whether a step ran by launches since sizes changed last
        self._shrinkage = 0
        with device_turn(self.device):
            self._show(self.schedule.shrinkage(0))

    # State

    @property
    def splat_count(self) -> int:
        """Splats so far."""
        return self.growing.count

    def _planned_splats(self) -> int:
        """Splats at the end: as many as are asked for, and as the pictures and the memory allow."""
        scene = self.scene
        held = picture_bytes(scene, PRECISIONS[-1])
        require_image_memory(held, self.memory_limit)
        room = (self.memory_limit - held - 150 * math.prod(scene.images.shape[1:3])) // (
            GrowingSplats.row_bytes(self.options.degree) + 4 * ENTRY_BYTES
        )
        most = min(self.options.most_splats, int(counted_pixels(scene) / self.options.pixels_per_splat))
        if room < 1000:
            raise InputError(
                f"a fit of splats within {memory_text(self.memory_limit)} (max_memory) is not possible: the images "
                f"take {memory_text(held)}"
            )
        return int(max(1, min(most, room)))

    def _background(self) -> np.ndarray | None:
        """Colour behind the splats, (3,), None for random ones."""
        wanted = self.options.background
        if wanted in ("auto", "random"):
            return None
        return np.asarray(self.scene.background, np.float64) if wanted == "constant" else np.zeros(3)

    def _contents(self, first: Start) -> SplatContents:
        """The first splats in units of the fit."""
        count = len(first.centers)
        options = self.options
        scales = first.log_scales - math.log(self._unit) + math.log(options.start_scale)
        turns = np.random.default_rng(self.seed).normal(size=(count, 4)).astype(np.float32)
        return SplatContents(
            ((first.centers - self._center) / self._unit).astype(np.float32),
            np.repeat(scales.astype(np.float32)[:, None], 3, axis=1),
            turns / np.linalg.norm(turns, axis=1, keepdims=True),
            logits_of(np.full(count, options.start_opacity)),
            ((np.asarray(first.colors, np.float32) - 0.5) / Y0)[:, None, :],
        )

    def _planned_counts(self) -> np.ndarray:
        """(steps,) splats of each step."""
        counts, count = np.empty(self.total_steps), self._first_count
        for step in range(self.total_steps):
            if self.schedule.revives(step):
                count = self.schedule.count_after(step, count, self._first_count, self.most_splats)
            counts[step] = count
        return counts

    def count_at(self, step: int) -> int:
        """Splats that there are after some steps, whatever is learnt.

        Args:
            step: How many steps.

        Returns:
            The number of splats.
        """
        return int(self._counts[step - 1]) if step else self._first_count

    @property
    def exposures(self) -> np.ndarray:
        """(n, 6) float32, how each picture differs from the splats: logarithms of three gains, then three offsets.

        Their means over the pictures are 0. All are 0 where exposures are not learnt (option `exposure`)."""
        if not self._exposures.count:
            return np.zeros((len(self.scene), 6), np.float32)
        with device_turn(self.device):
            found = self._exposures.state()[:, :6]
        return (found - found.mean(axis=0)).astype(np.float32)

    @property
    def exposure_state(self) -> np.ndarray:
        """(n, 19) float64, `exposures` with what Adam keeps of them, for checkpoints."""
        return self._exposures.state()

    def restore(self, step: int, state: dict[str, dict[str, np.ndarray]], exposures: np.ndarray) -> None:
        """Go on where another fit of the same scene and options was.

        Args:
            step: How many steps that fit had made.
            state: Its splats: what the `state` of its `growing` gave.
            exposures: Its `exposure_state`.
        """
        self.growing.restore(state)
        self._exposures.restore(exposures)
        self._change()
        self.step_count = step
        self._counter.fill_(step)
        last = max(step - 1, 0)
        self.growing.splats.degree = self.schedule.degree(last)
        self._show(self.schedule.shrinkage(last))

    # Steps

    @in_turn
    def step(self) -> None:
        """One step: a picture, its slopes, and what they change."""
        step, schedule = self.step_count, self.schedule
        if schedule.revives(step):
            self._grow(step)
        if schedule.shrinkage(step) != self._shrinkage:
            self._show(schedule.shrinkage(step))
        if schedule.degree(step) != self.growing.splats.degree:
            self.growing.splats.degree = schedule.degree(step)
            self._change()
        if step % len(self.scene) == 0:
            self._exposures.center()
        if step % FLOORS_EVERY == 0 or schedule.revives(step):
            self._find_floors()
        if self.device.is_cpu or not self._is_warm:
            self._launch_step()
            self._is_warm = True
        else:
            if self._graph is None:
                with captured(self.device, force_module_load=False) as capture:
                    self._launch_step()
                self._graph = capture.graph
            wp.capture_launch(self._graph)
        self.step_count += 1

    def _find_floors(self) -> None:
        """How small splats may be where they are now."""
        count = self.growing.count if len(self._floors) else 0
        inputs = [self.options.least_scale, self._lenses, self.growing.values.centers]
        launch(splat_step.find_floors, count, inputs, [self._floors], device=self.device, work=FLOOR_WORK)

    def _grow(self, step: int) -> None:
        """Let dead splats begin anew, and add others."""
        seed = int(self.schedule.seeds[step])
        self.growing.revive(seed)
        count = int(self._counts[step])
        if count > self.growing.count:
            self.growing.grow(count, seed + 1)
            self._change()
        if self.device.is_cuda and int(self._view.most.numpy()[0]) > FULL_SHARE * self._view.room:
            self._find_room()

    def _change(self) -> None:
        """Steps have other sizes from now on."""
        self._graph, self._is_warm = None, False

    def _show(self, shrinkage: int) -> None:
        """Compare with pictures of another size from now on."""
        scene, device = self.scene, self.device
        count, height, width = scene.images.shape[0], *scene.images.shape[1:3]
        self._shrinkage, self._width, self._height = shrinkage, width // shrinkage, height // shrinkage
        self._shown, counted = self._pictures.seen, self._pictures.counted
        if shrinkage > 1:
            coarse = empty_array((count, self._height, self._width), wp.vec4h, device)
            launch(splat_step.shrink_pictures, coarse.size, [shrinkage, self._pictures.seen], [coarse], device=device)
            self._shown = Pictures()
            self._shown.halves = coarse
            if counted.size:
                counted = empty_array(coarse.shape, wp.uint8, device)
                inputs = [shrinkage, self._pictures.counted]
                launch(splat_step.shrink_weights, coarse.size, inputs, [counted], device=device)
        self._shown_counted = counted
        lenses = [self._lens_of(camera) for camera in scene.cameras]
        self._lenses = struct_array(lenses, project.Lens, device)
        self._loss = PictureLoss(self._width, self._height, device, self.options.ssim)
        self._truth = empty_array(self._width * self._height, wp.vec3, device)
        self._weights = empty_array(self._width * self._height if counted.size else 0, wp.float32, device)
        self._exposed = empty_array(self._width * self._height if self._exposures.count else 0, wp.vec3, device)
        self._view, self._drawn = TrainingView(self._width, self._height, device), None
        self._find_floors()
        self._find_room()
        self._change()

    def _lens_of(self, camera: Camera) -> Any:
        """How a picture is drawn, in units of the fit."""
        pose = camera.camera_to_world.copy()
        pose[:3, 3] = (pose[:3, 3] - self._center) / self._unit
        shown = {"width": self._width, "height": self._height, "camera_to_world": pose}
        small = dataclasses.replace(shrunk_camera(camera, self._shrinkage), **shown)
        return splat_lens(small, np.zeros(3), NEAR, IMAGE_BLUR, self.options.antialias)

    def _find_room(self) -> None:
        """Keep room for the entries of pictures, as some of them have now, and then some."""
        if self.device.is_cpu:
            return
        most = int(self._view.most.numpy()[0])
        for number in np.linspace(0, len(self.scene) - 1, min(COUNTED_VIEWS, len(self.scene))).astype(int):
            wp.copy(self._lens, self._lenses, src_offset=int(number), count=1)
            most = max(most, self._view.count_entries(self.growing.splats, self.growing.count, self._lens))
        room = max(MIN_ROOM, int(ROOM_SHARE * most))
        if room > MAX_ENTRIES:
            raise InputError(f"splats touch {most} tiles of a picture: fit smaller pictures, or fewer splats")
        self._view.room = room
        self._change()

    def _launch_step(self) -> None:
        """All launches of a step."""
        device, splats, view = self.device, self.growing, self._view
        inputs, outputs = [self._plan, self._lenses], [self._counter, self._step, self._lens]
        launch(splat_step.begin_step, 1, inputs, outputs, device=device)
        rgb, alpha, seen = view.draw_by(splats.splats, splats.count, self._lens)
        exposures = self._exposures
        inputs = [self._width, self._shown, self._step, exposures.rows, self._shown_counted, alpha]
        outputs = [rgb, self._truth, self._exposed, self._weights]
        launch(splat_step.take_picture, view.pixels, inputs, outputs, device=device)
        shown, weights = self._exposed if exposures.count else rgb, self._weights if self._weights.size else None
        slopes, self._drawn = self._loss.slopes(shown, self._truth, weights), (shown, alpha)
        exposures.take_back(self._step, view.missed, alpha, rgb, slopes)
        sums = view.sum_slopes(slopes)
        rows = [splats.values, splats.means, splats.squares]
        inputs = [splats.splats, self._lens, self._step, view.missed, self._floors, seen, sums, *rows]
        outputs = [self._colors, self._weights_of_bases]
        launch(splat_step.step_splats, splats.count, inputs, outputs, device=device, work=3 * PROJECT_WORK)
        bases = (splats.splats.degree + 1) ** 2
        together = bases if device.is_cpu else 1
        inputs = [bases, together, self._step, view.missed, self._colors, self._weights_of_bases]
        arrays = [each.harmonics for each in rows]
        launch(splat_step.step_harmonics, splats.count * bases // together, inputs, arrays, device=device)

    def measure_psnr(self) -> float:
        """PSNR in dB of the last picture that has pixels which count, over those alone, before its step."""
        if self._drawn is not None:
            with device_turn(self.device):
                errors, weights = self._errors(*self._drawn), np.asarray(self._weights.numpy(), np.float64)
            weights = weights if weights.size else np.ones(errors.shape)
            if weights.any():  # beyond a smaller picture they are 0
                error = float(np.average(errors, weights=weights))
                self.psnr = -10.0 * math.log10(max(error, MIN_ERROR))
        return self.psnr

    def _errors(self, shown: wp.array, alpha: wp.array) -> np.ndarray:
        """(h * w,) squared errors of the last picture as the field shows it: of whole ones on black."""
        if self._background() is not None or self.scene.alphas is not None:
            return self._loss.errors.numpy()
        step: Any = self._step.numpy()
        random = (1.0 - alpha.numpy()[:, None]) * step["background"][0]  # behind what is not filled yet
        return ((np.clip(shown.numpy() - random, 0.0, 1.0) - self._truth.numpy()) ** 2).mean(axis=1)

    @property
    def missed_steps(self) -> int:
        """Steps that changed nothing, as their pictures had more entries than there was room for."""
        return int(self._view.missed.numpy()[1])

    @in_turn
    def finish(self) -> SplatField:
        """The field at the end."""
        return self.field

    @property
    def size_text(self) -> str:
        """How large the field is so far, for people."""
        return counted(self.splat_count, "splat")

    @property
    def field(self) -> SplatField:
        """The splats so far, in the scene's own world, without those that no picture sees."""
        values: dict[str, Any] = self.growing.to_contents(self.growing.splats.degree)
        kept = opacities_of(values["logits"]) >= MIN_OPACITY
        values = {name: rows[kept] for name, rows in values.items()}
        values["centers"] = values["centers"].astype(np.float64) * self._unit + self._center
        values["log_scales"] = values["log_scales"] + np.float32(math.log(self._unit))
        if np.abs(values["centers"]).max(initial=0.0) < 1e4 * self._unit:
            values["centers"] = values["centers"].astype(np.float32)
        behind = self._background()
        if behind is None:
            behind = np.zeros(3) if self.scene.alphas is None else self.scene.background
        made_for = {"antialias": self.options.antialias, "device": self.device}
        return SplatField(**values, background=behind, up=self.scene.up, **made_for)
