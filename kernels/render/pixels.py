"""The matter that pixels of a posed scene show: its place at rest, its edit, and its place in another view."""

from typing import Any

import warp as wp

from ..coordinates.mean_value import mean_value_position
from ..core.gradients import forward_only_in
from ..core.variants import declared_once, variant_module
from ..edits.structs import CLEARED, ExactEdit, LatticeEdit, in_fragments
from ..edits.trace import CLOSED_FORM_DIFFERENCE, canonical_point, edit_position, in_rest_cage
from ..lattice.cage_map import CageMap, make_inverse, map_position, map_slope
from ..view.rays import PinholeCamera, pixel_direction

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

forward_only = forward_only_in(__name__, (wp.vec3, wp.vec3))

#: Difference for the Jacobian of a closed form, as a share of the cage's size.
EXACT_CELL = wp.constant(1.0 / 64.0)


@wp.struct
class MovedCage:
    """A rest cage and where a pose takes its vertices, relative to the edits' origin."""

    vertices: wp.array(dtype=wp.vec3)
    faces: wp.array(dtype=wp.vec3i)
    fans: wp.array(dtype=wp.vec4)  # of the rest cage: see mesh/fans
    targets: wp.array(dtype=wp.vec3)
    size: float  # longest side of the rest cage


@wp.func
def nowhere():
    """No place: NaN."""
    return wp.vec3(wp.nan, wp.nan, wp.nan)


