"""Arbitrary points and directions of a deformed scene in canonical space, for other renderers too."""

from typing import Any

import warp as wp

from ..coordinates.green import green_position
from ..coordinates.mean_value import mean_value_position
from ..coordinates.quad_mean_value import quad_mean_value_position
from ..core.gradients import forward_only_in
from ..core.variants import declared_once, variant_module
from ..lattice.cage_map import cell_sides, map_distance, map_position, side_position
from ..mesh.containment import cage_distance, winding_number
from ..mesh.triangle import faded_position
from .structs import (
    CELL_CARRIES,
    CELL_FOLDED,
    CELL_INSIDE,
    CELL_OUTSIDE,
    CELL_STAYS,
    CELL_STEEP,
    CLEARED,
    MAPPED,
    UNCHANGED,
    CellTable,
    ExactEdit,
    LatticeEdit,
    in_fragments,
)

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))

#: Part of a step that the finite difference falls back to where neither neighbour shares the point's cage.
SHORT_DIFFERENCE = wp.constant(0.0625)

#: A finite difference this many times as long in canonical space is looked at twice.
LONG_STEP = wp.constant(3.0)

#: Finite difference for the Jacobian of a closed form, as a share of the cage's size: float32 keeps three digits of it.
CLOSED_FORM_DIFFERENCE = wp.constant(2.0e-3)


@wp.struct
class EditPoint:
    """A point under one edit."""

    position: wp.vec3  # in the rest cage where `mapped`, else as it was
    mapped: int  # 1: the point is in the deformed cage
    leaves: int  # 1: the map sends it out of the rest cage
    flags: int  # CELL_... of the lattice cell that mapped it


@wp.struct
class CanonicalPoint:
    """A point under all edits."""

    position: wp.vec3
    region: int  # UNCHANGED, CLEARED or MAPPED
    path: int  # bit e is set where edit e mapped the point
    vacant: int  # 1: nothing is there, whatever the field holds at `position`
    outside: int  # 1: a map sent the point out of its rest cage
    flags: int  # CELL_... of all cells that mapped the point, joined


@wp.struct
class LatticeCell:
    """The cell of a point on an edit's lattice."""

    i: int
    j: int
    k: int
    offset: wp.vec3  # place in the cell, 0 to 1
    flags: int


@wp.func
def lattice_cell(edit: LatticeEdit, x: wp.vec3):
    """Cell and flags of a point; CELL_OUTSIDE (and no cell) beside the lattice."""
    g = (x - edit.deformed.lower) * edit.deformed.inverse_spacing
    cell = LatticeCell()
    cell.flags = CELL_OUTSIDE
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    if i >= 0 and j >= 0 and k >= 0 and i < edit.cells.shape[0] and j < edit.cells.shape[1] and k < edit.cells.shape[2]:
        cell.i = i
        cell.j = j
        cell.k = k
        cell.offset = g - wp.vec3(float(i), float(j), float(k))
        cell.flags = int(edit.cells[i, j, k])
    return cell


@wp.func
def cell_trilinear(values: wp.array3d(dtype=Any), cell: LatticeCell):
    """Trilinear value in a cell of a lattice."""
    i = cell.i
    j = cell.j
    k = cell.k
    fz = cell.offset[2]
    v00 = wp.lerp(values[i, j, k], values[i, j, k + 1], fz)
    v01 = wp.lerp(values[i, j + 1, k], values[i, j + 1, k + 1], fz)
    v10 = wp.lerp(values[i + 1, j, k], values[i + 1, j, k + 1], fz)
    v11 = wp.lerp(values[i + 1, j + 1, k], values[i + 1, j + 1, k + 1], fz)
    return wp.lerp(wp.lerp(v00, v01, cell.offset[1]), wp.lerp(v10, v11, cell.offset[1]), cell.offset[0])


