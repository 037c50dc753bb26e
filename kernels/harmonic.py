"""Multigrid for the Laplace equation inside a cage: three channels at a time, on lists of inside nodes.

V-cycles of red-black Gauss-Seidel, full weighting and trilinear prolongation (Brandt 1977; Briggs, Henson and
McCormick, "A Multigrid Tutorial") for the rows of harmonic_rows. On level l the row at node 0 is

    sum over uncut links u_k - d u_0 + b = 0,    d = 6, or the sum of 1 / theta at a cut node

with b the boundary values' sources on level 0 and 4 times the restricted residual on coarser ones (the spacing
doubles), where the boundary values of the correction are zero. After a sweep that ends with black nodes their
residual is zero, so only red ones are restricted; and as the next sweep starts with red ones, only black ones need
the correction.

values (nodes of all levels,) vec3, as numbered by node_levels; zero outside. A launch writes nodes of one colour and
reads the other, so items are independent. Every kernel takes its count from the device: launches may be longer than
the list, which lets one CUDA graph serve poses with different counts.
Siblings: node_levels, harmonic_rows. The levels with few nodes go through one launch in harmonic_coarse.
"""

import warp as wp

from .harmonic_rows import CutRows
from .node_levels import OUTSIDE, NodeLevels, node_place

wp.set_module_options({"enable_backward": False})

#: Diagonal above which a node counts as lying on the cage: a fraction of about 0.002 of a cell.
LARGEST_DIAGONAL = wp.constant(500.0)


@wp.struct
class LaplaceSystem:
    levels: NodeLevels
    rows: CutRows
    sources: wp.array(dtype=wp.vec3)  # (rows of level 0,)
    loads: wp.array(dtype=wp.vec3)  # (nodes of levels 1 and up,) right-hand side of the correction
    values: wp.array(dtype=wp.vec3)  # (nodes of all levels,) solution on level 0, corrections above


@wp.func
def right_side(system: LaplaceSystem, level: int, node: int, code: int):
    """b of a node's row."""
    if level > 0:
        return system.loads[node - system.levels.first_node[1]]
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
            system.values[node - slab] + system.values[node + slab]
            + system.values[node - row] + system.values[node + row]
            + system.values[node - 1] + system.values[node + 1]
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
    """What is left of a node's row; zero at outside nodes and at nodes that all but lie on the cage.

    The rows of the latter hold 1 / theta times rounding, which coarse levels would take for a load.
    """
    code = system.levels.codes[node]
    d = float(0.0)
    if code > OUTSIDE:
        d = diagonal(system, code)
    if d == 0.0 or d > LARGEST_DIAGONAL:
        return wp.vec3(0.0, 0.0, 0.0)
    return right_side(system, level, node, code) + link_sum(system, level, node, code) - d * system.values[node]


@wp.func
def relaxed_value(system: LaplaceSystem, level: int, node: int):
    """Solution of a node's row for its own value."""
    code = system.levels.codes[node]
    total = right_side(system, level, node, code) + link_sum(system, level, node, code)
    return total / diagonal(system, code)


@wp.func
def restricted_load(system: LaplaceSystem, level: int, node: int):
    """Load of a node of `level` (1 and up) from the residuals of red nodes of the level below, by full weighting."""
    p = node_place(system.levels, level, node)
    shape = system.levels.shapes[level - 1]
    row = shape[2]
    slab = shape[1] * shape[2]
    centre = system.levels.first_node[level - 1] + 2 * (p[0] * slab + p[1] * row + p[2])
    total = 4.0 * residual(system, level - 1, centre)
    for s in range(-1, 2, 2):
        for t in range(-1, 2, 2):
            total += residual(system, level - 1, centre + s * slab + t * row)
            total += residual(system, level - 1, centre + s * slab + t)
            total += residual(system, level - 1, centre + s * row + t)
    # weights 1/8 and 1/32, times 4 for the doubled spacing
    return total / 8.0


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


@wp.kernel
def relax_laplace(first: int, level: int, colour: int, system: LaplaceSystem):
    """Half a Gauss-Seidel sweep: solve the rows of one colour for their own node."""
    n = first + wp.tid()
    begin = system.levels.starts[2 * level + colour]
    if n >= system.levels.starts[2 * level + colour + 1] - begin:
        return
    node = system.levels.nodes[begin + n]
    system.values[node] = relaxed_value(system, level, node)


@wp.kernel
def restrict_residual(first: int, level: int, system: LaplaceSystem):
    """Loads of `level` (1 and up)."""
    n = first + wp.tid()
    begin = system.levels.starts[2 * level]
    if n >= system.levels.starts[2 * level + 2] - begin:
        return
    node = system.levels.nodes[begin + n]
    system.loads[node - system.levels.first_node[1]] = restricted_load(system, level, node)


@wp.kernel
def prolong_correction(first: int, level: int, system: LaplaceSystem):
    """Add the correction of level + 1 to the black nodes of `level`."""
    n = first + wp.tid()
    begin = system.levels.starts[2 * level + 1]
    if n >= system.levels.starts[2 * level + 2] - begin:
        return
    node = system.levels.nodes[begin + n]
    system.values[node] = system.values[node] + prolonged_correction(system, level, node)


@wp.kernel
def clear_corrections(first: int, system: LaplaceSystem):
    """Zero the values of level 1 and up. One item a node."""
    node = system.levels.first_node[1] + first + wp.tid()
    if node < system.levels.first_node[system.levels.shapes.shape[0]]:
        system.values[node] = wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def measure_residual(first: int, items: int, system: LaplaceSystem, largest: wp.array(dtype=wp.vec2)):
    """Largest residual over diagonal on level 0, and largest correction on level 1; zero before.

    Each of `items` items visits the lists in steps of `items` and raises entry (item % slots) of largest (slots,).
    Items that share a slot may not run on two threads of a CPU.
    """
    item = first + wp.tid()
    worst = float(0.0)
    n = system.levels.starts[0] + item
    while n < system.levels.starts[1]:
        node = system.levels.nodes[n]
        scaled = residual(system, 0, node) / diagonal(system, system.levels.codes[node])
        worst = wp.max(worst, wp.max(wp.abs(scaled)))
        n += items
    change = float(0.0)
    if system.levels.shapes.shape[0] > 1:
        n = system.levels.starts[2] + item
        while n < system.levels.starts[4]:
            change = wp.max(change, wp.max(wp.abs(system.values[system.levels.nodes[n]])))
            n += items
    slot = item % largest.shape[0]
    held = largest[slot]
    # what is held only grows, so that a look spares most of the waiting
    if worst > held[0] or change > held[1]:
        wp.atomic_max(largest, slot, wp.vec2(worst, change))


@wp.kernel
def begin_cycles(
    first: int, going: wp.array(dtype=int), status: wp.array(dtype=float), largest: wp.array(dtype=wp.vec2)
):
    """going (1,) becomes 1, status (cycles, residual) and largest zero. One item."""
    going[0] = 1
    for n in range(2):
        status[n] = 0.0
    for n in range(largest.shape[0]):
        largest[n] = wp.vec2(0.0, 0.0)


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
    largest zero. One item."""
    worst = wp.vec2(0.0, 0.0)
    for n in range(largest.shape[0]):
        worst = wp.max(worst, largest[n])
        largest[n] = wp.vec2(0.0, 0.0)
    left = wp.max(per_residual * worst[0], per_correction * worst[1])
    status[0] = status[0] + 1.0
    status[1] = left
    going[0] = wp.where(left > tolerance and status[0] < float(most_cycles), 1, 0)
