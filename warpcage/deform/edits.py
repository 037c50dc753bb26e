"""Edits of a scene, and what renderers and kernels take of them once they are posed."""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any

import warp as wp

from ..cage.cage import Cage
from ..field.voxel_field import VoxelField
from ..mesh.usable import require_usable

#: Edits of one scene; the way of a sample through them is kept in the bits of an int.
MAX_EDITS = 31


@dataclasses.dataclass(frozen=True)
class CageEdit:
    """One edit of a scene: what is in `cage` goes where the posed cage is.

    Args:
        cage: The cage at rest.
        keep_source: Leave a copy where it was (a duplicate).
        remove: Draw nothing in its place: it is deleted, and needs no pose.

    Raises:
        ValueError: For both at once, or a cage that cannot be used.
    """

    cage: Cage
    keep_source: bool = False
    remove: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.cage, Cage):
            raise ValueError(f"an edit needs a Cage, got {type(self.cage).__name__}")
        if self.keep_source and self.remove:
            raise ValueError("an edit that removes its cage's content cannot keep the source: choose one")
        require_usable(self.cage, "the rest cage")


def checked_edits(rest: Cage | CageEdit | Sequence[Cage | CageEdit]) -> list[CageEdit]:
    """The edits of a scene.

    Args:
        rest: One cage or edit, or several in the order in which they act.

    Returns:
        The edits in the same order.

    Raises:
        ValueError: For anything else, or more than MAX_EDITS.
    """
    given = [rest] if isinstance(rest, Cage | CageEdit) else list(rest)
    edits = [edit if isinstance(edit, CageEdit) else CageEdit(edit) for edit in given]
    if not 1 <= len(edits) <= MAX_EDITS:
        raise ValueError(f"a Deformer takes 1 to {MAX_EDITS} edits, got {len(edits)}")
    return edits


class PosedEdits(abc.ABC):
    """Edits on a device, as kernels take them.

    Args:
        map_kernel: Traces points to canonical space; it takes `array`.
        render_kernel: Renders views; it takes `scene`.

    Attributes:
        map_kernel: The kernel for points.
        render_kernel: The kernel for views.
        array: (edits,) structs, once the edits are posed.
        scene: What the render kernel takes, once `prepare` has been called for the pose.
        sample_work: Steps that one sample takes at most, as `core.devices.launch` has them.
    """

    def __init__(self, map_kernel: Any, render_kernel: Any):
        self.map_kernel, self.render_kernel = map_kernel, render_kernel
        self.array: wp.array | None = None
        self.scene: Any = None
        self.sample_work = 1

    def row_tables(self, field: VoxelField) -> list[Any]:
        """What the render kernel reads of a field beside its VoxelGrid.

        Args:
            field: The field.

        Returns:
            Arguments of the kernel.
        """
        return []

    @abc.abstractmethod
    def pose(self, cages: Sequence[Cage | None]) -> None:
        """Compute what kernels need of a pose.

        Args:
            cages: The deformed cages in the order of the edits, None for an edit that removes.
        """

    @abc.abstractmethod
    def prepare(self, grid: Any, step: float) -> None:
        """Find the cells that a march may skip, once per pose.

        Args:
            grid: VoxelGrid of the field.
            step: March step, world units.
        """
