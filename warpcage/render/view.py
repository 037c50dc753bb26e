"""A view of an edited scene as it is asked for, and what everything that renders one offers."""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.checks import MOST_SAMPLES
from ..core.devices import RecordedLaunches
from ..errors import InputError
from ..field.voxel_field import VoxelField


@dataclasses.dataclass(frozen=True)
class ViewRequest:
    """A view that edits are to be marched for."""

    field: VoxelField
    grid: Any  # its VoxelGrid as it is marched now
    rows: list[Any]  # what `PosedEdits.row_tables` gave
    pinhole: Any  # the PinholeCamera, relative to the field's origin
    background: wp.vec3
    options: Any  # the MarchOptions, and the Picture that is filled
    picture: Any
    threads: int  # rays, in whole tiles
    work: float  # steps that a ray may take, as `core.devices.launch` has them


class PosedEdits(abc.ABC):
    """Edits on a device, as kernels take them."""

    def __init__(self, map_kernel: Any, render_kernel: Any):
        self.map_kernel, self.render_kernel = map_kernel, render_kernel  # they take `array`, and for views `scene`
        self.array: wp.array | None = None  # (edits,) structs, once the edits are posed
        self.scene: Any = None  # what the render kernel takes, once `prepare` has been called for the pose
        self.sample_work = 1  # steps that one sample takes at most, as `core.devices.launch` has them
        self._launches: RecordedLaunches | None = None

    def begin_view(self, field: VoxelField, center: wp.vec3, step: float) -> None:
        """Start on what a view takes of the pose alone, so that the device is at work as early as can be.
        center: of the camera, relative to the field's origin; step: of the march, world units."""
        return

    def row_tables(self, field: VoxelField, center: wp.vec3, step: float) -> list[Any]:
        """Start on what the render kernel takes of a field beside its VoxelGrid, before that is waited for; behind
        `begin_view`. Returns arguments of the kernel; none where `render` is to find them."""
        return []

    def render(self, view: ViewRequest) -> None:
        """March a view, once `prepare` has been called for the pose."""
        self.march(view, self.render_kernel, [self.scene])

    def march(
        self,
        view: ViewRequest,
        kernel: Any,
        scene: Sequence[Any],
        item_rays: int = 1,
        order: Any = None,
        begins: wp.array | None = None,
        number: int = 0,
    ) -> None:
        """Launch a kernel, of items of `item_rays` rays, that marches a view; `scene` goes between tables and camera.
        order: TileOrder, None as tiles lie; begins: (tiles,) distances before which rays meet nothing, or None."""
        if order is not None:
            view.picture.order = order
        if begins is not None:
            view.picture.begins = begins
        end = [view.pinhole, view.background, view.options, view.picture]
        inputs = [view.grid, *view.rows, *scene, *end]
        work = view.work * self.sample_work * item_rays
        if self._launches is None:
            self._launches = RecordedLaunches(view.field.device)
        self._launches(kernel, view.threads // item_rays, inputs, number=number, transient=len(end), work=work)

    @abc.abstractmethod
    def pose(self, cages: Sequence[Cage | None]) -> None:
        """Compute what kernels need of a pose; cages: in the order of the edits, None for an edit that removes."""

    @abc.abstractmethod
    def prepare(self, grid: Any, step: float) -> None:
        """Find the cells of a VoxelGrid that a march by `step`, world units, may skip, once per pose."""


class SeenView(NamedTuple):
    """What the tables of a pose take of the views of it."""

    field: VoxelField
    grid: Any  # its VoxelGrid as it was marched
    center: wp.vec3  # of the camera, relative to the field's origin
    step: float  # of the march, world units


def cage_span(cage: Cage | None) -> float:
    """The diagonal of the box around a posed cage, world units; 0 for None, an edit that removes."""
    return 0.0 if cage is None else float(np.linalg.norm(np.ptp(cage.bounds, axis=0)))


def require_short_march(spans: Sequence[float], step: float) -> None:
    """Refuse posed cages, of these spans, through which a march of this step, both world units, would take all day."""
    for index, size in enumerate(spans):
        if size > MOST_SAMPLES * step:
            raise InputError(
                f"the posed cage of edit {index} is {size:.3g} across, {size / step:.3g} march steps of {step:.3g}: "
                f"make it smaller, or the step at least {size / MOST_SAMPLES:.3g}"
            )
