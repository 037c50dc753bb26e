"""What all renderers share: the options of a frame, a checked view, the arrays of its picture, and the last steps."""

from __future__ import annotations

import dataclasses
import inspect
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypedDict

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..core.arrays import array_view, empty_array
from ..core.checks import Decorated, checked_positive, require_type
from ..core.devices import SpareMemory
from ..core.names import MAX_SUPERSAMPLING, TRANSPARENT
from ..core.spec import Values, checkers, flag, option, options_of, positive, whole
from ..errors import UseError
from ..view.camera import Camera, tile_threads
from ..view.frame import PART_NAMES, Frame, average_frame, finer_camera, is_transparent, part_type, view_background

if TYPE_CHECKING:
    from typing_extensions import Self  # of the type checker

    from .voxel_field import VoxelField

#: A march ends where less than this share of the light is left.
STOP_TRANSMITTANCE = 1e-3


@dataclasses.dataclass(frozen=True, eq=False)
class RenderOptions:
    """How a frame is rendered. A new option takes a field here, and one in a `RenderKeywords`; `View` reads it."""

    background: str | ArrayLike | None = option(
        None,
        Values(lambda value, _: view_background(value)),
        'Colour behind the scene, a name or (3,) in [0, 1], or "transparent". None is the field\'s own, its background '
        "model where it has one; of a stage the first such model, or else the first object's colour. Opacity, depth "
        "and disparity are those of the field whatever is behind it.",
    )
    supersampling: int | None = option(
        None,
        whole(1, MAX_SUPERSAMPLING),
        "Rays along each side of a pixel, 1 to 8. None is the field's own number, one for splats and sampled fields; "
        "of a stage the largest of its objects' own.",
    )
    antialias: bool | None = option(
        None,
        flag(),
        "Splats only: weaken those that the blur of the picture makes larger (Mip-Splatting), for fields that were "
        "fitted in that way. Others get thinner where they are far away. None is the field's own.",
    )
    step: float | None = option(
        None,
        Values(lambda value, _: checked_positive(value, "the march step")),
        "Voxels and sampled fields only: march step, world units, at least 1e-5 of the diagonal of `bounds`. None is "
        "the field's.",
    )
    step_scale: float = option(
        1.0, positive(), "Voxels only: factor on the march step, above 0. More than 1 is faster and coarser."
    )
    fill: bool = option(
        False, flag(), "Voxels only: fill what an edit uncovers and no picture showed, see `fill_unseen`."
    )

    def __post_init__(self) -> None:
        for name, check in checkers(RenderOptions).items():
            value = getattr(self, name)
            if value is not getattr(RenderOptions, name):  # the default
                check(value, name)

    def of_object(self) -> Self:
        """The options of the picture of one object, which is composited with those of others."""
        return dataclasses.replace(self, background=TRANSPARENT, supersampling=1, fill=False)

    @property
    def is_transparent(self) -> bool:
        """Whether pictures have opacity instead of a background."""
        return is_transparent(self.background)

    def color(self, default: np.ndarray) -> np.ndarray:
        """(3,) float32 colour behind the picture."""
        return default if self.background is None else view_background(self.background)


#: The options of a frame that leaves all open.
DEFAULT_OPTIONS = RenderOptions()


class RenderKeywords(TypedDict, total=False):
    """The options that all `render` methods take by keyword."""

    background: str | ArrayLike | None
    supersampling: int | None


class VoxelKeywords(RenderKeywords, total=False):
    """What `VoxelField.render` takes."""

    step: float | None


class SplatKeywords(RenderKeywords, total=False):
    """What `SplatField.render` takes."""

    antialias: bool | None


class PoseKeywords(VoxelKeywords, SplatKeywords, total=False):
    """What a Deformer takes."""


class StageKeywords(SplatKeywords, total=False):
    """What `Stage.render` takes."""

    step_scale: float


def render_options(options: Mapping[str, Any], keywords: type) -> RenderOptions:
    """The options that a method was called with. keywords: a RenderKeywords that has all of them."""
    known = keywords.__annotations__
    if not options.keys() <= known.keys():
        unknown = next(name for name in options if name not in known)
        raise UseError(f"render got an unexpected keyword argument {unknown!r}: it takes {', '.join(known)}")
    return RenderOptions(**options) if options else DEFAULT_OPTIONS


