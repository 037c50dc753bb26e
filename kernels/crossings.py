"""Where the lines of a lattice cross a triangle cage: inside / outside of nodes, and fractions of cut grid edges.

A lattice has nodes at integer coordinates 0 .. shape - 1 ("node units"); cage vertices (v,) vec3 are given in the same
units. Lines run along the three axes through the nodes; each keeps its crossings with the cage in order, reduced to
those where the winding number turns from 0 to above 0 or back, so even places enter the inside and odd ones leave it.
Whether a line passes through a face is decided by edge functions in float64, of float32 input and with vertices in one
order for both faces of an edge: products are exact, so neighbouring faces agree and closed cages have no leaks (compare
Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection", JCGT 2013).
Siblings: none.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: How far, in cells, a node may lie beyond a crossing by rounding and still count as on its inner side.
SLACK = wp.constant(1.0e-3)

#: Faces that are read at once.
CHUNK = wp.constant(4)


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
    # a line exactly through an edge counts as on its left, for both faces
    if area == wp.float64(0.0):
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


@wp.func
def segment_count(shape: wp.vec3i, axis: int, segment: int):
    """Runs of at most `segment` neighbouring lines along `axis`."""
    rows = wp.where(axis == 0, shape[1], shape[0])
    columns = wp.where(axis == 2, shape[1], shape[2])
    return rows * ((columns + segment - 1) / segment)


@wp.func
def cross_face(
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    crossings: LineCrossings,
    f: int,
    axis: int,
    row_axis: int,
    column_axis: int,
    row: int,
    begin: int,
    end: int,
    first_line: int,
):
    """Crossings of the lines begin .. end - 1 of a row with a face; first_line: the one of column 0."""
    face = faces[f]
    a = vertices[face[0]]
    b = vertices[face[1]]
    c = vertices[face[2]]
    lowest = wp.min(wp.min(component(a, column_axis), component(b, column_axis)), component(c, column_axis))
    highest = wp.max(wp.max(component(a, column_axis), component(b, column_axis)), component(c, column_axis))
    p0 = wp.float64(row)
    for column in range(wp.max(begin, int(wp.ceil(lowest))), wp.min(end, int(wp.floor(highest)) + 1)):
        p1 = wp.float64(column)
        side_c = edge_side(a, b, face[0] < face[1], row_axis, column_axis, p0, p1)
        side_a = edge_side(b, c, face[1] < face[2], row_axis, column_axis, p0, p1)
        side_b = edge_side(c, a, face[2] < face[0], row_axis, column_axis, p0, p1)
        zero = wp.float64(0.0)
        front = side_a > zero and side_b > zero and side_c > zero
        back = side_a < zero and side_b < zero and side_c < zero
        if front or back:
            total = side_a + side_b + side_c
            place = (
                side_a * wp.float64(component(a, axis))
                + side_b * wp.float64(component(b, axis))
                + side_c * wp.float64(component(c, axis))
            ) / total
            # (row, column, axis) is a right-handed frame for axes 0 and 2, a left-handed one for axis 1
            leaves = front != (axis == 1)
            insert_crossing(crossings, first_line + column, float(place), wp.where(leaves, f + 1, -f - 1))


@wp.kernel
def cross_lines(
    first: int,
    segment: int,
    vertices: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3i),
    crossings: LineCrossings,
    overflow: wp.array(dtype=int),
):
    """Crossings of all lines of a lattice with a cage.

    An item is a run of `segment` neighbouring lines of one axis, those of axis 0 first. overflow (1,) becomes the
    crossings a line would need where they are more than the capacity.
    """
    shape = crossings.shapes[0]
    item = first + wp.tid()
    axis = int(0)
    while axis < 3 and item >= segment_count(shape, axis, segment):
        item -= segment_count(shape, axis, segment)
        axis += 1
    if axis == 3:
        return
    # lines of axis 0, 1, 2 are numbered by (j, k), (i, k), (i, j): row and column
    row_axis = wp.where(axis == 0, 1, 0)
    column_axis = wp.where(axis == 2, 1, 2)
    columns = shape[column_axis]
    runs = (columns + segment - 1) / segment
    row = item / runs
    begin = (item - row * runs) * segment
    end = wp.min(begin + segment, columns)
    first_line = line_index(shape, axis, wp.where(row_axis == 0, row, 0), wp.where(row_axis == 1, row, 0), 0)
    for column in range(begin, end):
        crossings.counts[first_line + column] = 0

    for f in range(0, faces.shape[0], CHUNK):
        meets = int(0)
        for m in range(CHUNK):  # without branches, so that all are read at once
            face = faces[wp.min(f + m, faces.shape[0] - 1)]
            a = vertices[face[0]]
            b = vertices[face[1]]
            c = vertices[face[2]]
            low = wp.min(wp.min(a, b), c)
            high = wp.max(wp.max(a, b), c)
            over_row = component(low, row_axis) <= float(row) and component(high, row_axis) >= float(row)
            over_run = component(low, column_axis) <= float(end - 1) and component(high, column_axis) >= float(begin)
            meets += wp.where(f + m < faces.shape[0] and over_row and over_run, 1 << m, 0)
        number = int(f)
        while meets != 0:
            if (meets & 1) == 1:
                cross_face(vertices, faces, crossings, number, axis, row_axis, column_axis, row, begin, end, first_line)
            meets = meets >> 1
            number += 1

    for column in range(begin, end):
        if crossings.counts[first_line + column] > crossings.places.shape[1]:
            overflow[0] = crossings.counts[first_line + column]
            crossings.counts[first_line + column] = 0
        keep_changes(crossings, first_line + column)


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
