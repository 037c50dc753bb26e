"""Multigrid for the Laplace equation inside a cage: three channels at a time, on lists of inside nodes."""

# V-cycles of red-black Gauss-Seidel, full weighting and trilinear prolongation (Brandt 1977; Briggs, Henson and
# McCormick, "A Multigrid Tutorial") for the rows of cut_rows.py. On level l the row at node 0 is
#   sum over uncut links u_k - d u_0 + b = 0,    d = 6, or the sum of 1 / theta at a cut node
# with b the boundary values' sources on level 0 (in an adjoint solution: a load at every node) and 4 times the
# restricted residual on coarser ones (the spacing doubles), where the correction's boundary values are zero. A sweep is
# red nodes, then black ones, whose residual it leaves zero: only red residuals are restricted, only black nodes need
# the correction, and residuals lie in the red values' place meanwhile. Coarser levels begin at zero: their first half
# sweep is load / d. The half sweep that ends a cycle begins the next one: what it changes is the residual.
# values (nodes of all levels,) vec3, zero outside. A launch writes one colour and reads the other. Kernels take counts
# from the device: launches may be longer than the list, so one CUDA graph serves poses with different counts. A CPU
# takes what is the same for neighbours in a list from C++, with the same sums, to the bit; CUDA has an item a node.

import warp as wp

from ..core.gradients import forward
from ..core.lanes import lane_count, largest_of_lanes
from ..core.variants import native_source
from .cut_rows import CutRows
from .nodes import OUTSIDE, NodeLevels, node_place

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Diagonal above which a node counts as lying on the cage: a fraction of about 0.002 of a cell.
LARGEST_DIAGONAL = wp.constant(500.0)


@wp.struct
class LaplaceSystem:
    levels: NodeLevels
    rows: CutRows
    sources: wp.array(dtype=wp.vec3)  # (rows of level 0,)
    loads: wp.array(dtype=wp.vec3)  # (nodes of levels 1 and up,) loads of the equations of the correction
    values: wp.array(dtype=wp.vec3)  # (nodes of all levels,) solution on level 0, corrections above
    is_loaded: int  # 1: every row of level 0 has a load, loads (nodes of all levels,), in place of the sources


@wp.func
def first_loaded(system: LaplaceSystem):
    """The node of loads[0]."""
    return wp.where(system.is_loaded == 1, 0, system.levels.first_node[1])


@wp.func
def right_side(system: LaplaceSystem, level: int, node: int, code: int):
    """b of a node's row."""
    if level > 0 or system.is_loaded == 1:
        return system.loads[node - first_loaded(system)]
    if code >= 0:
        return system.sources[code]
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def link_sum(system: LaplaceSystem, level: int, node: int, code: int):
    """Sum of the values at the ends of a node's uncut links."""
    shape = system.levels.shapes[level]
    row = shape[2]
    slab = shape[1] * shape[2]
    if code < 0:
        return (
            system.values[node - slab]
            + system.values[node + slab]
            + system.values[node - row]
            + system.values[node + row]
            + system.values[node - 1]
            + system.values[node + 1]
        )
    links = system.rows.links[code]
    total = wp.vec3(0.0, 0.0, 0.0)
    if links & 1:
        total += system.values[node - slab]
    if links & 2:
        total += system.values[node + slab]
    if links & 4:
        total += system.values[node - row]
    if links & 8:
        total += system.values[node + row]
    if links & 16:
        total += system.values[node - 1]
    if links & 32:
        total += system.values[node + 1]
    return total


@wp.func
def diagonal(system: LaplaceSystem, code: int):
    """d of a node's row."""
    if code < 0:
        return float(6.0)
    return system.rows.diagonals[code]


