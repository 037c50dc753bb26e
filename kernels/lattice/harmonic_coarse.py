"""The coarse levels of a multigrid cycle in one launch of one block of threads."""

# They hold too few nodes to fill a device: a launch per sweep would cost more than the sweep. Threads share a colour's
# nodes and wait between colours (one does all on a CPU). A half sweep takes as long as a value from memory and back: a
# thread with at most two nodes of a colour looks their rows up once per level, and half sweeps read neighbours only.

import warp as wp

from ..core.gradients import forward_only_in
from .harmonic import (
    LARGEST_DIAGONAL,
    LaplaceSystem,
    diagonal,
    first_loaded,
    prolonged_correction,
    relaxed_value,
    residual,
    take_load,
)

#: Threads of the one block on CUDA.
BLOCK_THREADS = 768
wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": BLOCK_THREADS})

forward_only = forward_only_in(__name__, (wp.array(dtype=wp.vec3),))
_Ends = wp.types.vector(length=6, dtype=int)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block(): ...


@wp.struct
class HeldRow:
    """The row of one node."""

    node: int  # -1 for none
    load: wp.vec3
    diagonal: float
    ends: _Ends  # nodes at the ends of its links; of those that the cage cuts, a corner of the lattice, which is zero


@wp.func
def held_row(system: LaplaceSystem, level: int, color: int, item: int):
    """Row of a node of a colour, where there are that many."""
    result = HeldRow()
    result.node = -1
    n = system.levels.starts[2 * level + color] + item
    if n < system.levels.starts[2 * level + color + 1]:
        node = system.levels.nodes[n]
        code = system.levels.codes[node]
        shape = system.levels.shapes[level]
        links = int(63)
        if code >= 0:
            links = system.rows.links[code]
        result.node = node
        result.load = system.loads[node - first_loaded(system)]
        result.diagonal = diagonal(system, code)
        for d in range(6):
            step = wp.where(d < 2, shape[1] * shape[2], wp.where(d < 4, shape[2], 1))
            end = node + wp.where(d % 2 == 1, step, -step)
            result.ends[d] = wp.where((links >> d) & 1 == 1, end, system.levels.first_node[level])
    return result


@wp.func
def held_sum(system: LaplaceSystem, row: HeldRow):
    """Load and values at the ends of the links, added up in the order of harmonic.relaxed_value."""
    total = wp.vec3(0.0, 0.0, 0.0)
    for d in range(6):
        total += system.values[row.ends[d]]
    return row.load + total


@wp.func
def relax_held(system: LaplaceSystem, row: HeldRow):
    if row.node >= 0:
        system.values[row.node] = held_sum(system, row) / row.diagonal


@wp.func
def leave_held_residual(system: LaplaceSystem, row: HeldRow):
    if row.node >= 0:
        left = held_sum(system, row) - row.diagonal * system.values[row.node]
        system.values[row.node] = wp.where(row.diagonal > LARGEST_DIAGONAL, wp.vec3(0.0, 0.0, 0.0), left)


@wp.func
def sweep_level(
    system: LaplaceSystem, level: int, first_color: int, half_sweeps: int, leaves: bool, thread: int, threads: int
):
    """Half sweeps of the colours in turn; then, if `leaves`, residuals in the place of red values."""
    red = system.levels.starts[2 * level]
    black = system.levels.starts[2 * level + 1]
    end = system.levels.starts[2 * level + 2]
    if wp.max(black - red, end - black) <= 2 * threads:
        red_row = held_row(system, level, 0, thread)
        other_red_row = held_row(system, level, 0, thread + threads)
        black_row = held_row(system, level, 1, thread)
        other_black_row = held_row(system, level, 1, thread + threads)
        for half in range(half_sweeps):
            if (half + first_color) % 2 == 0:
                relax_held(system, red_row)
                relax_held(system, other_red_row)
            else:
                relax_held(system, black_row)
                relax_held(system, other_black_row)
            wait_for_block()
        if leaves:
            leave_held_residual(system, red_row)
            leave_held_residual(system, other_red_row)
            wait_for_block()
    else:
        for half in range(half_sweeps):
            section = 2 * level + (half + first_color) % 2
            n = system.levels.starts[section] + thread
            while n < system.levels.starts[section + 1]:
                node = system.levels.nodes[n]
                system.values[node] = relaxed_value(system, level, node)
                n += threads
            wait_for_block()
        if leaves:
            n = red + thread
            while n < black:
                node = system.levels.nodes[n]
                system.values[node] = residual(system, level, node)
                n += threads
            wait_for_block()
    forward_only(system.values)


@wp.kernel(launch_bounds=BLOCK_THREADS)
def cycle_coarse_levels(first: int, level: int, sweeps: int, coarsest_sweeps: int, threads: int, system: LaplaceSystem):
    """The part of a V-cycle on `level` (1 and up) and all coarser ones, from its loads and first half sweep to its
    corrections. One block of `threads` threads, one item per thread."""
    thread = wp.tid()
    last = system.levels.shapes.shape[0] - 1
    for visit in range(2 * (last - level) + 1):
        at = wp.min(level + visit, 2 * last - level - visit)
        if visit > last - level:  # on the way up
            n = system.levels.starts[2 * at + 1] + thread
            while n < system.levels.starts[2 * at + 2]:
                node = system.levels.nodes[n]
                system.values[node] = system.values[node] + prolonged_correction(system, at, node)
                n += threads
            wait_for_block()
            sweep_level(system, at, 0, 2 * sweeps, False, thread, threads)
        else:
            half_sweeps = wp.where(at == last, 2 * coarsest_sweeps, 2 * sweeps) - 1
            sweep_level(system, at, 1, half_sweeps, at < last, thread, threads)
            if at < last:
                n = system.levels.starts[2 * at + 2] + thread
                while n < system.levels.starts[2 * at + 4]:
                    is_red = n < system.levels.starts[2 * at + 3]
                    take_load(system, at + 1, system.levels.nodes[n], is_red)
                    n += threads
                wait_for_block()
