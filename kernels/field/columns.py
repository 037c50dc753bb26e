"""The rows of a sparse voxel grid as bits: a table ten times smaller than links, and two nodes in one read."""

# A column (i, j) is cut into blocks of 31 nodes, each with the 32 bits of its nodes and the next block's first, and the
# number of rows before it: nodes k and k + 1 are always in one block. Rows are numbered anew, in memory order.

from typing import Any

import warp as wp

from ..core.lanes import grid_place
from ..core.variants import native_source

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

eight_rows = wp.types.vector(length=8, dtype=wp.int32)

#: Nodes of a block.
BLOCK_NODES = wp.constant(31)


#: C++ of functions that read the table: where a cell lies among the blocks of its columns; the bits and the first row
#: of one of its four columns.
CELL_PLACE = native_source(__file__, "cpp/cell_place.h")
COLUMN_ENTRY = """
        const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * block_width;
#if defined(__CUDA_ARCH__)
        const uint2 entry = __ldg(reinterpret_cast<const uint2*>(columns.blocks.data) + at);
        const unsigned bits = entry.x >> place;
        const int row = (int)entry.y + __popc(entry.x & low);
#else
        const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data) + 2 * (size_t)at;
        const unsigned bits = entry[0] >> place;
        const int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
#endif
"""


@wp.struct
class Columns:
    """Where the rows of a grid are."""

    node_counts: wp.vec3i
    blocks: wp.array2d(dtype=wp.vec2i)  # (nx * ny, blocks of a column) bits and first row
    order: wp.array(dtype=wp.int32)  # the grid's row of each row; none where they are the same


@wp.func_native(
    CELL_PLACE
    + """    wp::vec_t<8, wp::int32> rows;
#if defined(__CUDA_ARCH__)
    #pragma unroll
#endif
    for (int column = 0; column < 4; ++column)
    {
"""
    + COLUMN_ENTRY
    + """        rows.c[2 * column] = (bits & 1u) ? row : -1;
        rows.c[2 * column + 1] = (bits & 2u) ? row + (int)(bits & 1u) : -1;
    }
    return rows;
"""
)
def cell_rows(columns: Columns, i: wp.int32, j: wp.int32, k: wp.int32) -> eight_rows:
    """Rows of the eight nodes of the cell above node (i, j, k), -1 for none; corner c is at (c & 4, c & 2, c & 1)."""
    ...


@wp.func_native("""
    const int width = columns.blocks.shape[1];
    const int block = k / 31 < width ? k / 31 : width - 1;  // the last block has the last node of all
    const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data)
        + 2 * ((size_t)(i * columns.node_counts.c[1] + j) * width + block);
    const unsigned bit = 1u << (k - 31 * block), before = entry[0] & (bit - 1u);
    if (!(entry[0] & bit))
        return -1;
#if defined(__CUDA_ARCH__)
    return (int)entry[1] + __popc(before);
#else
    return (int)entry[1] + __builtin_popcount(before);
#endif
""")
def node_row(columns: Columns, i: wp.int32, j: wp.int32, k: wp.int32) -> wp.int32:
    """Row of a node, in memory order, -1 for none."""
    ...


@wp.kernel
def mark_blocks(
    first: int,
    values: wp.array3d(dtype=Any),
    least: int,
    running_count: wp.array(dtype=wp.int32),
    blocks: wp.array2d(dtype=wp.vec2i),
    nodes: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
):
    """Bits and first row of each block of a column, and the node of each row (rows,); one item per column.
    running_count: (nx * ny,) rows up to the end of each column; blocks: (nx * ny, blocks of a column)."""
    # rows are for values from `least` on; order: (rows,) those values, links, or empty
    n = first + wp.tid()
    i = n // values.shape[1]
    j = n % values.shape[1]
    row = int(0)
    if n > 0:
        row = running_count[n - 1]
    for block in range(blocks.shape[1]):
        begin = row
        bits = int(0)
        for place in range(BLOCK_NODES + 1):
            k = block * BLOCK_NODES + place
            if k < values.shape[2]:
                value = int(values[i, j, k])
                if value >= least:
                    bits = bits | (1 << place)
                    if place < BLOCK_NODES or k == values.shape[2] - 1:
                        nodes[row] = n * values.shape[2] + k
                        if order.shape[0] > 0:
                            order[row] = value
                        row += 1
        blocks[n, block] = wp.vec2i(bits, begin)


for number in (wp.uint8, wp.int32):
    wp.overload(mark_blocks, {"values": wp.array3d(dtype=number)})


@wp.kernel
def find_rows(first: int, columns: Columns, nodes: wp.array(dtype=wp.int32), rows: wp.array(dtype=wp.int32)):
    """Rows of nodes (n,), flat indices; -1 for those without."""
    n = first + wp.tid()
    i, j, k = grid_place(nodes[n], columns.node_counts[1], columns.node_counts[2])
    rows[n] = node_row(columns, i, j, k)


@wp.kernel
def find_unsorted(first: int, order: wp.array(dtype=wp.int32), unsorted: wp.array(dtype=wp.int32)):
    """Set `unsorted` (1,) to 1 where any row has another number in the grid."""
    n = first + wp.tid()
    if order[n] != n:
        unsorted[0] = 1


@wp.kernel
def link_rows(
    first: int, nodes: wp.array(dtype=wp.int32), order: wp.array(dtype=wp.int32), links: wp.array(dtype=wp.int32)
):
    """The grid's number of each row to its node. nodes: (rows,) of `mark_blocks`; order: of Columns; links: (all,)."""
    n = first + wp.tid()
    row = int(n)
    if order.shape[0] > 0:
        row = order[n]
    links[nodes[n]] = row
