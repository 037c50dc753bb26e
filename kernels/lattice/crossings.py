"""Where the lines of a lattice cross a triangle cage: inside / outside of nodes, and fractions of cut grid edges."""

# Node units: nodes lie at integer coordinates 0 .. shape - 1, and cage vertices (v,) vec3 are in the same units. Lines
# along the three axes through the nodes keep their crossings where the winding number turns from 0 to above 0 or back,
# in order: even places enter, odd ones leave. Edge functions in float64 of float32 input, vertices in one order for
# both faces of an edge, are exact: neighbours agree, and closed cages have no leaks (compare Woop, Benthin and Wald,
# "Watertight Ray/Triangle Intersection", JCGT 2013).

import warp as wp

from ..core.gradients import forward_only_in
from ..core.lanes import ballot, lane_place, lowest_bit, without_lowest_bit

# small blocks, as there are few items to fill a GPU with
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 64})

forward_only = forward_only_in(__name__, (wp.array2d(dtype=float),))

#: How far, in cells, a node may lie beyond a crossing by rounding and still count as on its inner side.
SLACK = wp.constant(1.0e-3)

#: Neighbouring lines that a group of lanes takes.
RUN = wp.constant(32)


@wp.struct
class LineCrossings:
    shapes: wp.array(dtype=wp.vec3i)  # (1 or more,) the first entry: nodes along each axis
    counts: wp.array(dtype=int)  # (lines,) crossings kept on a line; lines of axis 0 first, then 1, then 2
    places: wp.array2d(dtype=float)  # (lines, m) coordinate along the axis, ascending
    faces: wp.array2d(dtype=int)  # (lines, m) cage face crossed there


@wp.func
def line_index(shape: wp.vec3i, axis: int, i: int, j: int, k: int):
    """Row of the line along `axis` through node (i, j, k)."""
    if axis == 0:
        return j * shape[2] + k
    if axis == 1:
        return shape[1] * shape[2] + i * shape[2] + k
    return shape[1] * shape[2] + shape[0] * shape[2] + i * shape[1] + j


@wp.func
def component(v: wp.vec3, axis: int):
    """v[axis], from registers: an index that is not known to the compiler would send v through memory."""
    return wp.where(axis == 0, v[0], wp.where(axis == 1, v[1], v[2]))


@wp.func
def edge_side(a: wp.vec3, b: wp.vec3, ordered: bool, axis0: int, axis1: int, p0: wp.float64, p1: wp.float64):
    """Twice the signed area of projected triangle (a, b, p), computed alike for both directions of the edge."""
    u = a
    v = b
    if not ordered:
        u = b
        v = a
    u0 = wp.float64(component(u, axis0))
    u1 = wp.float64(component(u, axis1))
    v0 = wp.float64(component(v, axis0))
    v1 = wp.float64(component(v, axis1))
    area = (v0 - u0) * (p1 - u1) - (v1 - u1) * (p0 - u0)
    if area == wp.float64(0.0):  # a line exactly through an edge counts as on its left, for both faces
        area = wp.float64(1.0e-30)
    return wp.where(ordered, area, -area)


@wp.func
def insert_crossing(crossings: LineCrossings, line: int, place: float, signed_face: int):
    """Insert in ascending order. Counts go on beyond the capacity, so that the caller can see what is needed."""
    count = crossings.counts[line]
    capacity = crossings.places.shape[1]
    if count < capacity:
        slot = int(count)
        while slot > 0 and crossings.places[line, wp.max(slot - 1, 0)] > place:
            crossings.places[line, slot] = crossings.places[line, slot - 1]
            crossings.faces[line, slot] = crossings.faces[line, slot - 1]
            slot -= 1
        crossings.places[line, slot] = place
        crossings.faces[line, slot] = signed_face
    crossings.counts[line] = count + 1
    forward_only(crossings.places)


@wp.func
def keep_changes(crossings: LineCrossings, line: int):
    """Drop crossings that do not change inside / outside (sheets of a cage within itself), and the signs of faces."""
    winding = int(0)
    kept = int(0)
    for n in range(crossings.counts[line]):
        signed_face = crossings.faces[line, n]
        before = winding > 0
        winding += wp.where(signed_face > 0, -1, 1)
        after = winding > 0
        if before != after:
            crossings.places[line, kept] = crossings.places[line, n]
            crossings.faces[line, kept] = wp.abs(signed_face) - 1
            kept += 1
    crossings.counts[line] = kept
    forward_only(crossings.places)


@wp.func
def run_count(shape: wp.vec3i, axis: int):
    """Runs of at most RUN neighbouring lines along `axis`."""
    rows = wp.where(axis == 0, shape[1], shape[0])
    columns = wp.where(axis == 2, shape[1], shape[2])
    return rows * ((columns + RUN - 1) / RUN)


@wp.struct
class LineRun:
    """Neighbouring lines of one axis and one row: lines of axis 0, 1, 2 are numbered by (j, k), (i, k), (i, j)."""

    axis: int
    row_axis: int
    column_axis: int
    row: int
    begin: int  # columns begin .. end - 1
    end: int
    first_line: int  # number of the row's line in column 0


@wp.func
def line_run(shape: wp.vec3i, number: int):
    """The run of that number, those of axis 0 first; axis 3 for none."""
    result = LineRun()
    item = int(number)
    axis = int(0)
    while axis < 3 and item >= run_count(shape, axis):
        item -= run_count(shape, axis)
        axis += 1
    result.axis = axis
    result.row_axis = wp.where(axis == 0, 1, 0)
    result.column_axis = wp.where(axis == 2, 1, 2)
    columns = wp.where(axis == 2, shape[1], shape[2])
    runs = (columns + RUN - 1) / RUN
    result.row = item / runs
    result.begin = (item - result.row * runs) * RUN
    result.end = wp.min(result.begin + RUN, columns)
    row_of_axis_0 = wp.where(axis == 0, result.row, 0)
    result.first_line = line_index(shape, axis, wp.where(axis == 0, 0, result.row), row_of_axis_0, 0)
    return result