@wp.func
def edit_point(edit: LatticeEdit, x: wp.vec3):
    """Whether a point is in the deformed cage of an edit, and where the map leads; an edit that removes leaves nothing
    there."""
    result = EditPoint()
    result.position = x
    if edit.removes == 1:
        return result
    cell = lattice_cell(edit, x)
    case = cell.flags & CELL_CARRIES
    inside = case == CELL_INSIDE
    if case == 0 or case == CELL_CARRIES:
        inside = cell_trilinear(edit.deformed.distance, cell) <= edit.tolerance
    if inside or case == CELL_CARRIES:
        position = x
        sides = cell_sides(edit.deformed, cell.i, cell.j, cell.k)
        if sides == 0:
            position = cell_trilinear(edit.deformed.positions, cell)
        else:
            position = side_position(edit.deformed.sides, sides, cell.offset)
        stays = (cell.flags & CELL_STAYS) != 0
        if not stays:
            stays = in_fragments(edit.fragments, position) or (inside and in_rest_cage(edit, position, edit.slack))
        if inside or stays:
            result.mapped = 1
            result.flags = cell.flags
            result.position = position
            result.leaves = wp.where(stays, 0, 1)
    return result


@wp.func
def in_rest_cage(edit: LatticeEdit, x: wp.vec3, slack: float):
    """Whether a point lies in the rest cage of an edit, or within `slack` of it."""
    return map_distance(edit.rest, x) <= slack


@wp.func
def table_flags(table: CellTable, x: wp.vec3):
    """Flags of the cell of a point; CELL_OUTSIDE beside the lattice."""
    g = (x - table.lower) / table.spacing
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    if (
        i >= 0
        and j >= 0
        and k >= 0
        and i < table.flags.shape[0]
        and j < table.flags.shape[1]
        and k < table.flags.shape[2]
    ):
        return int(table.flags[i, j, k])
    return CELL_OUTSIDE


@wp.func(inline=False)  # closed forms are long, and slow enough that a call does not matter
def in_cage(x: wp.vec3, vertices: wp.array(dtype=wp.vec3), faces: wp.array(dtype=wp.vec3i), slack: float):
    """Whether a point lies in a cage, or within `slack` of it."""
    if winding_number(x, vertices, faces) > 0.5:
        return True
    return cage_distance(x, vertices, faces) <= slack


@wp.func
def in_rest_cage(edit: ExactEdit, x: wp.vec3, slack: float):  # noqa: F811
    """Whether a point lies in the rest cage of an edit, or within `slack` of it."""
    flags = table_flags(edit.rest_cells, x)
    if (flags & (CELL_INSIDE | CELL_OUTSIDE)) != 0:
        return (flags & CELL_INSIDE) != 0
    return in_cage(x, edit.rest_vertices, edit.faces, slack)


@wp.func(inline=False)
def edit_position(edit: ExactEdit, x: wp.vec3):
    """The map of an edit, from its deformed into its rest cage."""
    mapped = x
    if edit.is_green == 1:
        mapped = green_position(
            x, edit.deformed_vertices, edit.faces, edit.fans, edit.rest_vertices, edit.rest_normals, edit.size
        )
    elif edit.is_of_quads == 1:
        mapped = quad_mean_value_position(
            x, edit.deformed_vertices, edit.quads, edit.planes, edit.rest_vertices, edit.size
        )
    else:
        mapped = mean_value_position(x, edit.deformed_vertices, edit.faces, edit.fans, edit.rest_vertices, edit.size)
    return faded_position(edit.walls, x, mapped)


@wp.func
def edit_point(edit: ExactEdit, x: wp.vec3):  # noqa: F811
    """Whether a point is in the deformed cage of an edit, and where the map leads; an edit that removes leaves nothing
    there."""
    result = EditPoint()
    result.position = x
    if edit.removes == 1:
        return result
    flags = table_flags(edit.deformed_cells, x)
    case = flags & CELL_CARRIES
    inside = case == CELL_INSIDE
    if case == 0 or case == CELL_CARRIES:
        inside = in_cage(x, edit.deformed_vertices, edit.faces, edit.tolerance)
    if inside:
        result.mapped = 1
        result.flags = flags
        result.position = edit_position(edit, x)
        if (flags & CELL_STAYS) == 0:
            stays = in_rest_cage(edit, result.position, edit.slack) or in_fragments(edit.fragments, result.position)
            result.leaves = wp.where(stays, 0, 1)
    elif case == CELL_CARRIES:
        position = map_position(edit.carried, x)
        if in_fragments(edit.fragments, position):
            result.mapped = 1
            result.flags = CELL_CARRIES | CELL_STEEP  # a lattice's map, which is not checked for folds
            result.position = position
    return result


