"""The coarse levels of a multigrid cycle in one launch of one block of threads.

They hold too few nodes to fill a device, so that a launch each sweep costs more than the sweep. The threads of the
block share the nodes of a colour and wait for each other between colours; on a CPU one thread does it all.
Siblings: harmonic.
"""

import warp as wp

from .harmonic import LaplaceSystem, prolonged_correction, relaxed_value, restricted_load

#: Threads of the one block on CUDA.
BLOCK_THREADS = 512

wp.set_module_options({"enable_backward": False, "block_dim": BLOCK_THREADS})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def wait_for_block(): ...


@wp.func
def relax_level(system: LaplaceSystem, level: int, sweeps: int, thread: int, threads: int):
    """Gauss-Seidel sweeps, red before black."""
    for half in range(2 * sweeps):
        section = 2 * level + half % 2
        n = system.levels.starts[section] + thread
        while n < system.levels.starts[section + 1]:
            node = system.levels.nodes[n]
            system.values[node] = relaxed_value(system, level, node)
            n += threads
        wait_for_block()


@wp.kernel
def cycle_coarse_levels(
    first: int, level: int, sweeps: int, coarsest_sweeps: int, threads: int, system: LaplaceSystem
):
    """The part of a V-cycle on `level` (1 and up) and all coarser ones: from its loads to its corrections.

    One block of `threads` threads, an item each.
    """
    thread = wp.tid()
    last = system.levels.shapes.shape[0] - 1
    for down in range(level, last):
        relax_level(system, down, sweeps, thread, threads)
        n = system.levels.starts[2 * down + 2] + thread
        while n < system.levels.starts[2 * down + 4]:
            node = system.levels.nodes[n]
            system.loads[node - system.levels.first_node[1]] = restricted_load(system, down + 1, node)
            n += threads
        wait_for_block()
    relax_level(system, last, coarsest_sweeps, thread, threads)
    for up in range(level, last):
        to = last - 1 - (up - level)
        n = system.levels.starts[2 * to + 1] + thread
        while n < system.levels.starts[2 * to + 2]:
            node = system.levels.nodes[n]
            system.values[node] = system.values[node] + prolonged_correction(system, to, node)
            n += threads
        wait_for_block()
        relax_level(system, to, sweeps, thread, threads)
