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
Siblings: node_levels, harmonic_rows.
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


@wp.kernel
def relax_laplace(first: int, level: int, colour: int, system: LaplaceSystem):
    """Half a Gauss-Seidel sweep: solve the rows of one colour for their own node."""
    n = first + wp.tid()
    begin = system.levels.starts[2 * level + colour]
    if n >= system.levels.starts[2 * level + colour + 1] - begin:
        return
    node = system.levels.nodes[begin + n]
    code = system.levels.codes[node]
    total = right_side(system, level, node, code) + link_sum(system, level, node, code)
    system.values[node] = total / diagonal(system, code)


@wp.kernel
def restrict_residual(first: int, level: int, system: LaplaceSystem):
    """Loads of `level` (1 and up) from the residuals of red nodes of the level below, by full weighting."""
    n = first + wp.tid()
    begin = system.levels.starts[2 * level]
    if n >= system.levels.starts[2 * level + 2] - begin:
        return
    node = system.levels.nodes[begin + n]
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
    system.loads[node - system.levels.first_node[1]] = total / 8.0


@wp.kernel
def prolong_correction(first: int, level: int, system: LaplaceSystem):
    """Add the trilinear interpolation of the correction of level + 1 to the black nodes of `level`."""
    n = first + wp.tid()
    begin = system.levels.starts[2 * level + 1]
    if n >= system.levels.starts[2 * level + 2] - begin:
        return
    node = system.levels.nodes[begin + n]
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
    system.values[node] = system.values[node] + 0.5 * total


@wp.kernel
def clear_corrections(first: int, system: LaplaceSystem):
    """Zero the values of level 1 and up. One item a node."""
    node = system.levels.first_node[1] + first + wp.tid()
    if node < system.levels.first_node[system.levels.shapes.shape[0]]:
        system.values[node] = wp.vec3(0.0, 0.0, 0.0)


@wp.kernel
def measure_residual(first: int, system: LaplaceSystem, largest: wp.array(dtype=wp.vec2)):
    """Largest residual over diagonal on level 0, and largest correction on level 1, over every m-th listed node.

    Item n visits the lists from its n-th entry on in steps of m and writes largest[n], m = largest.shape[0].
    """
    item = first + wp.tid()
    worst = float(0.0)
    n = system.levels.starts[0] + item
    while n < system.levels.starts[1]:
        node = system.levels.nodes[n]
        scaled = residual(system, 0, node) / diagonal(system, system.levels.codes[node])
        worst = wp.max(worst, wp.max(wp.abs(scaled)))
        n += largest.shape[0]
    change = float(0.0)
    if system.levels.shapes.shape[0] > 1:
        n = system.levels.starts[2] + item
        while n < system.levels.starts[4]:
            change = wp.max(change, wp.max(wp.abs(system.values[system.levels.nodes[n]])))
            n += largest.shape[0]
    largest[item] = wp.vec2(worst, change)


@wp.kernel
def reduce_largest(first: int, largest: wp.array(dtype=wp.vec2), reduced: wp.array(dtype=wp.vec2)):
    """reduced (r,): componentwise largest of every r-th entry of largest (m,)."""
    item = first + wp.tid()
    worst = wp.vec2(0.0, 0.0)
    n = int(item)
    while n < largest.shape[0]:
        worst = wp.max(worst, largest[n])
        n += reduced.shape[0]
    reduced[item] = worst