@wp.func
def traced_point(edits: Any, x: wp.vec3):
    """Trace a point of the deformed scene to canonical space: Eq. 5 for each of `edits`, the last first."""
    result = CanonicalPoint()
    position = x
    cleared = int(0)  # then it goes on through the earlier edits; `position` is where it was cleared
    e = int(edits.shape[0]) - 1
    while e >= 0 and result.vacant == 0:
        edit = edits[e]
        place = edit_point(edit, position)
        if place.mapped == 1:
            if result.path != 0:
                result.flags = result.flags | CELL_STEEP  # each may be gentle, but not both together
            result.path = result.path | (1 << e)
            result.flags = result.flags | place.flags
            if place.leaves == 1:
                result.vacant = 1
                result.outside = 1 - cleared
            position = place.position
        elif edit.keeps_source == 0 and (in_rest_cage(edit, position, 0.0) or in_fragments(edit.fragments, position)):
            result.vacant = cleared  # what is cleared cannot be cleared again
            cleared = 1
        e -= 1
    result.position = forward_only(position, x)
    result.region = wp.where(cleared == 1, CLEARED, wp.where(result.path != 0, MAPPED, UNCHANGED))
    return result


@wp.func
def canonical_point(edits: Any, x: wp.vec3):
    """A point under all edits, see traced_point."""
    return traced_point(edits, x)


@wp.func(inline=False)  # as slow as the closed forms in it: halves what a march takes to compile
def canonical_point(edits: wp.array(dtype=ExactEdit), x: wp.vec3):  # noqa: F811
    """A point under all edits by closed forms, see traced_point."""
    return traced_point(edits, x)


@wp.func
def same_map(a: CanonicalPoint, b: CanonicalPoint):
    """Whether two points went through the same cages, so that the difference of their positions is one of the map."""
    return a.region == b.region and a.path == b.path


@wp.func(inline=False)  # rare: only where a ray leaves a cage
def lonely_step(edits: Any, x: wp.vec3, direction: wp.vec3, dt: float, here: CanonicalPoint):
    """canonical_step without a neighbour ahead."""
    behind = canonical_point(edits, x - dt * direction)
    if same_map(here, behind):
        return here.position - behind.position
    for side in range(2):
        short = wp.where(side == 0, SHORT_DIFFERENCE, -SHORT_DIFFERENCE)
        near = canonical_point(edits, x + short * dt * direction)
        if same_map(here, near):
            return (near.position - here.position) / short
    return dt * direction


@wp.func(inline=False)  # rare: only where a step is long in canonical space
def long_step(edits: Any, x: wp.vec3, direction: wp.vec3, dt: float, here: CanonicalPoint, step: wp.vec3):
    """`step`, unless it is no derivative: x and x + dt d may lie in two parts of one cage, with a gap between them."""
    near = canonical_point(edits, x + SHORT_DIFFERENCE * dt * direction)
    if same_map(here, near):
        short = (near.position - here.position) / SHORT_DIFFERENCE
        if wp.length(step) > 2.0 * wp.length(short):
            return short
        return step
    return lonely_step(edits, x, direction, dt, here)


@wp.func
def canonical_step(edits: Any, x: wp.vec3, direction: wp.vec3, dt: float, here: CanonicalPoint, ahead: CanonicalPoint):
    """phi(x + dt d) - phi(x), world units; `here` and `ahead` are the canonical points of x and x + dt d."""
    # The backward difference where x + dt d has left the cage, a shorter one where x - dt d has too; dt d without any.
    if here.path == 0:
        return dt * direction
    if same_map(here, ahead):
        step = ahead.position - here.position
        if wp.length_sq(step) > LONG_STEP * LONG_STEP * dt * dt:
            return long_step(edits, x, direction, dt, here, step)
        return step
    return lonely_step(edits, x, direction, dt, here)


@wp.func
def canonical_direction(step: wp.vec3, dt: float, direction: wp.vec3):
    """Eq. 4: the unit direction of a finite difference; a degenerate one keeps the direction it was taken along."""
    length = wp.length(step)
    if length > 1.0e-6 * dt:
        return step / length
    return direction