@wp.func
def face_meets_run(vertices: wp.array(dtype=wp.vec3), face: wp.vec3i, run: LineRun):
    """Whether the lines of a run pass through the bounding box of a face."""
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    low = wp.min(wp.min(a, b), c)
    high = wp.max(wp.max(a, b), c)
    over_row = component(low, run.row_axis) <= float(run.row) and component(high, run.row_axis) >= float(run.row)
    over_columns = component(low, run.column_axis) <= float(run.end - 1) and component(high, run.column_axis) >= float(
        run.begin
    )
    return over_row and over_columns


@wp.func
def cross_face(
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    crossings: LineCrossings,
    f: int,
    run: LineRun,
    lane: int,
    lanes: int,
):
    """Crossings of a lane's lines of a run with a face."""
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    lowest = component(wp.min(wp.min(a, b), c), run.column_axis)
    highest = component(wp.max(wp.max(a, b), c), run.column_axis)
    p0 = wp.float64(run.row)
    own = run.begin + lane
    skipped = wp.max(int(wp.ceil(lowest)) - own + lanes - 1, 0) / lanes
    for column in range(own + skipped * lanes, wp.min(run.end, int(wp.floor(highest)) + 1), lanes):
        p1 = wp.float64(column)
        side_c = edge_side(a, b, face[0] < face[1], run.row_axis, run.column_axis, p0, p1)
        side_a = edge_side(b, c, face[1] < face[2], run.row_axis, run.column_axis, p0, p1)
        side_b = edge_side(c, a, face[2] < face[0], run.row_axis, run.column_axis, p0, p1)
        zero = wp.float64(0.0)
        front = side_a > zero and side_b > zero and side_c > zero
        back = side_a < zero and side_b < zero and side_c < zero
        if front or back:
            total = side_a + side_b + side_c
            place = (
                side_a * wp.float64(component(a, run.axis))
                + side_b * wp.float64(component(b, run.axis))
                + side_c * wp.float64(component(c, run.axis))
            ) / total
            # (row, column, axis) is a right-handed frame for axes 0 and 2, a left-handed one for axis 1
            leaves = front != (run.axis == 1)
            insert_crossing(crossings, run.first_line + column, float(place), wp.where(leaves, f + 1, -f - 1))


@wp.kernel
def cross_lines(
    first: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    crossings: LineCrossings,
    overflow: wp.array(dtype=int),
):
    """Crossings of all lines of a lattice with a cage. A group of lanes takes a run of RUN neighbouring lines.
    overflow (1,) becomes the crossings a line would need where they are more than the capacity."""
    piece, lane, lanes = lane_place(first + wp.tid())
    run = line_run(crossings.shapes[0], piece)
    if run.axis == 3:
        return
    for column in range(run.begin + lane, run.end, lanes):
        crossings.counts[run.first_line + column] = 0

    face_count = faces.shape[0]
    for f in range(0, face_count, lanes):
        own = faces[wp.min(f + lane, face_count - 1)]
        meets = ballot(wp.where(f + lane < face_count and face_meets_run(vertices, own, run), 1, 0))
        while meets != 0:
            cross_face(vertices, faces, crossings, f + lowest_bit(meets), run, lane, lanes)
            meets = without_lowest_bit(meets)

    for column in range(run.begin + lane, run.end, lanes):
        if crossings.counts[run.first_line + column] > crossings.places.shape[1]:
            overflow[0] = crossings.counts[run.first_line + column]
            crossings.counts[run.first_line + column] = 0
        keep_changes(crossings, run.first_line + column)


@wp.func
def is_inside(crossings: LineCrossings, i: int, j: int, k: int):
    """Whether node (i, j, k) is inside the cage."""
    line = line_index(crossings.shapes[0], 2, i, j, k)
    passed = int(0)
    for n in range(crossings.counts[line]):
        if crossings.places[line, n] < float(k):
            passed += 1
    return passed % 2 == 1


@wp.func
def exit_crossing(crossings: LineCrossings, axis: int, forward: bool, i: int, j: int, k: int):
    """Slot, on the line along `axis`, of the crossing by which an inside node leaves the cage; -1 for none."""
    line = line_index(crossings.shapes[0], axis, i, j, k)
    place = float(wp.where(axis == 0, i, wp.where(axis == 1, j, k)))
    slot = int(-1)
    if forward:
        for n in range(crossings.counts[line] / 2):
            if slot < 0 and crossings.places[line, 2 * n + 1] >= place - SLACK:
                slot = 2 * n + 1
    else:
        for n in range(crossings.counts[line] / 2):
            if crossings.places[line, 2 * n] <= place + SLACK:
                slot = 2 * n
    return slot


@wp.func
def exit_distance(crossings: LineCrossings, axis: int, forward: bool, i: int, j: int, k: int):
    """Cells from an inside node to where it leaves the cage along +axis or -axis; 1e9 where the line has no exit."""
    slot = exit_crossing(crossings, axis, forward, i, j, k)
    if slot < 0:
        return float(1.0e9)
    place = float(wp.where(axis == 0, i, wp.where(axis == 1, j, k)))
    crossing = crossings.places[line_index(crossings.shapes[0], axis, i, j, k), slot]
    return wp.max(wp.where(forward, crossing - place, place - crossing), 0.0)
