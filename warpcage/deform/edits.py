"""Edits of a scene, and what renderers and kernels take of them once they are posed."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from ..cage.cage import Cage
from ..core.checks import checked_number
from ..core.devices import RepeatedLaunches
from ..field.voxel_field import VoxelField
from ..mesh.validity import require_usable

#: Walls that a falloff may hold: those that cut matter, and those that a pose leaves in place.
HELD = ("cut", "still")

#: Edits of one scene; the way of a sample through them is kept in the bits of an int.
MAX_EDITS = 31


@dataclasses.dataclass(frozen=True)
class CageEdit:
    """One edit of a scene: what is in `cage` goes where the posed cage is.

    Args:
        cage: The cage at rest.
        keep_source: Leave a copy where it was (a duplicate).
        remove: Draw nothing in its place: it is deleted, and needs no pose.
        falloff: Width of the band inside held walls in which the edit fades to rest, world units: so that a part which
            the cage cuts off does not tear. 0 holds no wall.
        held: The walls that a falloff holds: "cut", the faces of the cage that cut matter; "still", those whose
            vertices a pose leaves in place; or the numbers of the faces.
        crumbs: Pieces of matter outside the cage that its wall cuts off the part, and that are smaller than this
            (diagonal of their box, world units), go with the part, by the map continued beyond the wall, instead of
            floating where they were. 0 leaves all where it is.

    Raises:
        ValueError: For keeping and removing at once, a cage that cannot be used, a falloff that is no width or goes
            with removing, or walls that are not there.
    """

    cage: Cage
    keep_source: bool = False
    remove: bool = False
    falloff: float = 0.0
    held: str | tuple[int, ...] = "cut"
    crumbs: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.cage, Cage):
            raise ValueError(f"an edit needs a Cage, got {type(self.cage).__name__}")
        if self.keep_source and self.remove:
            raise ValueError("an edit that removes its cage's content cannot keep the source: choose one")
        require_usable(self.cage, "the rest cage")
        object.__setattr__(self, "falloff", checked_number(self.falloff, "the falloff of an edit"))
        if self.falloff < 0.0:
            raise ValueError(f"the falloff of an edit must be a width, 0 or more, got {self.falloff}")
        if self.falloff > 0.0 and self.remove:
            raise ValueError("an edit that removes its cage's content has no pose to fade: leave the falloff out")
        object.__setattr__(self, "crumbs", checked_number(self.crumbs, "the crumbs of an edit"))
        if self.crumbs < 0.0:
            raise ValueError(f"the crumbs of an edit must be a size, 0 or more, got {self.crumbs}")
        object.__setattr__(self, "held", checked_walls(self.held, len(self.cage.faces)))


def checked_walls(held: Any, face_count: int) -> str | tuple[int, ...]:
    """The walls that an edit holds: "cut", "still", or numbers of faces as an ascending tuple."""
    if isinstance(held, str):
        if held not in HELD:
            raise ValueError(f"held must be {' or '.join(map(repr, HELD))} or numbers of faces, got {held!r}")
        return held
    faces = np.asarray(held)
    if faces.ndim != 1 or not len(faces) or faces.dtype.kind not in "iu":
        raise ValueError(f"held must be {' or '.join(map(repr, HELD))} or numbers of faces, got {str(held)[:60]}")
    if faces.min() < 0 or faces.max() >= face_count:
        raise ValueError(f"held names face {faces.max()}, the cage has faces 0 to {face_count - 1}")
    return tuple(int(face) for face in np.unique(faces))


def checked_edits(rest: Cage | CageEdit | Sequence[Cage | CageEdit]) -> list[CageEdit]:
    """The edits of a scene, in the order in which they act."""
    given: list[Any] = list(rest) if isinstance(rest, list | tuple) else [rest]
    edits = [edit if isinstance(edit, CageEdit) else CageEdit(edit) for edit in given]
    if not 1 <= len(edits) <= MAX_EDITS:
        raise ValueError(f"a Deformer takes 1 to {MAX_EDITS} edits, got {len(edits)}")
    return edits


@dataclasses.dataclass(frozen=True)
class MarchedView:
    """A view that edits are to be marched for."""

    field: VoxelField
    # its VoxelGrid as it is marched now
    grid: Any
    # what `PosedEdits.row_tables` gave
    rows: list[Any]
    # the PinholeCamera, relative to the field's origin
    pinhole: Any
    background: wp.vec3
    # the MarchOptions, and the Picture that is filled
    options: Any
    picture: Any
    # rays, in whole tiles
    threads: int
    # steps that a ray may take, as `core.devices.launch` has them
    work: float


class PosedEdits(abc.ABC):
    """Edits on a device, as kernels take them."""

    def __init__(self, map_kernel: Any, render_kernel: Any):
        # the first traces points to canonical space and takes `array`, the other renders views and takes `scene`
        self.map_kernel, self.render_kernel = map_kernel, render_kernel
        # (edits,) structs, once the edits are posed
        self.array: wp.array | None = None
        # what the render kernel takes, once `prepare` has been called for the pose
        self.scene: Any = None
        # steps that one sample takes at most, as `core.devices.launch` has them
        self.sample_work = 1
        self._launches: RepeatedLaunches | None = None

    def begin_view(self, field: VoxelField, centre: wp.vec3, step: float) -> None:
        """Start on what a view takes of the pose alone, so that the device is at work as early as can be.
        centre: of the camera, relative to the field's origin; step: of the march, world units."""
        return

    def row_tables(self, field: VoxelField, centre: wp.vec3, step: float) -> list[Any]:
        """Start on what the render kernel takes of a field beside its VoxelGrid, before that is waited for; behind
        `begin_view`. Returns arguments of the kernel; none where `render` is to find them."""
        return []

    def render(self, view: MarchedView) -> None:
        """March a view, once `prepare` has been called for the pose."""
        self.march(view, self.render_kernel, [self.scene])

    def march(
        self,
        view: MarchedView,
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
            self._launches = RepeatedLaunches(view.field.device)
        self._launches(kernel, view.threads // item_rays, inputs, number=number, passing=len(end), work=work)

    @abc.abstractmethod
    def pose(self, cages: Sequence[Cage | None]) -> None:
        """Compute what kernels need of a pose; cages: in the order of the edits, None for an edit that removes."""

    @abc.abstractmethod
    def prepare(self, grid: Any, step: float) -> None:
        """Find the cells of a VoxelGrid that a march by `step`, world units, may skip, once per pose."""