@wp.func
def seen_place(camera: PinholeCamera, depth: float, n: int):
    """What is at the depth of the n-th pixel, relative to the camera's origin; no place where nothing is seen."""
    if not wp.isfinite(depth):
        return nowhere()
    return camera.center + depth * pixel_direction(camera, n % camera.width, n // camera.width)


@wp.func
def exact_slope(edit: ExactEdit, x: wp.vec3):
    """Jacobian of a closed form, by central differences."""
    h = CLOSED_FORM_DIFFERENCE * edit.size
    dx = edit_position(edit, x + wp.vec3(h, 0.0, 0.0)) - edit_position(edit, x - wp.vec3(h, 0.0, 0.0))
    dy = edit_position(edit, x + wp.vec3(0.0, h, 0.0)) - edit_position(edit, x - wp.vec3(0.0, h, 0.0))
    dz = edit_position(edit, x + wp.vec3(0.0, 0.0, h)) - edit_position(edit, x - wp.vec3(0.0, 0.0, h))
    return (0.5 / h) * wp.matrix_from_cols(dx, dy, dz)


inverse_of_lattice = make_inverse(CageMap, map_position, map_slope)

inverse_of_closed_form = make_inverse(ExactEdit, edit_position, exact_slope)


@wp.func
def posed_place(edit: LatticeEdit, start: wp.vec3, y: wp.vec3, close: float):
    """The place near `start` that the map of an edit takes to y."""
    return inverse_of_lattice(edit.deformed, start, y, edit.deformed.spacing, close)


@wp.func
def posed_place(edit: ExactEdit, start: wp.vec3, y: wp.vec3, close: float):  # noqa: F811 (a Warp overload)
    """The place near `start` that the map of an edit takes to y."""
    return inverse_of_closed_form(edit, start, y, EXACT_CELL * edit.size, close)


@wp.func
def posed_point(edits: Any, cages: wp.array(dtype=MovedCage), y: wp.vec3, path: int, close: float):
    """Where a pose shows the matter at y of the scene at rest, by a path of CanonicalPoint where edits leave copies.
    NaN where nowhere. Checked by Eq. 5: it must lead back, to a few times `close`."""
    x = y
    for e in range(edits.shape[0]):
        edit = edits[e]
        goes = edit.removes == 0 and (path & (1 << e)) != 0
        slack = wp.where(goes, edit.slack, 0.0)
        held = in_rest_cage(edit, x, slack) or in_fragments(edit.fragments, x)
        if held and (goes or edit.keeps_source == 0):
            if edit.removes == 1:
                return forward_only(nowhere(), y)
            cage = cages[e]
            start = mean_value_position(x, cage.vertices, cage.faces, cage.fans, cage.targets, cage.size)
            x = posed_place(edit, start, x, 0.01 * close)
    back = canonical_point(edits, x)
    if back.vacant == 1 or back.region == CLEARED or not wp.length(back.position - y) <= close:
        return forward_only(nowhere(), y)
    return forward_only(x, y)


@declared_once
def trace_kernel(exact: bool) -> Any:
    """The kernel that traces what pixels show to the scene at rest."""
    edit_type = ExactEdit if exact else LatticeEdit

    @wp.kernel(name="trace_pixels", module=variant_module(__name__, f"trace+{'exact' if exact else 'lattice'}"))
    def trace_pixels(
        first: int,
        edits: wp.array(dtype=edit_type),
        origin: wp.vec3,
        camera: PinholeCamera,
        depth: wp.array(dtype=float),
        canonical: wp.array(dtype=wp.vec3),
        instance: wp.array(dtype=int),
        places: wp.array(dtype=wp.vec3),
        paths: wp.array(dtype=int),
    ):
        """canonical (n,): rest position of what is at the depth of each pixel, NaN where nothing is; instance (n,): the
        last edit that moved it, -1 for none; places, paths (n,): the same relative to `origin`, and its path."""
        n = first + wp.tid()
        place = nowhere()
        path = int(0)
        x = seen_place(camera, depth[n], n)
        if wp.isfinite(x[0]):
            point = canonical_point(edits, x)
            if point.vacant == 0 and point.region != CLEARED:
                place = point.position
                path = point.path
        if canonical.shape[0] > 0:
            canonical[n] = place + origin
        if instance.shape[0] > 0:
            edit = int(edits.shape[0]) - 1
            while edit >= 0 and (path & (1 << edit)) == 0:
                edit -= 1
            instance[n] = edit
        if places.shape[0] > 0:
            places[n] = place
            paths[n] = path

    return trace_pixels


@declared_once
def follow_kernel(exact: bool) -> Any:
    """The kernel that finds what pixels show in another pose."""
    edit_type = ExactEdit if exact else LatticeEdit

    @wp.kernel(name="follow_pixels", module=variant_module(__name__, f"follow+{'exact' if exact else 'lattice'}"))
    def follow_pixels(
        first: int,
        edits: wp.array(dtype=edit_type),
        cages: wp.array(dtype=MovedCage),
        close: float,
        paths: wp.array(dtype=int),
        places: wp.array(dtype=wp.vec3),
    ):
        """places (n,): of the scene at rest, become those of the pose of `edits`; NaN where it is not shown."""
        n = first + wp.tid()
        place = places[n]
        if wp.isfinite(place[0]):
            places[n] = posed_point(edits, cages, place, paths[n], close)

    return follow_pixels


@wp.kernel
def find_flow(
    first: int,
    camera: PinholeCamera,
    depth: wp.array(dtype=float),
    places: wp.array(dtype=wp.vec3),
    other: PinholeCamera,
    flow: wp.array(dtype=wp.vec2),
):
    """flow (n,): pixels from the middle of each pixel to where another camera sees places (n,), or, where there are
    none, what is at the depth of each; NaN for what is nowhere or behind that camera."""
    n = first + wp.tid()
    place = seen_place(camera, depth[n], n)
    if places.shape[0] > 0:
        place = places[n]
    local = wp.transpose(other.rotation) * (place - other.center)
    moved = wp.vec2(wp.nan, wp.nan)
    if local[2] > 0.0:
        u = other.focal[0] * local[0] / local[2] + other.principal_point[0]
        v = other.focal[1] * local[1] / local[2] + other.principal_point[1]
        moved = wp.vec2(u - (float(n % camera.width) + 0.5), v - (float(n // camera.width) + 0.5))
    flow[n] = moved


def variants() -> list[Any]:
    """All kernels that factories of this file declare."""
    return [make(exact) for make in (trace_kernel, follow_kernel) for exact in (False, True)]
