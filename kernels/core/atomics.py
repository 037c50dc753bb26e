"""Sums that all lanes of a warp add to at once: those of the same place are added up among themselves first."""

# On CUDA lanes leave their numbers in shared memory, and each then adds up one number over the lanes of a group:
# requests are those of one row of memory for each group, not one a number and lane, which bound such sums. Lanes that
# are elsewhere take no part. On a CPU an item adds by itself, to what its thread alone adds to.

import warp as wp

from .gradients import forward

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Threads of a block, at most, of kernels that add so.
BLOCK_THREADS = 64

#: C++ that leaves the `held` numbers of each lane, an array `own`, and visits groups of lanes of one `key`: `group`, by
#: its bits, `leader`, its first lane. A lane then takes every `size`-th number, from `rank` on; those of
#: lane l begin at `kept[l * stride]`.
GROUPS = """
    const int stride = {stride};
    __shared__ float memory[{threads} * stride];
    float* const kept = memory + (threadIdx.x & {warps} & ~31) * stride;
    const unsigned active = __activemask(), lane = threadIdx.x & 31;
    for (int n = 0; n < {held}; ++n)
        kept[lane * stride + n] = own[n];
    const unsigned peers = __match_any_sync(active, key);
    const int rank = __popc(active & ((1u << lane) - 1u)), size = __popc(active);
    __syncwarp(active);
    for (unsigned rest = active; rest;)
    {{
        const int leader = __ffs(rest) - 1;
        const unsigned group = __shfl_sync(active, peers, leader);
        rest &= ~group;
"""


def lane_groups(held: int) -> str:
    """The beginning of a visit of all groups, of `held` numbers a lane; the end is GROUPS_END."""
    # an odd stride: lanes read from different banks
    return GROUPS.format(threads=BLOCK_THREADS, warps=BLOCK_THREADS - 1, held=held, stride=held | 1)


GROUPS_END = """
    }
    __syncwarp(active);
"""

vec24 = wp.types.vector(length=24, dtype=wp.float32)


@forward.func_native(
    """
    const int ny = node_counts.c[1], nz = node_counts.c[2];
    float* const target = reinterpret_cast<float*>(sums.data);
#if defined(__CUDA_ARCH__)
    const float* own = values.c;
    const int key = node;
"""
    + lane_groups(24)
    + """
        const int base = __shfl_sync(active, node, leader);
        for (int n = rank; n < 24; n += size)
        {
            float total = 0.0f;
            for (unsigned left = group; left; left &= left - 1u)
                total += kept[(__ffs(left) - 1) * stride + n];
            const int corner = n / 3;
            const int place = base + ((corner >> 2) * ny + ((corner >> 1) & 1)) * nz + (corner & 1);
            atomicAdd(target + 3 * (size_t)place + n % 3, total);
        }
"""
    + GROUPS_END
    + """
#else
    for (int line = 0; line < 4; ++line)  // two neighbours, whose numbers follow each other
    {
        float* to = target + 3 * (size_t)(node + ((line >> 1) * ny + (line & 1)) * nz);
        for (int n = 0; n < 6; ++n)
            to[n] += values.c[6 * line + n];
    }
#endif
"""
)
def add_to_cell(sums: wp.array(dtype=wp.vec3), node: int, node_counts: wp.vec3i, values: vec24):
    """Add three numbers each to the eight nodes of the cell above a node; corner c is at (c & 4, c & 2, c & 1)."""
    ...
