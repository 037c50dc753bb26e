"""How a frame is marched: a plan that follows from a few facts alone."""

from __future__ import annotations

from typing import Literal, NamedTuple


class FrameFacts(NamedTuple):
    """What decides how a frame is marched."""

    general_maps: tuple[bool, ...]  # of each edit, whether its map needs more than polynomials (`needs_general_map`)
    has_gaps: bool = False  # whether the pose has narrow gaps, of any edit
    has_fragments: bool = False  # whether any edit takes fragments along
    by_tiles: bool = False  # whether rays of a tile go side by side, as on a CPU
    order: tuple[int, ...] | None = None  # of edits that cannot meet, front to back; None where they may
    is_far: bool = False  # whether the camera sees each voxel from one direction only
    colors_fit: bool = True  # whether there is memory for the colours of all voxels
    is_folded: bool | None = None  # whether the pose turns matter over; None: not read from the device yet


class PlannedEdit(NamedTuple):
    """An edit that is marched by itself."""

    number: int
    has_sides: bool  # whether its march knows more than polynomials


class FramePlan(NamedTuple):
    """How a frame is marched."""

    march: Literal["edit", "parts", "stack"]  # through one edit, edits apart one after the other, or all at once
    lanes: Literal["ray", "tile"] = "ray"  # what an item of the kernel follows
    table: Literal["rows", "shaded"] = "rows"  # what samples read of the field
    edits: tuple[PlannedEdit, ...] = ()  # those that are marched by themselves, front to back
    is_simple: bool = False  # a stack without fragments and narrow gaps

    @property
    def is_shaded(self) -> bool:
        """Whether voxels are shaded for the view."""
        return self.table == "shaded"


def plan_frame(facts: FrameFacts) -> FramePlan:
    """The plan of a frame through edits on lattices."""
    is_single = len(facts.general_maps) == 1 and not facts.has_fragments  # marches for one edit know no fragments
    order = (0,) if is_single else None if facts.has_fragments else facts.order
    if order is None:  # fragments, edits that may meet, or that hide each other in a circle
        return FramePlan("stack", is_simple=not facts.has_fragments and not facts.has_gaps)
    edits = tuple(PlannedEdit(number, facts.general_maps[number]) for number in order)
    if facts.by_tiles:
        return FramePlan("parts", "tile", edits=edits)
    # a pose that turns matter over shows a voxel in several places, and from several directions
    is_shaded = facts.is_far and facts.colors_fit and not facts.is_folded
    return FramePlan("edit" if is_single else "parts", "ray", "shaded" if is_shaded else "rows", edits)
