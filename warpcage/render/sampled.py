"""SampledField: any other representation as a function of points and directions, and its pictures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import as_given, as_numbers, as_points, empty_array
from ..core.checks import MAX_SAMPLES, checked_bounds, checked_march, checked_step, require_ordinary_side
from ..core.devices import launch, resolve_device
from ..core.threads import in_turn
from ..errors import InputError, UseError
from ..field.render import RenderOptions, RenderTarget, View
from ..kernels.render import samples
from ..view.camera import Camera, camera_struct
from ..view.frame import PART_NAMES, Frame, parse_background

if TYPE_CHECKING:
    from typing_extensions import Self  # of the type checker

#: Takes points (n,) vec3, world units, and directions (n,) vec3 on the field's device; returns colours (n, 3) and
#: densities (n,) per world unit, as arrays of any library.
SampleFunction = Callable[[Any, Any], tuple[Any, Any]]

#: Default number of steps along the diagonal of a field.
DEFAULT_STEPS = 512

#: Samples of one call of a field's function, but for a ray of more.
MAX_AT_ONCE = 1 << 20


class SampledField:
    """A radiance field of any other representation: a function that gives colour and density at points.

    `Deformer(SampledField(function, bounds), cage)` poses it as it poses voxels: `render`, `sample`, `to_canonical`,
    several edits, poses of threads. Frames have no masks. Falloff and fragments of edits, baking and stages need
    voxels.

    References: the samples of a picture are packed ray after ray, as in Li et al., "NerfAcc" (ICCV 2023).
    Limitations: the function is called for every step inside the bounds, as it may be empty nowhere; it has no backward
    pass.

    Example::

        def ball(points, directions):
            x = points.numpy()  # or torch.from_dlpack(points), or a Warp kernel that takes them as they are
            return np.full((len(x), 3), 0.5), np.where(np.linalg.norm(x, axis=1) < 0.5, 60.0, 0.0)

        field = SampledField(ball, [[-1, -1, -1], [1, 1, 1]])
        cage = Cage.box((-0.7, -0.7, -0.7), (0.7, 0.7, 0.7))
        Deformer(field, cage).pose(cage.twist(60)).render(camera)

    Args:
        function: Called with points (n,) wp.vec3, world units, and unit directions (n,) wp.vec3 from the camera into
            the scene, Warp arrays on `device`, which other libraries read as (n, 3) without a copy. It returns colours
            (n, 3), and densities (n,) per world unit, of 0 or more, as arrays of any library. float32 on the device is
            not copied. What it raises passes through to the caller.
        bounds: (2, 3) lower and upper corner, world units, outside of which the field is empty.
        step: March step and step of finite differences, world units. None is 1/512 of the diagonal of the bounds.
        background: Colour behind the field, a name or (3,) in [0, 1].
        device: Warp device. None is CUDA where there is one.

    Raises:
        ValueError: For a function that cannot be called, bounds whose longest side is not 1e-9 to 1e9 units, or a step
            that is not positive and finite.

    Attributes:
        function: The function.
        bounds: (2, 3) float64, read-only, world units.
        step: March step, world units.
        background: (3,) float32 colour behind the field.
        device: Warp device.
    """

    def __init__(
        self,
        function: SampleFunction,
        bounds: ArrayLike,
        *,
        step: float | None = None,
        background: str | ArrayLike = "white",
        device: wp.DeviceLike = None,
    ):
        if not callable(function):
            raise InputError(f"a SampledField needs a function of points and directions, got {type(function).__name__}")
        self.function: SampleFunction = function
        self.bounds: np.ndarray = checked_bounds(bounds)
        require_ordinary_side(float((self.bounds[1] - self.bounds[0]).max()), "a field")
        self.step: float = checked_step(step, math.dist(*self.bounds) / DEFAULT_STEPS)
        self.background: np.ndarray = parse_background(background)
        self.device: wp.Device = resolve_device(device)

    @property
    def center(self) -> np.ndarray:
        """(3,) float64 middle of the bounds: the origin that kernels' positions are relative to."""
        return self.bounds.mean(axis=0)

    def __repr__(self) -> str:
        name = getattr(self.function, "__name__", type(self.function).__name__)
        return f"SampledField({name}, bounds {np.round(self.bounds, 4).tolist()}, {self.device})"

    def __reduce__(self):
        raise UseError("a SampledField asks a function of its process, which is not copied: make one in each of them")

    def to(self, device: wp.DeviceLike) -> Self:
        """The field on another device; itself where it is there.

        Args:
            device: Warp device, on which the function gets its points then.

        Returns:
            The field.
        """
        device = resolve_device(device)
        if device == self.device:
            return self
        options = {"step": self.step, "background": self.background, "device": device}
        return type(self)(self.function, self.bounds, **options)

    @in_turn
    def sample(self, points: Any, directions: Any) -> tuple[Any, Any]:
        """Colour and density at points.

        Args:
            points: (n, 3), world units. NumPy, Warp or any DLPack array (docs/arrays.md).
            directions: (n, 3), from the camera into the scene.

        Returns:
            Colours (n, 3) and densities (n,) per world unit, float32, as arrays of the points' kind on their device.

        Raises:
            ValueError: For shapes that are not (n, 3) or differ, and where the function returns other shapes.
        """
        x, d = as_points(points, self.device), as_points(directions, self.device, name="directions")
        if x.shape != d.shape:
            raise InputError(f"there must be as many directions as points, got {d.shape[0]} for {x.shape[0]}")
        if not x.size:
            return as_given(x, points), as_given(empty_array(0, wp.float32, self.device), points)
        found = self.function(x, d)
        if not isinstance(found, tuple | list) or len(found) != 2:
            raise InputError(f"the function of a field must return colours and densities, got {type(found).__name__}")
        rgb = as_points(found[0], self.device, name="colours of a field")
        if rgb.shape != x.shape:
            raise InputError(f"the function of a field must return {len(x)} colours, got {len(rgb)}")
        density = as_numbers(found[1], len(x), self.device, name="densities of a field")
        return as_given(rgb, points), as_given(density, points)


