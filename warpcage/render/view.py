"""The interface of posed edits that render views, and what a pose remembers of a view."""

import abc
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.checks import MAX_SAMPLES
from ..core.devices import HeldOnDevice
from ..errors import InputError
from ..field.render import FieldView
from ..field.voxel_field import VoxelField
from ..view.frame import Frame


class PosedEdits(HeldOnDevice, abc.ABC):
    """Edits on a device, as kernels take them."""

    map_kernel: Callable[[], Any]  # declares the kernel that maps points by `array`
    array: wp.array | None  # (edits,) structs, once the edits are posed
    sample_work = 1  # steps that one sample takes at most, as `core.devices.launch` has them

    @abc.abstractmethod
    def pose(self, cages: Sequence[Cage | None]) -> None:
        """Compute what kernels need of a pose; cages: in the order of the edits, None for an edit that removes."""

    @abc.abstractmethod
    def prepare(self, grid: Any, step: float) -> None:
        """Find the cells of a VoxelGrid that a march by `step`, world units, may skip, once per pose."""

    @abc.abstractmethod
    def render(self, view: FieldView, arc_opacity: int) -> Frame:
        """The frame of a view of the pose; arc_opacity: as `frame_target` has it."""


class SeenView(NamedTuple):
    """What the tables of a pose depend on in a view."""

    field: VoxelField
    grid: Any  # its VoxelGrid as it was marched
    center: wp.vec3  # of the camera, relative to the field's origin
    step: float  # of the march, world units


def cage_span(cage: Cage | None) -> float:
    """The diagonal of the box around a posed cage, world units; 0 for None, an edit that removes."""
    return 0.0 if cage is None else float(np.linalg.norm(np.ptp(cage.bounds, axis=0)))


def require_short_march(spans: Sequence[float], step: float) -> None:
    """Refuse posed cages of these spans that need too many steps of this length, both world units."""
    for index, size in enumerate(spans):
        if size > MAX_SAMPLES * step:
            raise InputError(
                f"the posed cage of edit {index} is {size:.3g} across, {size / step:.3g} march steps of {step:.3g}: "
                f"make it smaller, or the step at least {size / MAX_SAMPLES:.3g}"
            )