def takes_options(keywords: type) -> Callable[[Decorated], Decorated]:
    """Decorates a method with these keywords: its signature and docstring have them in place of **options."""
    options = {name: each for name, each in options_of(RenderOptions).items() if name in keywords.__annotations__}
    texts = [f"    {name}: {each.help}" for name, each in options.items()]
    lines = "".join("\n" + textwrap.fill(text, 108, subsequent_indent=8 * " ") for text in texts)
    types = {name: getattr(kind, "__forward_arg__", kind) for name, kind in keywords.__annotations__.items()}

    def decorate(method: Any) -> Any:
        if method.__doc__ is not None:  # as it is with `python -OO`
            entry = re.compile(r"\n    options: .*(\n {8}.*)*")
            method.__doc__ = entry.sub(lambda found: lines, inspect.cleandoc(method.__doc__))
        signature = inspect.signature(method)
        *given, _ = signature.parameters.values()  # the last is **options
        by_name = [
            inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=getattr(RenderOptions, name), annotation=types[name]
            )
            for name in options
        ]
        method.__signature__ = signature.replace(parameters=[*given, *by_name])
        return method

    return decorate


class RenderTarget(NamedTuple):
    """Where a frame is rendered to."""

    arrays: dict[str, wp.array] | None = None  # (h * w,) each, by the names of the frame's parts; None makes new ones
    is_again: bool = False  # whether a view of the same call came before: densities are as it found them


#: A frame of its own, in new arrays.
NEW_TARGET = RenderTarget()


class View:
    """A checked view of a camera, as all renderers begin and finish it."""

    names: Sequence[str] = PART_NAMES  # of its arrays
    spare: SpareMemory | None = None

    def __init__(
        self,
        camera: Camera,
        options: RenderOptions,
        color: np.ndarray,  # (3,) behind the picture
        side: int,  # rays along each side of a pixel where the options leave that open
        device: wp.Device,
        target: RenderTarget = NEW_TARGET,
    ):
        require_type(camera, Camera, "render needs")
        self.camera, self.options, self.color, self.device, self.target = camera, options, color, device, target
        self.side = side if options.supersampling is None else int(options.supersampling)
        self.rays = finer_camera(camera, self.side)  # with a pixel for each ray

    def new_arrays(self) -> dict[str, wp.array]:
        """Arrays (rays,) for a renderer to fill, by the names of a Frame's parts and masks."""
        if self.target.arrays is not None and self.side == 1:
            return self.target.arrays
        return picture_arrays(self.rays.width * self.rays.height, self.names, self.device, self.spare)

    def finished(self, arrays: dict[str, wp.array], *, is_layered: bool = False) -> Frame:
        """The frame of rendered arrays: rays averaged to pixels. is_layered: a model of a scene is behind it."""
        frame = average_frame(Frame(self.rays.width, self.rays.height, **arrays), self.side, self.target.arrays)
        return frame.seen_by(self.camera, None if is_layered else self.color, self.options.background)


class FieldView(View):
    """A checked view of a field of voxels, with these masks."""

    def __init__(
        self,
        field: VoxelField,
        camera: Camera,
        options: RenderOptions,
        masks: Sequence[str] = (),
        target: RenderTarget = NEW_TARGET,
    ):
        step = options.step if options.step_scale == 1.0 else options.step_scale * (options.step or field.step)
        # of the march, world units; and the steps that a ray may take, as `core.devices.launch` has them
        self.step, self.work = field.march_step(step, camera)
        color, self.layers = field.chosen_background(options.background)  # black where there are layers
        super().__init__(camera, options, color, field.supersampling, field.device, target)
        self.field, self.masks, self.names, self.spare = field, masks, (*PART_NAMES, *masks), field.marching.spare
        self.center = wp.vec3(*(camera.center - field.center).tolist())  # of the camera, from the field's origin

    @property
    def threads(self) -> int:
        """Rays, in whole tiles."""
        return tile_threads(self.rays)

    def finished(self, arrays: dict[str, wp.array], *, is_layered: bool = False) -> Frame:
        """The frame of a marched view: adds what is around the field."""
        if self.layers is not None:
            dimmed = [arrays[name] for name in self.masks]
            self.layers.add_around(self.rays, arrays["rgb"], arrays["alpha"], arrays["depth"], dimmed)
        return super().finished(arrays, is_layered=self.layers is not None)


def picture_arrays(
    count: int, names: Sequence[str], device: wp.Device, spare: SpareMemory | None = None
) -> dict[str, wp.array]:
    """Arrays (count,) of a picture by names of a Frame's parts, of their `part_type`."""
    widths = [wp.types.type_size(part_type(name)) for name in names]
    block = empty_array((sum(widths), count), wp.float32, device)  # at once: on a GPU one takes as long as a launch
    if spare is not None:
        spare.keep(block.capacity)
    arrays, begin = {}, 0
    for name, width in zip(names, widths, strict=True):
        arrays[name] = array_view(block, part_type(name), count, offset=4 * begin)
        begin += count * width
    return arrays