@wp.func
def difference_determinant(edit: ExactEdit, x: wp.vec3, h: float):
    """det of the central differences of an edit's map."""
    dx = edit_position(edit, x + wp.vec3(h, 0.0, 0.0)) - edit_position(edit, x - wp.vec3(h, 0.0, 0.0))
    dy = edit_position(edit, x + wp.vec3(0.0, h, 0.0)) - edit_position(edit, x - wp.vec3(0.0, h, 0.0))
    dz = edit_position(edit, x + wp.vec3(0.0, 0.0, h)) - edit_position(edit, x - wp.vec3(0.0, 0.0, h))
    return wp.dot(dx, wp.cross(dy, dz)) / (8.0 * h * h * h)


@wp.func
def turns_over(edit: ExactEdit, x: wp.vec3):
    """Whether the map of an edit turns space over around a point (det J <= 0), by differences; not next to the cage,
    beyond which Green coordinates hold no map."""
    h = CLOSED_FORM_DIFFERENCE * edit.size
    if cage_distance(x, edit.deformed_vertices, edit.faces) < h:
        return False
    return difference_determinant(edit, x, h) <= 0.0


@wp.func
def has_inverted_cells(edits: Any, x: wp.vec3, point: CanonicalPoint):
    """Whether any of the maps that a point x goes through turns space over there, by the flags of lattice cells."""
    return (point.flags & CELL_FOLDED) != 0


@wp.func
def has_inverted_cells(edits: wp.array(dtype=ExactEdit), x: wp.vec3, point: CanonicalPoint):  # noqa: F811
    """The same without lattices, whose cells only show where that is possible."""
    position = x
    rest_of_path = point.path
    if (point.flags & CELL_FOLDED) == 0:
        return False
    e = int(edits.shape[0]) - 1
    while rest_of_path != 0:
        if (point.path & (1 << e)) != 0:
            edit = edits[e]
            if turns_over(edit, position):
                return True
            rest_of_path = rest_of_path - (1 << e)
            if rest_of_path != 0:
                position = edit_position(edit, position)
        e -= 1
    return False


@wp.struct
class CanonicalRay:
    """Where a point is in canonical space, and how it is seen there."""

    point: wp.vec3
    direction: wp.vec3
    region: int
    outside: int


@wp.func
def canonical_ray(edits: Any, x: wp.vec3, direction: wp.vec3, dt: float):
    """Point, direction and region of a point x seen along `direction` of any length; dt in world units."""
    result = CanonicalRay()
    result.point = x  # cleared points keep it; one whose map leaves the rest cage is empty too, hence cleared
    result.direction = direction
    along = wp.normalize(direction)
    here = canonical_point(edits, x)
    result.region = here.region
    if here.vacant == 1:
        result.region = CLEARED
        result.outside = here.outside
    if result.region == MAPPED:
        ahead = canonical_point(edits, x + dt * along)
        result.point = here.position
        result.direction = canonical_direction(canonical_step(edits, x, along, dt, here, ahead), dt, along)
    return result


@declared_once
def map_kernel(exact: bool) -> Any:
    """The kernel that takes points and directions to canonical space, without a lattice or by one."""
    edit_type = ExactEdit if exact else LatticeEdit

    @wp.kernel(name="map_points", module=variant_module(__name__, "exact" if exact else "lattice"))
    def map_points(
        first: int,
        edits: wp.array(dtype=edit_type),
        origin: wp.vec3,
        points: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        dt: float,
        canonical_points: wp.array(dtype=wp.vec3),
        canonical_directions: wp.array(dtype=wp.vec3),
        region: wp.array(dtype=wp.int32),
        outside: wp.array(dtype=wp.uint8),
    ):
        """Canonical points and directions (n,) of points (n,) seen along directions (n,); region: 0 unchanged,
        1 cleared, 2 mapped. `origin` is what the edits' positions are relative to, in the frame of the points."""
        n = first + wp.tid()
        ray = canonical_ray(edits, points[n] - origin, directions[n], dt)
        canonical_points[n] = ray.point + origin
        canonical_directions[n] = ray.direction
        region[n] = ray.region
        outside[n] = wp.uint8(ray.outside)

    return map_points


def variants() -> list[Any]:
    """All kernels that factories of this file declare."""
    return [map_kernel(exact) for exact in (False, True)]