def render_samples(
    sample: Callable[[wp.array, wp.array, float], tuple[wp.array, wp.array]],
    field: SampledField,
    bounds: np.ndarray,
    camera: Camera,
    options: RenderOptions,
    target: RenderTarget,
) -> Frame:
    """The view of a camera of what `sample` returns for points, directions and a step; bounds: (2, 3) world units."""
    device, origin = field.device, field.center
    view = View(camera, options, options.color(field.background), 1, device, target)
    diagonal = math.dist(*bounds)
    step = checked_march(options.step, field.step, diagonal, math.dist(camera.center, bounds.mean(axis=0)))
    pinhole, count = camera_struct(view.rays, origin), view.rays.width * view.rays.height
    arrays = view.new_arrays()
    begins, counts = empty_array(count, wp.float32, device), empty_array(count, wp.int32, device)
    box = [wp.vec3(*corner) for corner in (bounds - origin).tolist()]
    launch(samples.count_samples, count, [pinhole, *box, step], [begins, counts], device=device)
    ends, ray = np.cumsum(counts.numpy(), dtype=np.int64), 0
    work = min(diagonal / step, MAX_SAMPLES)
    while ray < count:
        before = int(ends[ray - 1]) if ray else 0
        last = max(int(np.searchsorted(ends, before + MAX_AT_ONCE, side="right")), ray + 1)
        local = wp.array((ends[ray:last] - before).astype(np.int32), dtype=wp.int32, device=device)
        total = int(ends[last - 1]) - before
        points, directions = (empty_array(total, wp.vec3, device) for _ in range(2))
        inputs = [pinhole, ray, step, wp.vec3(*origin), begins, local]
        launch(samples.place_samples, last - ray, inputs, [points, directions], device=device, work=work)
        rgb, density = sample(points, directions, step)
        inputs = [ray, step, wp.vec3(*view.color.tolist()), begins, local, rgb, density]
        launch(
            samples.composite_samples,
            last - ray,
            inputs,
            [arrays[name] for name in PART_NAMES],
            device=device,
            work=work,
        )
        ray = last
    return view.finished(arrays)
