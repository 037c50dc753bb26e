"""CageEdit: a cage, what its pose does to the scene, and checks of several of them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..cage.cage import Cage
from ..core.checks import checked_flag, checked_number, renamed, warn_renamed
from ..errors import InputError
from ..mesh.validity import require_usable
from ..view.camera import Camera
from .spec import EditSpec

#: Walls that a falloff may hold: those that cut matter, and those that a pose leaves in place.
HELD = ("cut", "still")

#: Most edits of a scene: the path of a sample through them is kept in the bits of an int.
MAX_EDITS = 31


@renamed(fragments="crumbs")
@dataclasses.dataclass(frozen=True)
class CageEdit:
    """One edit of a scene: what is in `cage` goes where the posed cage is.

    Args:
        cage: The cage at rest.
        keep_source: Leave a copy where it was (a duplicate).
        remove: Draw nothing in its place: it is deleted, and needs no pose.
        falloff: Width of the band inside held walls in which the edit fades to rest, world units, so that a part that
            the cage cuts does not tear off. 0 holds no wall.
        held: The walls that a falloff holds: "cut", the faces of the cage that cut matter; "still", those whose
            vertices a pose leaves in place; or the numbers of the faces.
        fragments: Largest diagonal, world units, of pieces of matter that the wall of the cage cuts off and that move
            with the part, by the map continued beyond the wall, instead of floating in place. 0 moves none.

    Raises:
        ValueError: For keeping and removing at once, a cage that cannot be used, a falloff that is no width or goes
            with removing, or walls that are not there.
    """

    cage: Cage
    keep_source: bool = False
    remove: bool = False
    falloff: float = 0.0
    held: str | tuple[int, ...] = "cut"
    fragments: float = 0.0

    @property
    def crumbs(self) -> float:
        """The old name of `fragments`, for one release."""
        warn_renamed("CageEdit.crumbs", "fragments")
        return self.fragments

    def __post_init__(self) -> None:
        if not isinstance(self.cage, Cage):
            raise InputError(f"an edit needs a Cage, got {type(self.cage).__name__}")
        for name in ("keep_source", "remove"):
            object.__setattr__(self, name, checked_flag(getattr(self, name), name))
        if self.keep_source and self.remove:
            raise InputError("an edit that removes its cage's content cannot keep the source: choose one")
        require_usable(self.cage, "the rest cage")
        object.__setattr__(self, "falloff", checked_number(self.falloff, "the falloff of an edit"))
        if self.falloff < 0.0:
            raise InputError(f"the falloff of an edit must be a width, 0 or more, got {self.falloff}")
        if self.falloff > 0.0 and self.remove:
            raise InputError("an edit that removes its cage's content has no pose to fade: leave the falloff out")
        object.__setattr__(self, "fragments", checked_number(self.fragments, "the fragments of an edit"))
        if self.fragments < 0.0:
            raise InputError(f"the fragments of an edit must be a size, 0 or more, got {self.fragments}")
        object.__setattr__(self, "held", checked_walls(self.held, self.cage.face_count))


def refined_edit(edit: CageEdit, cells: int) -> CageEdit:
    """An edit by the triangles of its cage that are computed on; see `ClosedMesh.refined`."""
    cage = edit.cage.refined(cells)
    return edit if cage is edit.cage else dataclasses.replace(edit, cage=cage)


def checked_walls(held: Any, face_count: int) -> str | tuple[int, ...]:
    """The walls that an edit holds: "cut", "still", or numbers of faces as an ascending tuple."""
    if isinstance(held, str):
        if held not in HELD:
            raise InputError(f"held must be {' or '.join(map(repr, HELD))} or numbers of faces, got {held!r}")
        return held
    faces = np.asarray(held)
    if faces.ndim != 1 or not len(faces) or faces.dtype.kind not in "iu":
        raise InputError(f"held must be {' or '.join(map(repr, HELD))} or numbers of faces, got {str(held)[:60]}")
    if faces.min() < 0 or faces.max() >= face_count:
        wrong = faces[(faces < 0) | (faces >= face_count)][0]
        raise InputError(f"held names face {wrong}, the cage has faces 0 to {face_count - 1}")
    return tuple(int(face) for face in np.unique(faces))


def checked_edits(rest: Cage | CageEdit | Sequence[Cage | CageEdit]) -> list[CageEdit]:
    """The edits of a scene, in the order in which they act."""
    given: list[Any] = list(rest) if isinstance(rest, list | tuple) else [rest]
    edits = [edit if isinstance(edit, CageEdit) else CageEdit(edit) for edit in given]
    if not 1 <= len(edits) <= MAX_EDITS:
        raise InputError(f"a Deformer takes 1 to {MAX_EDITS} edits, got {len(edits)}")
    return edits


#: Default range of cells along the longest side of a cage, and pixels of the picture for each of them: a lattice
#: of 64 cells is 72 dB from a fine one in pictures of any size (docs/measurements.md).
MIN_CELLS, MAX_CELLS, PIXELS_PER_CELL = 64, 128, 5


def picture_cells(camera: Camera) -> int:
    """Cells along the longest side of a cage that suit a camera's picture, a multiple of 16."""
    cells = 16 * math.ceil(max(camera.width, camera.height) / (16 * PIXELS_PER_CELL))
    return min(max(cells, MIN_CELLS), MAX_CELLS)


def edit_from_spec(spec: EditSpec, cage: Cage) -> CageEdit:
    """The edit of a spec, with its cage at rest."""
    return CageEdit(cage, spec.keep, spec.remove, spec.falloff or 0.0, spec.held, spec.fragments or 0.0)


def edit_spec(edit: CageEdit, cage: Any, posed: Any) -> EditSpec:
    """The spec of an edit; cage and posed: references to its cage at rest and its pose, None for one that removes."""
    held = edit.held if edit.falloff else "cut"
    return EditSpec(cage, posed, edit.keep_source, edit.remove, edit.falloff, held, edit.fragments)