@wp.func
def residual(system: LaplaceSystem, level: int, node: int):
    """Residual of a node's row; zero at outside nodes and at nodes that lie almost on the cage."""
    code = system.levels.codes[node]
    d = float(0.0)
    if code > OUTSIDE:
        d = diagonal(system, code)
    if d == 0.0 or d > LARGEST_DIAGONAL:  # near the cage rows hold rounding errors over theta, a load to coarse levels
        return wp.vec3(0.0, 0.0, 0.0)
    return right_side(system, level, node, code) + link_sum(system, level, node, code) - d * system.values[node]


@wp.func
def relaxed_value(system: LaplaceSystem, level: int, node: int):
    """Solution of a node's row for its own value."""
    code = system.levels.codes[node]
    total = right_side(system, level, node, code) + link_sum(system, level, node, code)
    return total / diagonal(system, code)


@forward.func_native(native_source(__file__, "cpp/regular_run.h"))
def regular_run(
    codes: wp.array(dtype=int),
    nodes: wp.array(dtype=int),
    values: wp.array(dtype=wp.vec3),
    loads: wp.array(dtype=wp.vec3),
    shape: wp.vec3i,
    first_loaded: int,
    begin: int,
    end: int,
    leaves: int,
    measures: int,
) -> wp.vec2:
    """On a CPU, relax nodes of the list from `begin` on, or leave residuals, while they are regular ones of a row.
    Returns how many, none on CUDA, and what changed most. first_loaded: the node of loads[0], -1 without loads."""
    ...


@wp.func
def swept_run(system: LaplaceSystem, level: int, begin: int, end: int, leaves: int, measures: int):
    """regular_run on a level."""
    loaded = int(-1)
    if level > 0 or system.is_loaded == 1:
        loaded = first_loaded(system)
    levels = system.levels
    shape = levels.shapes[level]
    return regular_run(
        levels.codes, levels.nodes, system.values, system.loads, shape, loaded, begin, end, leaves, measures
    )


@wp.func
def restricted_load(system: LaplaceSystem, level: int, node: int):
    """Load of a node of `level` (1 and up) by full weighting from the level below, whose red values are residuals."""
    p = node_place(system.levels, level, node)
    shape = system.levels.shapes[level - 1]
    row = shape[2]
    slab = shape[1] * shape[2]
    center = system.levels.first_node[level - 1] + 2 * (p[0] * slab + p[1] * row + p[2])
    total = 4.0 * system.values[center]
    for s in range(-1, 2, 2):
        for t in range(-1, 2, 2):
            total += system.values[center + s * slab + t * row]
            total += system.values[center + s * slab + t]
            total += system.values[center + s * row + t]
    return total / 8.0  # weights 1/8 and 1/32, times 4 for the doubled spacing


@wp.func
def take_load(system: LaplaceSystem, level: int, node: int, is_red: bool):
    """Restrict to a node of `level` (1 and up) and, where it is red, relax it from zero."""
    load = restricted_load(system, level, node)
    system.loads[node - first_loaded(system)] = load
    if is_red:
        system.values[node] = load / diagonal(system, system.levels.codes[node])


@wp.func
def prolonged_correction(system: LaplaceSystem, level: int, node: int):
    """Trilinear interpolation of the correction of level + 1 at a black node of `level`."""
    p = node_place(system.levels, level, node)
    shape = system.levels.shapes[level + 1]
    coarse = system.levels.first_node[level + 1] + ((p[0] / 2) * shape[1] + p[1] / 2) * shape[2] + p[2] / 2
    # an odd coordinate lies half way to the next coarse node; a black node has one or three of them
    di = (p[0] % 2) * shape[1] * shape[2]
    dj = (p[1] % 2) * shape[2]
    dk = p[2] % 2
    total = system.values[coarse] + system.values[coarse + di + dj + dk]
    if p[0] % 2 + p[1] % 2 + p[2] % 2 == 3:
        total += system.values[coarse + di] + system.values[coarse + dj] + system.values[coarse + dk]
        total += system.values[coarse + dj + dk] + system.values[coarse + di + dk] + system.values[coarse + di + dj]
        total = 0.25 * total
    return 0.5 * total


