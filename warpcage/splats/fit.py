"""Fit splats to pictures: values on a device, pictures that give slopes by them, and the steps."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array, struct_array
from ..core.checks import (
    checked_flag,
    checked_number,
    checked_positive,
    checked_whole,
    renamed,
    require_type,
    warn_renamed,
)
from ..core.devices import launch
from ..core.names import checked_choice
from ..core.reports import Progress, report_progress, reports_progress
from ..core.threads import device_turn
from ..errors import InputError
from ..kernels.splats import composite, composite_cpu, fit, project, project_slopes, tiles
from ..kernels.splats.composite import SUMS
from ..kernels.splats.project import Lens
from ..kernels.splats.project_slopes import SplatValues
from ..kernels.splats.splats import Splats
from ..lattice.buffers import BufferPool
from ..view.camera import Camera
from ..view.frame import checked_supersampling, finer_camera, parse_background
from .render import (
    DRAW_WORK,
    IMAGE_BLUR,
    MAX_ENTRIES,
    PROJECT_WORK,
    STOP_TRANSMITTANCE,
    SplatRenderer,
    splat_lens,
    tile_count,
    tile_grid,
)
from .splat_field import SplatField

#: Names of the values, and the types of those that kernels read by rows.
VALUE_TYPES = {
    "centers": wp.vec3,
    "log_scales": wp.vec3,
    "quaternions": wp.vec4,
    "logits": wp.float32,
    "harmonics": wp.float32,
}


def value_slopes(field: SplatField) -> dict[str, wp.array]:
    """(n, width) float32 zeros for the derivatives of a loss by each of a field's values."""
    held, count = field.contents, len(field)
    widths = {name: np.asarray(getattr(held, name)).size // max(count, 1) for name in VALUE_TYPES}
    return {name: wp.zeros((count, width), dtype=wp.float32, device=field.device) for name, width in widths.items()}


def by_rows(name: str, arrays: dict[str, wp.array]) -> wp.array:
    """An array of values or slopes as kernels read it: (n,) of VALUE_TYPES' type, for harmonics (n, width)."""
    array = arrays[name]
    return array if name == "harmonics" else array_view(array, VALUE_TYPES[name], array.shape[0])


def as_values(slopes: dict[str, wp.array]) -> Any:
    """Slopes as kernels/splats/project_slopes.py writes them; an empty dict for none."""
    values = SplatValues()
    for name in slopes:
        setattr(values, name, by_rows(name, slopes))
    return values


class SplatParameters:
    """Values of a field's splats that change, on its device; the field itself is left as it is."""

    def __init__(self, field: SplatField):
        self.field, held, count = field, field.contents, len(field)
        host = {name: np.asarray(getattr(held, name), np.float64) for name in VALUE_TYPES}
        host["centers"] = host["centers"] - field.center
        self._first_centers = host["centers"].astype(np.float32)
        self.values: dict[str, wp.array] = {}  # (n, width) float32 each, centres relative to the field's `center`
        self.slopes = value_slopes(field)  # derivatives of a loss by each of them
        for name, values in host.items():
            rows = np.ascontiguousarray(values.reshape(self.slopes[name].shape), np.float32)
            self.values[name] = wp.array(rows, dtype=wp.float32, device=field.device)
        self.splats: Any = Splats()  # What `refresh` makes of the values.
        self.splats.centers = by_rows("centers", self.values)
        self.splats.covariances = empty_array((count, 6), wp.float32, field.device)
        self.splats.opacities = empty_array(count, wp.float32, field.device)
        self.splats.harmonics, self.splats.degree = self.values["harmonics"], field.degree
        self.splats.turns = empty_array(0, wp.quat, field.device)
        self.splats.rows = empty_array(0, wp.int32, field.device)
        self.value_slopes = as_values(self.slopes)

    def refresh(self) -> None:
        """Make the covariances and opacities of `splats` from the values as they are now."""
        names = ("log_scales", "quaternions", "logits")
        inputs = [by_rows(name, self.values) for name in names]
        launch(fit.make_splats, len(self.field), inputs, [self.splats], device=self.field.device)

    def to_field(self, antialias: bool) -> SplatField:
        """A field of the values as they are now, with what else the file of the first one says."""
        held, count = self.field.contents, len(self.field)
        host = {name: array.numpy() for name, array in self.values.items()}
        moved = host["centers"].astype(np.float64) - self._first_centers  # from where the file has them, to the bit
        centers = (held.centers + moved).astype(held.centers.dtype)
        return SplatField(
            centers,
            host["log_scales"],
            host["quaternions"],
            host["logits"].reshape(count),
            host["harmonics"].reshape(held.harmonics.shape),
            layout=held.layout,
            device=self.field.device,
            **self.field.view_options() | {"antialias": antialias},
        )


#: Sums of a splat on the host, and those by depths.
SUM_COUNT, DEPTH_SUM_COUNT = int(SUMS), 3


class SplatGradients(SplatRenderer):
    """Draws splats, and takes the slopes of a loss by the picture back to their values.
    Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (SIGGRAPH 2023), appendix A."""

    def __init__(self, device: wp.DeviceLike = None):
        super().__init__(device)
        pool = BufferPool(self.device)
        self._sums, self._entry_sums = pool.buffer(wp.float32), pool.buffer(wp.float32)
        self._tiles, self._sources = pool.buffer(wp.int32), pool.buffer(wp.int32)
        self._rgb, self._alpha, self._depth = (pool.buffer(dtype) for dtype in (wp.vec3, wp.float32, wp.float32))
        self._depth_sums, self._entry_depths = pool.buffer(wp.float32), pool.buffer(wp.float32)
        self._drawn: tuple[Any, ...] = ()
        self._parameters: Any = None
        self._lens: Any = None

    def draw(self, parameters: SplatParameters, camera: Camera, lens: Any, color: wp.vec3) -> wp.array:
        """The picture (h * w,) vec3, one ray a pixel, valid until the next one; `parameters` are refreshed before.
        lens: of `splat_lens`, of the same camera; colour: behind the splats."""
        self._parameters, self._lens = parameters, lens
        drawn = self.draw_splats(
            parameters.splats, (camera.width, camera.height), struct_array([lens], Lens, self.device), color
        )
        assert drawn is not None
        return drawn[0]

    def draw_splats(
        self, splats: Any, size: tuple[int, int], lenses: Any, color: wp.vec3, with_depth: bool = False
    ) -> tuple[wp.array, wp.array, wp.array] | None:
        """Colours (v * h * w,) vec3, opacities (v * h * w,) and depths (v * h * w,), or (0,) without, of pictures by
        lenses (v,), width and height as `size`; None where several touch more tiles than are drawn at once."""
        count, views = splats.centers.shape[0], lenses.size
        grid = tile_grid(*size, views, count)
        seen = self._project(splats, lenses, views * count, project.project_by_lens)
        total = self._count(grid, *seen)
        if total > MAX_ENTRIES and views > 1:
            return None
        if total > MAX_ENTRIES:
            raise InputError(f"splats touch {total} tiles of a picture, at most {MAX_ENTRIES}: take smaller pictures")
        return self._draw_entries(grid, seen, total, color, with_depth)

    @property
    def drawn(self) -> object:
        """What was drawn last, to compare by `is`: each drawing replaces it."""
        return self._drawn

    @property
    def view(self) -> wp.array:
        """The view (3 v n,) of the splats drawn last, of kernels/splats/project.py."""
        return self._drawn[1][1]

    def take_back(self, slopes: wp.array) -> None:
        """Set the slopes of the parameters drawn last, from those (h * w,) vec3 of a loss by the picture's colours."""
        parameters, sums = self._parameters, self.sum_slopes(slopes)
        count, view = self._drawn[1][:2]
        held = [by_rows(name, parameters.values) for name in ("log_scales", "quaternions")]
        inputs = [parameters.splats, self._lens, *held, view, sums]
        outputs = [parameters.value_slopes]
        kernel = project_slopes.find_value_slopes
        launch(kernel, count, inputs, outputs, device=self.device, work=2 * PROJECT_WORK)

    def _draw_entries(
        self, grid: Any, seen: tuple, total: int, color: wp.vec3, with_depth: bool = False
    ) -> tuple[wp.array, wp.array, wp.array]:
        """Colours (h * w,) vec3, opacities (h * w,) and depths, or (0,) without, of a picture of so many entries."""
        self.entry_count, pixels = total, grid.width * grid.height * grid.views
        keys, members = self._write(grid, total, seen)
        sources = self._write_sources(grid, total, keys) if self.device.is_cpu else None
        starts = self._sort(grid, total, keys, members)
        rgb, alpha = self._rgb.take(pixels), self._alpha.take(pixels)
        depth = self._depth.take(pixels) if with_depth else empty_array(0, wp.float32, self.device)
        inputs = [seen[1], members, starts, grid]
        self._composite(grid, [*inputs, color, STOP_TRANSMITTANCE], [rgb, alpha, depth])
        self._drawn = grid, seen, inputs, sources, total, rgb
        return rgb, alpha, depth

    def sum_slopes(self, slopes: wp.array) -> wp.array:
        """The sums (9 n,) of the splats drawn last (kernels/splats/project_slopes), from slopes (h * w,) by colours."""
        return self._sum_slopes(slopes, None)[0]

    def sum_depth_slopes(self, slopes: wp.array, others: wp.array) -> tuple[wp.array, wp.array]:
        """`sum_slopes`, and sums (3 n,) by depths; others (h * w,) of `weigh_pixels` (kernels/gradients)."""
        return self._sum_slopes(slopes, others)

    def _sum_slopes(self, slopes: wp.array, others: wp.array | None) -> tuple[wp.array, wp.array]:
        """Sums of the splats drawn last, (9 n,) and (3 n,); others: None where colours alone count, the latter are (0,)
        then."""
        grid, (count, _, _, order), inputs, sources, total, rgb = self._drawn
        has_depths = others is not None
        widths = {SUM_COUNT: self._sums, DEPTH_SUM_COUNT: self._depth_sums} if has_depths else {SUM_COUNT: self._sums}
        outputs = [buffer.take(width * count) for width, buffer in widths.items()]
        inputs = [*inputs, STOP_TRANSMITTANCE, rgb, slopes, *([others] if has_depths else [])]
        items = tile_count(grid)
        if self.device.is_cpu:
            buffers = dict(zip(widths, (self._entry_sums, self._entry_depths), strict=False))
            rows = [buffer.take(width * total) for width, buffer in buffers.items()]
            inputs.insert(2, sources)
            kernel = composite_cpu.sum_depth_slopes_of_tiles if has_depths else composite_cpu.sum_slopes_of_tiles
            launch(kernel, items, inputs, rows, device=self.device, work=DRAW_WORK)
            for width, entry_sums, sums in zip(widths, rows, outputs, strict=True):
                inputs = [order, self._ends.take(count), width, entry_sums]
                launch(composite_cpu.sum_slopes_of_splats, count, inputs, [sums], device=self.device)
        else:
            for sums in outputs:
                sums.zero_()
            kernel = composite.add_depth_slopes if has_depths else composite.add_slopes
            launch(kernel, items * tiles.TILE_SIDE**2, inputs, outputs, device=self.device)
        return outputs[0], outputs[1] if has_depths else empty_array(0, wp.float32, self.device)

    def _write_sources(self, grid: Any, total: int, keys: wp.array) -> wp.array:
        """The place before they were sorted of entries that are sorted by tile."""
        held, sources = self._tiles.take(2 * total), self._sources.take(2 * total)
        wp.copy(held, keys, count=total)
        wp.copy(sources, wp.array(np.arange(total, dtype=np.int32), device=self.device), count=total)
        wp.utils.radix_sort_pairs(held, sources, total, 0, tile_count(grid).bit_length())
        return sources


#: What differences of colours may count by.
LOSSES = ("l1", "l2")

#: Colours that a picture may have. Renders of splats go beyond 1 where harmonics do, pictures of 8 bits farther.
LARGEST_COLOR = 8.0

#: Steps between two figures of the bar.
SHOWN_EVERY = 50

#: Adam's means of slopes and of their squares, and what keeps steps small where slopes are nothing beside a pixel.
BETAS, EPSILON = (0.9, 0.999), 1e-8


@renamed(centers="centres", colors="colours")
@dataclasses.dataclass(frozen=True)
class SplatRates:
    """Learning rates: about how far one step changes each kind of values at most.

    Scales, rotations and opacities step as in 3DGS. Centres step less, as those of a field that is to be improved lie
    where they should already (3DGS: 1.6e-4 of the scene's size), and colours more, by measurement
    (benchmarks/NOTES-splats.md).

    Args:
        centers: Share of the median standard deviation of the splats.
        log_scales: Of their logarithms.
        quaternions: Of unit quaternions.
        logits: Of opacities.
        colors: Of the harmonics of degree 0.
        harmonics: Of the others.
        last: Share of all rates, above 0 and at most 1, that is left at the last step; they fall exponentially.

    Raises:
        ValueError: For rates that are negative or not finite, and another share.
    """

    centers: float = 0.02
    log_scales: float = 5e-3
    quaternions: float = 1e-3
    logits: float = 2.5e-2
    colors: float = 5e-3
    harmonics: float = 2e-3
    last: float = 0.05

    @property
    def centres(self) -> float:
        """The old name of `centers`, for one release."""
        warn_renamed("SplatRates.centres", "centers")
        return self.centers

    @property
    def colours(self) -> float:
        """The old name of `colors`, for one release."""
        warn_renamed("SplatRates.colours", "colors")
        return self.colors

    def __post_init__(self) -> None:
        for name, rate in dataclasses.asdict(self).items():
            checked_number(rate, f"the rate {name}", 0.0)
        if not 0.0 < self.last <= 1.0:
            raise InputError(f"the share last of the rates must be above 0 and at most 1, got {self.last!r}")


@reports_progress
def fit_splats(
    field: SplatField,
    cameras: Sequence[Camera],
    images: np.ndarray | Sequence[ArrayLike],
    *,
    steps: int = 2000,
    loss: str = "l2",
    supersampling: int = 1,
    antialias: bool | None = None,
    blur: float = IMAGE_BLUR,
    background: str | ArrayLike | None = None,
    growth: float | None = None,
    rates: SplatRates | None = None,
    seed: int = 0,
    progress: bool | Progress = True,
) -> SplatField:
    """Improve a field of splats on pictures of what it shows.

    Each step draws one picture, takes the slopes of its loss back to the centres, scales, rotations, opacities and
    harmonics of the splats (kernels/splats/composite.py, project_slopes.py), and steps by Adam. There are as
    many splats afterwards as before: none is added, divided or removed. Give a field that is near already, and
    pictures from all sides: what no picture sees stays as it is.

    Args:
        field: The field to begin with. It is left as it is.
        cameras: (m,) cameras of the pictures, of any sizes.
        images: (m, h, w, 3) colours in [0, 1], or a sequence of (h, w, 3); transparent ones composited over the
            background.
        steps: Pictures that are drawn, in random order, each as often as the others.
        loss: Of colour differences: "l2", their squares, for a high PSNR, or "l1", as 3DGS has it (here without its
            structural term).
        supersampling: Rays along each side of a pixel, 1 to 8.
        antialias: Weaken splats that the blur of the picture makes larger (Mip-Splatting). The fitted field is drawn in
            the same way. None is the field's own.
        blur: Variance by which pictures are blurred, pixels squared.
        background: Colour behind the splats, a name or (3,) in [0, 1]. None is the field's own.
        growth: How many times as large as at first, along each of its axes, a splat may become, 1 or more; fields that
            are to be posed need splats that stay at their place. None sets no limit.
        rates: Learning rates. None is SplatRates().
        seed: Seed of the order of pictures.
        progress: True shows a bar with the PSNR of the last picture on stderr. A function is called with
            (done, total, message), in steps, and cancels by returning False or raising.

    Returns:
        The fitted field, on the device of the first one, with what else its file says.

    Raises:
        ValueError: For no splats or no pictures, pictures that do not fit their cameras, are not finite or of 8 bits,
            options out of range, and rates with which values leave the range of float32.
        Cancelled: Where `progress` returned False.

    References: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (SIGGRAPH 2023).
    """
    require_type(field, SplatField, "fit_splats needs")
    cameras, pictures = checked_pictures(cameras, images)
    if not len(field):
        raise InputError("a field without splats cannot be fitted: give it some to begin with")
    checked_choice(loss, "loss", tuple(LOSSES))
    steps = checked_whole(steps, "steps", 1)
    rates = SplatRates() if rates is None else rates
    require_type(rates, SplatRates, "rates must be")
    optimizer = SplatOptimizer(
        field,
        cameras,
        pictures,
        steps=steps,
        loss=loss,
        supersampling=checked_supersampling(supersampling),
        blur=checked_positive(blur, "blur"),
        antialias=field.antialias if antialias is None else checked_flag(antialias, "antialias"),
        background=field.background if background is None else parse_background(background),
        growth=math.inf if growth is None else checked_number(growth, "growth", 1.0),
        rates=rates,
        seed=checked_whole(seed, "seed", 0),
    )
    message = "fit splats"
    for step in range(steps):
        report_progress(progress, step, steps, message)
        optimizer.step()
        if progress and step % SHOWN_EVERY == 0:
            message = f"fit splats: {-10.0 * np.log10(max(optimizer.mean_error(), 1e-20)):.2f} dB"
    report_progress(progress, steps, steps, message)
    try:
        return optimizer.to_field()
    except ValueError as error:
        raise InputError(f"the fit left the range of float32, with smaller rates it stays there: {error}") from error


def checked_pictures(
    cameras: Sequence[Camera], images: np.ndarray | Sequence[ArrayLike]
) -> tuple[list[Camera], list[np.ndarray]]:
    """Cameras, and pictures (h, w, 3) float32 that fit them; images: (m, h, w, 3), or a sequence of (h, w, 3)."""
    for name, values in (("cameras", cameras), ("images", images)):
        if isinstance(values, str) or not isinstance(values, Iterable):
            raise InputError(f"{name} must be a list, one for each picture, got {type(values).__name__}")
    cameras, pictures = list(cameras), [_as_picture(number, image) for number, image in enumerate(images)]
    if not cameras or len(cameras) != len(pictures):
        raise InputError(f"fit_splats needs pictures, a camera each: got {len(pictures)} and {len(cameras)} cameras")
    for number, (camera, picture) in enumerate(zip(cameras, pictures, strict=True)):
        require_type(camera, Camera, f"picture {number} needs")
        if picture.shape != (camera.height, camera.width, 3):
            size = f"({camera.height}, {camera.width}, 3)"
            raise InputError(f"picture {number} must be {size} as its camera says, got {picture.shape}")
        if not np.isfinite(picture).all():
            raise InputError(f"picture {number} has values that are not finite")
        if np.abs(picture).max() > LARGEST_COLOR:
            raise InputError(
                f"picture {number} has values from {picture.min():g} to {picture.max():g}: they must lie in [0, 1] "
                "(8-bit pictures divided by 255)"
            )
    return cameras, pictures


def _as_picture(number: int, image: ArrayLike) -> np.ndarray:
    """A picture in float32."""
    try:
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, which is checked
            return np.asarray(image, np.float32)
    except (TypeError, ValueError) as error:
        raise InputError(f"picture {number} must be (h, w, 3) numbers, got {type(image).__name__}") from error


class SplatOptimizer:
    """Steps the values of a field's splats down the loss of pictures, one picture a step."""

    def __init__(
        self,
        field: SplatField,
        cameras: Sequence[Camera],
        images: Sequence[np.ndarray],  # (h, w, 3) each, colours in [0, 1], before the background
        *,
        steps: int,  # steps that there will be
        loss: str,  # "l1" or "l2"
        supersampling: int,  # rays along each side of a pixel
        blur: float,  # variance by which pictures are blurred, pixels squared
        antialias: bool,  # as in `SplatField.render`
        background: np.ndarray,  # (3,) colour behind the splats
        growth: float,  # times as large as at first a splat may become along an axis; inf for no limit
        rates: SplatRates,
        seed: int,  # of the order of pictures
    ):
        self.device, self.step_count, self._steps = field.device, 0, steps
        self._side, self._squared, self._rates = supersampling, int(loss == "l2"), rates
        self._antialias = antialias
        self._background = wp.vec3(*map(float, background))
        self._parameters, self._gradients = SplatParameters(field), SplatGradients(field.device)
        self._cameras = [finer_camera(camera, supersampling) for camera in cameras]
        fine = blur * supersampling**2
        self._lenses = [splat_lens(camera, field.center, field.near, fine, antialias) for camera in self._cameras]
        self._images = [wp.array(image.reshape(-1, 3), dtype=wp.vec3, device=self.device) for image in images]
        most = max(len(image) for image in self._images)
        self._slopes = empty_array(most * supersampling**2, wp.vec3, self.device)
        self._errors = empty_array(most, wp.float32, self.device)
        values = self._parameters.values
        self._means = {name: wp.zeros_like(array) for name, array in values.items()}
        self._squares = {name: wp.zeros_like(array) for name, array in values.items()}
        size = float(np.exp(np.median(field.contents.log_scales)))
        self._kinds = {  # numbers that come first in a row, their rate, and that of the others
            "centers": (0, 0.0, rates.centers * size),
            "log_scales": (0, 0.0, rates.log_scales),
            "quaternions": (0, 0.0, rates.quaternions),
            "logits": (0, 0.0, rates.logits),
            "harmonics": (3, rates.colors, rates.harmonics),
        }
        self._growth = math.log(growth)
        self._first_scales = wp.clone(values["log_scales"]) if math.isfinite(growth) else None
        self._order: list[int] = []
        self._pixels = 0
        self._random = np.random.default_rng(seed)

    def step(self) -> None:
        """Draw the next picture, and step by its slopes."""
        if not self._order:
            self._order = self._random.permutation(len(self._cameras)).tolist()
        with device_turn(self.device):
            self._find_slopes(self._order.pop())
            self._step_values()
        self.step_count += 1

    def to_field(self) -> SplatField:
        """The field of the values as they are now."""
        with device_turn(self.device):
            return self._parameters.to_field(self._antialias)

    def mean_error(self) -> float:
        """Mean square of the colours' errors in the last picture, before its step."""
        with device_turn(self.device):
            return float(self._errors.numpy()[: self._pixels].mean())

    def _find_slopes(self, number: int) -> None:
        camera, image = self._cameras[number], self._images[number]
        self._pixels = len(image)
        self._parameters.refresh()
        drawn = self._gradients.draw(self._parameters, camera, self._lenses[number], self._background)
        inputs = [self._side, camera.width // self._side, self._squared, drawn, image]
        outputs = [self._slopes, self._errors]
        launch(fit.slope_of_picture, self._pixels, inputs, outputs, device=self.device)
        self._gradients.take_back(self._slopes)

    def _step_values(self) -> None:
        done = self.step_count + 1
        fall = self._rates.last ** (self.step_count / max(self._steps - 1, 1))
        for name, (lead, lead_rate, rate) in self._kinds.items():
            values, slopes = self._parameters.values[name], self._parameters.slopes[name]
            step = fit.AdamStep()
            step.width, step.lead, step.lead_rate, step.rate = values.shape[1], lead, fall * lead_rate, fall * rate
            step.beta1, step.beta2, step.epsilon = *BETAS, EPSILON
            step.share1, step.share2 = (1.0 - beta**done for beta in BETAS)
            arrays = [slopes, self._means[name], self._squares[name], values]
            flat = [array.flatten() for array in arrays]
            launch(fit.step_adam, values.size, [step, *flat], device=self.device)
        if self._first_scales is not None:
            values = self._parameters.values["log_scales"]
            inputs = [self._growth, self._first_scales.flatten()]
            launch(fit.hold_below, values.size, inputs, [values.flatten()], device=self.device)
