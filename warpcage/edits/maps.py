"""The maps and signed distances of edits on lattices, and points that edits move, such as vertices of a mesh."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike

from ..cage.cage import Cage
from ..coordinates.coordinates import deform_points
from ..core.arrays import empty_array
from ..core.checks import warn_caller
from ..core.devices import RecordedLaunches, launch
from ..core.modules import load_modules
from ..core.names import FIELD_COORDINATES, coordinate_kind
from ..errors import InputError
from ..field.sparse import spread_along
from ..kernels.edits import cell_tables, extension
from ..kernels.edits.structs import LatticeEdit
from ..kernels.lattice.cage_map import CageMap
from ..kernels.mesh import fans
from ..lattice.buffers import BufferPool
from ..lattice.lattice import CageLattice
from ..lattice.position_map import PositionMap
from ..mesh.queries import SURFACE_TOLERANCE
from ..mesh.validity import require_usable, size_problem
from .edits import CageEdit
from .falloff import FalloffBand, faded_map, folded_cells, has_sides, set_gap_remedies
from .fragments import CarriedFragments


def carried_points(
    points: np.ndarray,
    edits: Sequence[CageEdit],
    poses: Sequence[Cage | None],
    *,
    coordinates: str = FIELD_COORDINATES,
    device: wp.DeviceLike = None,
) -> np.ndarray:
    """Where edits move points (n, 3), float64: each moves those that the edits before it left in its cage.
    poses: the posed cages, one an edit. Edits that do anything but move are refused."""
    if any(edit.keep_source or edit.remove or edit.falloff or edit.fragments for edit in edits):
        raise InputError(
            "points follow edits that only move, one of these copies, removes, fades or takes fragments along: bake "
            "the field (warpcage bake) and take its surface"
        )
    places = np.array(points, dtype=np.float64)
    for edit, pose in zip(edits, poses, strict=True):
        if pose is None or np.array_equal(pose.vertices, edit.cage.vertices):
            continue
        surface = edit.cage.refined(coordinate_kind(coordinates).face_cells)
        inside = surface.contains(places, device=device)
        if inside.any():
            places[inside] = deform_points(places[inside], edit.cage, pose, coordinates, device=device)
    return places


#: How far the map may lead out of the rest cage before a sample counts as outside, in cells of the rest cage's lattice:
#: the trilinear signed distance errs by up to half a cell at corners.
LATTICE_SLACK = 0.5


class EditLattices:
    """The maps and signed distances of edits, in their order, on lattices, and tables of what holds for whole cells.
    resolution: cells along the longest side of each cage; bands, carried: one or None for each edit, () for none."""

    def __init__(
        self,
        edits: list[CageEdit],
        coordinates: str,
        resolution: int,
        origin: ArrayLike,
        device: wp.Device,
        store: str = "map",
        bands: Sequence[FalloffBand | None] = (),
        carried: Sequence[CarriedFragments | None] = (),
    ):
        self.edits, self.device, self.origin = edits, device, origin  # positions on the device are from there
        self._bands = list(bands) or [None] * len(edits)
        self.carried = list(carried) or [None] * len(edits)
        if any(self.carried):
            load_modules([extension, fans], device)
        self._plain: list[Any] = [None] * len(edits)
        self._faded: list[Any] = [None] * len(edits)
        self._walls: list[Any] = [None] * len(edits)
        self.rests = [CageLattice(edit.cage, resolution, origin=origin, device=device).measure() for edit in edits]
        self._rest_maps = [distance_map(rest) for rest in self.rests]
        options: dict[str, Any] = {
            "coordinates": coordinates,
            "resolution": resolution,
            "origin": origin,
            "device": device,
            "store": store,
        }
        self.maps = [None if edit.remove else PositionMap(edit.cage, **options).warm() for edit in edits]
        set_gap_remedies(self.maps, self._bands)
        self.skips: list[wp.array] = []  # (nx-1, ny-1, nz-1) uint8, cells to the nearest that may hold anything
        pool = BufferPool(device)  # poses differ in shape, and an allocation takes as long as a launch
        self._cell_buffers, self._skip_buffers = ([pool.buffer(wp.uint8) for _ in edits] for _ in range(2))
        self._mark_buffer, self._launch = pool.buffer(wp.uint8), RecordedLaunches(device)
        self._cells: list[wp.array] = []
        self._cages: list[Cage | None] = []
        self._structs: list[Any] = []
        self._laid: list[Any] | None = None  # the CageMap that each struct has, None where there are no structs
        self.array: wp.array | None = None  # (edits,) LatticeEdit, once posed
        self._array = empty_array(len(edits), LatticeEdit, device)
        self.marked_step, self._marked_skip = 0.0, None  # longest march step of `mark_empty`, world units; 0 before

    def pose(self, cages: Sequence[Cage | None]) -> None:
        """Compute the maps to the deformed cages, None for an edit that removes."""
        self.begin(cages)
        self.finish()

    def begin(self, cages: Sequence[Cage | None]) -> bool:
        """Start on the maps, so that the device is at work while the host goes on; `finish` comes after.
        Returns whether `posed` has them already: with arrays yet to be filled, without the sides of narrow gaps."""
        self._cages, self._structs, self._laid, self.array = list(cages), [], None, None
        for cage in cages:
            if cage is not None and (cage.size == 0.0 or size_problem(cage)):  # no lattice at all
                require_usable(cage, "the deformed cage")
        drafts = [
            None if position_map is None or cage is None else position_map.begin(cage)
            for position_map, cage in zip(self.maps, cages, strict=True)
        ]
        is_known = all(edit.remove or draft is not None for edit, draft in zip(self.edits, drafts, strict=True))
        if is_known and not any(self._bands) and not any(self.carried):
            self._lay_out(drafts)
        return self._laid is not None

    def finish(self) -> None:
        """Wait for the maps that were begun last, and settle what holds for their cells."""
        for cage in self._cages:  # by the host, while the device is at work
            if cage is not None:
                require_usable(cage, "the deformed cage")
        self._faded = [self._posed_map(index, cage) for index, cage in enumerate(self._cages)]
        maps = [self._extended_map(index, cage) for index, cage in enumerate(self._cages)]
        if self._laid is None or any(laid is not found for laid, found in zip(self._laid, maps, strict=True)):
            self._lay_out(maps)
        else:
            for struct, cage_map in zip(self._structs, maps, strict=True):
                if cage_map is not None and has_sides(cage_map):
                    struct.deformed.side_index, struct.deformed.sides = cage_map.side_index, cage_map.sides
        self.settle_cells()
        self._warn_of_folds(self._cages)

    def _lay_out(self, maps: Sequence[Any]) -> None:
        """Make the structs of the edits, with the arrays of their tables. maps: a CageMap each, None for an edit that
        removes."""
        self._structs = [
            posed_struct(edit, rest, cage_map, cage, fragments)
            for edit, rest, cage_map, cage, fragments in zip(
                self.edits, self._rest_maps, maps, self._cages, self.carried, strict=True
            )
        ]
        shapes = [cell_shape(struct.deformed) for struct in self._structs]
        self._cells = [buffer.take(shape) for buffer, shape in zip(self._cell_buffers, shapes, strict=True)]
        self.skips = [buffer.take(shape) for buffer, shape in zip(self._skip_buffers, shapes, strict=True)]
        for struct, cells, skip in zip(self._structs, self._cells, self.skips, strict=True):
            struct.cells, struct.skip = cells, skip
            self._mark_buffer.take(skip.shape)  # which `mark_empty` takes again
        self._laid = list(maps)

    def _posed_map(self, index: int, cage: Cage | None) -> Any:
        """The CageMap of a posed edit, faded where it has a band. None for an edit that removes."""
        position_map, band = self.maps[index], self._bands[index]
        if position_map is None or cage is None:
            return None
        data = self._plain[index] = position_map.finish().data
        if band is None:
            return data
        walls = self._walls[index] = band.on_device(cage, self.origin, self.device)
        return faded_map(data, walls, self._faded[index])

    def _extended_map(self, index: int, cage: Cage | None) -> Any:
        """The map, on a lattice that reaches as far as the edit's fragments where it has any."""
        carried, faded = self.carried[index], self._faded[index]
        if carried is None or cage is None:
            return faded
        return carried.extended(cage, self._plain[index], faded, self._walls[index])

    def _warn_of_folds(self, cages: Sequence[Cage | None]) -> None:
        """Warn where a band is too narrow for its pose: where it folds matter over, which the map alone does not."""
        for index, (edit, cells) in enumerate(zip(self.edits, self._cells, strict=True)):
            band, carried = self._bands[index], self.carried[index]
            if band is None:
                continue
            flags = cells.numpy()
            if carried is not None:
                flags = carried.inner(flags, cell_shape(self._faded[index]))
            faded = folded_cells(flags)
            if not faded.any():
                continue
            plain = posed_struct(edit, self._rest_maps[index], self._plain[index], cages[index])
            plain.cells = empty_array(faded.shape, wp.uint8, self.device)
            plain.skip = plain.cells
            launch(cell_tables.mark_edit_cases, faded.size, [plain], [plain.cells], device=self.device)
            folded = np.argwhere(faded & ~folded_cells(plain.cells.numpy()))
            if band.has_matter(self._faded[index].positions.numpy()[tuple(folded.T)] + self.origin):
                warn_caller(
                    f"edit {index} turns the object inside out in its falloff band of {edit.falloff:.3g}: make the "
                    "band wider, or move the cage less"
                )

    def settle_cells(self) -> None:
        """Make the tables of the posed maps anew, of what holds for whole cells."""
        for number, struct in enumerate(self._structs):
            self._launch(cell_tables.mark_edit_cases, struct.cells.size, [struct], [struct.cells], number=number)
        for struct, carried in zip(self._structs, self.carried, strict=True):
            if carried is not None and not struct.removes:
                carried.mark(struct, struct.cells)
        # the structs stay, as they own what the array on the device points to
        for number, struct in enumerate(self._structs):
            self._launch(cell_tables.keep_edit, 1, [struct, number], [self._array], number=number)
        self.array = self._array
        for index, struct in enumerate(self._structs if len(self._structs) > 1 else []):
            if not struct.removes:
                inputs = [self.array, index]
                launch(cell_tables.mark_alone_cells, struct.cells.size, inputs, [struct.cells], device=self.device)
        self.marked_step = 0.0

    def mark_empty(self, grid: Any, step: float) -> bool:
        """Find the cells that a march by `step`, world units, through the deformed grid may skip.
        Returns whether it did: not again for the same pose, the same matter and no longer step."""
        if step <= self.marked_step and grid.skip is self._marked_skip:
            return False
        self.marked_step = 0.0  # an interrupt leaves tables that are half written
        for index, skip in enumerate(self.skips):  # in order: each looks at the ones before it
            marks = self._mark_buffer.take(skip.shape)
            inputs = [grid, self.array, index, step]
            self._launch(cell_tables.mark_edit_cells, skip.size, inputs, [marks], number=index)
            source, target = marks, skip
            for axis in range(3):
                spread_along(axis, source, target, functools.partial(self._launch, number=3 * index + axis))
                source, target = target, source
        self.marked_step, self._marked_skip = step, grid.skip
        return True

    def rest_maps(self) -> list[Any]:
        """A CageMap of each rest cage, which holds signed distances only."""
        return self._rest_maps

    def posed(self) -> list[tuple[Any, wp.array]]:
        """The LatticeEdit of each posed edit, and the array in which `mark_empty` leaves what may be skipped."""
        return list(zip(self._structs, self.skips, strict=True))


def posed_struct(
    edit: CageEdit, rest: Any, deformed: Any, cage: Cage | None, carried: CarriedFragments | None = None
) -> Any:
    """The LatticeEdit of an edit, without its tables of cells. rest, deformed: the CageMaps of its rest cage, which
    holds distances, and of its posed cage; deformed and cage are None for an edit that removes."""
    struct = LatticeEdit()
    struct.rest = rest
    struct.deformed = rest if deformed is None else deformed
    struct.tolerance = SURFACE_TOLERANCE * (edit.cage if cage is None else cage).size
    struct.slack = LATTICE_SLACK * rest.spacing
    struct.keeps_source, struct.removes = int(edit.keep_source), int(edit.remove)
    if carried is not None:
        struct.fragments = carried.cells
    return struct


def distance_map(lattice: CageLattice) -> Any:
    """A CageMap that holds the distances of a lattice only."""
    data = CageMap()
    data.lower = lattice.local_lower
    data.spacing = lattice.spacing
    data.inverse_spacing = 1.0 / lattice.spacing
    data.distance = lattice.distance
    return data


def cell_shape(cage_map: Any) -> tuple[int, ...]:
    """Number of cells of a CageMap along each axis."""
    return tuple(side - 1 for side in cage_map.distance.shape)