@forward.func_native(native_source(__file__, "cpp/restricted_run.h"))
def restricted_run(
    codes: wp.array(dtype=int),
    nodes: wp.array(dtype=int),
    diagonals: wp.array(dtype=float),
    values: wp.array(dtype=wp.vec3),
    loads: wp.array(dtype=wp.vec3),
    shape: wp.vec3i,
    fine_shape: wp.vec3i,
    first_node: int,
    first_fine: int,
    first_loaded: int,
    begin: int,
    black: int,
    end: int,
) -> int:
    """On a CPU, take_load for nodes of the list; returns how many. On CUDA none."""
    ...


@forward.func_native(native_source(__file__, "cpp/prolonged_run.h"))
def prolonged_run(
    nodes: wp.array(dtype=int),
    values: wp.array(dtype=wp.vec3),
    shape: wp.vec3i,
    coarse_shape: wp.vec3i,
    first_node: int,
    first_coarse: int,
    begin: int,
    end: int,
) -> wp.vec2:
    """On a CPU, add prolonged_correction to nodes of the list; returns how many, and the largest. On CUDA none."""
    ...


@wp.func
def corrected_run(system: LaplaceSystem, level: int, begin: int, end: int):
    """prolonged_run on a level."""
    levels = system.levels
    fine = levels.shapes[level]
    coarse = levels.shapes[level + 1]
    first_node = levels.first_node[level]
    first_coarse = levels.first_node[level + 1]
    return prolonged_run(levels.nodes, system.values, fine, coarse, first_node, first_coarse, begin, end)


@wp.func
def raise_largest(largest: wp.array(dtype=wp.vec2), item: int, found: wp.vec2):
    """Raise the entry of an item's group of lanes. Entries only grow, so looking at the entry first avoids most of
    the waiting. All lanes."""
    most = wp.vec2(largest_of_lanes(found[0]), largest_of_lanes(found[1]))
    lanes = lane_count()
    if item % lanes == 0:
        slot = (item / lanes) % largest.shape[0]
        held = largest[slot]
        if most[0] > held[0] or most[1] > held[1]:
            wp.atomic_max(largest, slot, most)


@wp.kernel
def relax_laplace(first: int, span: int, level: int, color: int, system: LaplaceSystem):
    """Half a Gauss-Seidel sweep: solve the rows of one colour for their own node. An item takes `span` nodes."""
    n = system.levels.starts[2 * level + color] + (first + wp.tid()) * span
    end = wp.min(n + span, system.levels.starts[2 * level + color + 1])
    while n < end:
        run = swept_run(system, level, n, end, 0, 0)
        n += int(run[0])
        if n < end:
            node = system.levels.nodes[n]
            system.values[node] = relaxed_value(system, level, node)
            n += 1


@wp.kernel
def relax_and_measure(first: int, span: int, system: LaplaceSystem, largest: wp.array(dtype=wp.vec2)):
    """Relax the red nodes of level 0, and raise `largest` (slots,), first component, to what changes most.
    An item takes `span` nodes, and a group of lanes raises one entry. On a CPU there are as many items as entries."""
    item = first + wp.tid()
    begin = system.levels.starts[0]
    worst = float(0.0)
    n = begin + item * span
    end = wp.min(n + span, system.levels.starts[1])
    while n < end:
        run = swept_run(system, 0, n, end, 0, 1)
        worst = wp.max(worst, run[1])
        n += int(run[0])
        if n < end:
            node = system.levels.nodes[n]
            value = relaxed_value(system, 0, node)
            if diagonal(system, system.levels.codes[node]) <= LARGEST_DIAGONAL:
                worst = wp.max(worst, wp.max(wp.abs(value - system.values[node])))
            system.values[node] = value
            n += 1
    raise_largest(largest, item, wp.vec2(worst, 0.0))


