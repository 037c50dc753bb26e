"""Narrow gaps of a cage: outside nodes next to the inside that lie between two of its sheets."""

# Two things are found: nodes whose inside neighbours, of 26, are not all joined by links that stay inside the cage; and
# links that leave the cage and enter it again, at gaps narrower than a cell. They count where the map differs by more
# than GAP_JUMP from one side to the other; grooves that a pose does not open need no sides (see gap_sides.py).

import warp as wp

from .crossings import LineCrossings, exit_distance
from .cut_rows import DOUBLE_CUT, CutRows
from .nodes import OUTSIDE, NodeLevels, cut_section, node_place, ring_section
from .rings import is_open_link, node_step

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "max_unroll": 2})

#: Difference of the remainder of a map over a gap, as a share of the rest cage's size, above which sides are kept.
GAP_JUMP = wp.constant(1.0e-2)

#: Bits of a 3 x 3 x 3 neighbourhood, numbered like nodes, whose last coordinate is not the lowest; whose
#: middle one is not.
_ABOVE_K = wp.constant(0b110110110110110110110110110)
_ABOVE_J = wp.constant(0b111111000111111000111111000)
_ALL = wp.constant((1 << 27) - 1)


@wp.func
def grown(mask: int):
    """A set of places of a 3 x 3 x 3 neighbourhood and their neighbours along the axes."""
    below_k = mask & (_ABOVE_K >> 1)
    below_j = mask & (_ABOVE_J >> 3)
    result = mask | (below_k << 1) | ((mask & _ABOVE_K) >> 1)
    result = result | (below_j << 3) | ((mask & _ABOVE_J) >> 3)
    return (result | (mask << 9) | (mask >> 9)) & _ALL


@wp.func(inline=False)  # rare: only next to a link that crosses the cage twice
def loose_part(levels: NodeLevels, rows: CutRows, node: int, mask: int):
    """Inside nodes among the 26 neighbours of a node, the bits of `mask`, that are not joined to the lowest of them by
    links that stay inside the cage."""
    shape = levels.shapes[0]
    reached = mask & (-mask)
    before = int(0)
    while reached != before:
        before = reached + 0
        for d in range(27):
            if (reached >> d) & 1 == 1:
                place = node + ((d / 9 - 1) * shape[1] + (d / 3) % 3 - 1) * shape[2] + d % 3 - 1
                for direction in range(6):
                    axis = direction / 2
                    weight = wp.where(axis == 0, 9, wp.where(axis == 1, 3, 1))
                    along = (d / weight) % 3 + wp.where(direction % 2 == 1, 1, -1)
                    other = d + wp.where(direction % 2 == 1, weight, -weight)
                    if along >= 0 and along < 3 and (mask >> other) & 1 == 1 and (reached >> other) & 1 == 0:
                        if is_open_link(levels, rows, place, direction):
                            reached = reached | (1 << other)
    return mask & ~reached


@wp.func
def far_side(levels: NodeLevels, rows: CutRows, node: int):
    """Inside nodes around an outside node on the far side of a gap, as a mask and the rest of them as another; none in
    the first where there is no gap."""
    shape = levels.shapes[0]
    mask = int(0)
    doubly_cut = int(0)
    for i in range(3):  # without branches, so that all are read at once
        for j in range(3):
            for k in range(3):
                code = levels.codes[node + ((i - 1) * shape[1] + j - 1) * shape[2] + k - 1]
                mask += wp.where(code > OUTSIDE, 1 << (9 * i + 3 * j + k), 0)
                if code >= 0 and code < rows.links.shape[0]:
                    doubly_cut = doubly_cut | (rows.links[code] & DOUBLE_CUT)
    if doubly_cut != 0:
        loose = loose_part(levels, rows, node, mask)
        return wp.vec2i(loose, mask & ~loose)
    reached = mask & (-mask)  # the lowest one
    for _step in range(7):
        reached = grown(reached) & mask
    if reached != mask:  # a path along the rim may take longer
        for _more in range(20):
            reached = grown(reached) & mask
    return wp.vec2i(mask & ~reached, reached)


@wp.func(inline=False)  # rare
def mean_around(levels: NodeLevels, values: wp.array(dtype=wp.vec3), node: int, mask: int):
    """Mean of the values at those of the 26 neighbours that are in `mask`."""
    shape = levels.shapes[0]
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for d in range(27):
        if (mask >> d) & 1 == 1:
            total += values[node + ((d / 9 - 1) * shape[1] + (d / 3) % 3 - 1) * shape[2] + d % 3 - 1]
            count += 1.0
    return total / count


@wp.kernel
def find_gap_nodes(
    first: int,
    levels: NodeLevels,
    rows: CutRows,
    values: wp.array(dtype=wp.vec3),
    least: float,
    flags: wp.array(dtype=int),
    count: wp.array(dtype=int),
):
    """flags (nodes of rings 0 and 1,): 1 at narrow gaps over which `values` (nodes,) differ by more than `least`;
    count (1,) is above 0 where there are any."""
    # Items of a CPU launch that is cut over threads may miss each other's additions to count.
    n = first + wp.tid()
    section = ring_section(levels)
    if n >= levels.starts[section + 2] - levels.starts[section]:
        if n < flags.shape[0]:
            flags[n] = 0
        return
    flag = int(0)
    node = levels.nodes[levels.starts[section] + n]
    parts = far_side(levels, rows, node)
    if parts[0] != 0:
        jump = mean_around(levels, values, node, parts[0]) - mean_around(levels, values, node, parts[1])
        if wp.length(jump) > least:
            flag = 1
            wp.atomic_add(count, 0, 1)
    flags[n] = flag


@wp.kernel
def confirm_narrow(
    first: int,
    crossings: LineCrossings,
    levels: NodeLevels,
    values: wp.array(dtype=wp.vec3),
    narrow: wp.array(dtype=int),
):
    """narrow (1,): from 1, where the lattice has links that leave the cage and enter it again, to 2 where the map jumps
    over one. One item per cut node of level 0."""
    if narrow[0] == 0:
        return
    row = first + wp.tid()
    section = cut_section(levels)
    if row >= levels.starts[section + 1] - levels.starts[section]:
        return
    node = levels.nodes[levels.starts[section] + row]
    p = node_place(levels, 0, node)
    for direction in range(6):
        other = node + node_step(levels, direction)
        if levels.codes[other] >= 0 and wp.length(values[other] - values[node]) > GAP_JUMP:
            if exit_distance(crossings, direction / 2, direction % 2 == 1, p[0], p[1], p[2]) < 1.0:
                narrow[0] = 2