@wp.kernel
def leave_residual(first: int, span: int, level: int, system: LaplaceSystem):
    """Put the residuals of the red nodes of a level in the place of their values. An item takes `span` nodes."""
    n = system.levels.starts[2 * level] + (first + wp.tid()) * span
    end = wp.min(n + span, system.levels.starts[2 * level + 1])
    while n < end:
        run = swept_run(system, level, n, end, 1, 0)
        n += int(run[0])
        if n < end:
            node = system.levels.nodes[n]
            system.values[node] = residual(system, level, node)
            n += 1


@wp.kernel
def restrict_residual(first: int, span: int, level: int, system: LaplaceSystem):
    """Loads of `level` (1 and up), and its first half sweep. An item takes `span` nodes."""
    levels = system.levels
    black = levels.starts[2 * level + 1]
    n = levels.starts[2 * level] + (first + wp.tid()) * span
    end = wp.min(n + span, levels.starts[2 * level + 2])
    n += restricted_run(
        levels.codes,
        levels.nodes,
        system.rows.diagonals,
        system.values,
        system.loads,
        levels.shapes[level],
        levels.shapes[level - 1],
        levels.first_node[level],
        levels.first_node[level - 1],
        first_loaded(system),
        n,
        black,
        end,
    )
    while n < end:
        take_load(system, level, levels.nodes[n], n < black)
        n += 1


@wp.kernel
def prolong_correction(first: int, span: int, level: int, system: LaplaceSystem):
    """Add the correction of level + 1 to the black nodes of `level`. An item takes `span` nodes."""
    n = system.levels.starts[2 * level + 1] + (first + wp.tid()) * span
    end = wp.min(n + span, system.levels.starts[2 * level + 2])
    n += int(corrected_run(system, level, n, end)[0])
    while n < end:
        node = system.levels.nodes[n]
        system.values[node] = system.values[node] + prolonged_correction(system, level, node)
        n += 1


@wp.kernel
def prolong_and_measure(first: int, span: int, system: LaplaceSystem, largest: wp.array(dtype=wp.vec2)):
    """prolong_correction on level 0; the second component of `largest` rises to the largest correction (see
    relax_and_measure)."""
    item = first + wp.tid()
    begin = system.levels.starts[1]
    n = begin + item * span
    end = wp.min(n + span, system.levels.starts[2])
    run = corrected_run(system, 0, n, end)
    worst = run[1]
    n += int(run[0])
    while n < end:
        node = system.levels.nodes[n]
        correction = prolonged_correction(system, 0, node)
        worst = wp.max(worst, wp.max(wp.abs(correction)))
        system.values[node] = system.values[node] + correction
        n += 1
    raise_largest(largest, item, wp.vec2(0.0, worst))


@wp.kernel
def begin_cycles(
    first: int, going: wp.array(dtype=int), status: wp.array(dtype=float), largest: wp.array(dtype=wp.vec2)
):
    """going (1,) becomes 1, status (cycles, residual) and largest (slots,) zero. One item per slot."""
    item = first + wp.tid()
    largest[item] = wp.vec2(0.0, 0.0)
    if item == 0:
        going[0] = 1
        status[0] = 0.0
        status[1] = 0.0


@wp.kernel
def judge_cycle(
    first: int,
    per_residual: float,
    per_correction: float,
    tolerance: float,
    most_cycles: int,
    largest: wp.array(dtype=wp.vec2),
    going: wp.array(dtype=int),
    status: wp.array(dtype=float),
):
    """Count a cycle and work out what is left after it; going (1,) becomes 0 where that is within the tolerance, and
    largest zero. One group of lanes."""
    item = first + wp.tid()
    own = wp.vec2(0.0, 0.0)
    for n in range(item, largest.shape[0], lane_count()):
        own = wp.max(own, largest[n])
        largest[n] = wp.vec2(0.0, 0.0)
    left = wp.max(per_residual * largest_of_lanes(own[0]), per_correction * largest_of_lanes(own[1]))
    if item == 0:
        status[0] = status[0] + 1.0
        status[1] = left
        going[0] = wp.where(left > tolerance and status[0] < float(most_cycles), 1, 0)
