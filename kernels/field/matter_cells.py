"""The cells of a grid that hold matter, with the densities of their corners side by side: for marches on a CPU."""

# A sample then waits for one line of the cache instead of up to eight. Which cells hold matter is told by bits along
# the last axis, 32 cells a block, beside the number of the block's first record.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Cells of a block.
BLOCK_CELLS = wp.constant(32)

#: Densities that one item compares.
COMPARED_VALUES = wp.constant(1024)


@wp.struct
class MatterCells:
    """Where the densities of cells that hold matter are."""

    blocks: wp.array2d(dtype=wp.vec2i)  # (columns, blocks of a column) bits and first record; column i * ny + j
    densities: wp.array2d(dtype=wp.float32)  # (records, 8) corner c at (c & 2, c & 1, c & 4)


@wp.kernel
def count_cells(first: int, skip: wp.array3d(dtype=wp.uint8), counts: wp.array(dtype=wp.int32)):
    """Cells of each column with `skip` 0. counts: (columns,)."""
    n = first + wp.tid()
    i = n // skip.shape[1]
    j = n % skip.shape[1]
    count = int(0)
    for k in range(skip.shape[2]):
        if skip[i, j, k] == wp.uint8(0):
            count += 1
    counts[n] = count


@wp.kernel
def gather_densities(
    first: int,
    links: wp.array3d(dtype=wp.int32),
    density: wp.array(dtype=wp.float32),
    skip: wp.array3d(dtype=wp.uint8),
    running_count: wp.array(dtype=wp.int32),
    blocks: wp.array2d(dtype=wp.vec2i),
    densities: wp.array2d(dtype=wp.float32),
):
    """Bits, first records and records of each column, one item per column; 0 where a corner has no row.
    running_count: (columns,) inclusive scan of count_cells."""
    n = first + wp.tid()
    i = n // skip.shape[1]
    j = n % skip.shape[1]
    record = int(0)
    if n > 0:
        record = running_count[n - 1]
    for block in range(blocks.shape[1]):
        begin = record
        bits = int(0)
        for place in range(BLOCK_CELLS):
            k = block * BLOCK_CELLS + place
            if k < skip.shape[2]:
                if skip[i, j, k] == wp.uint8(0):
                    bits = bits | (1 << place)
                    for c in range(8):
                        row = links[i + ((c >> 1) & 1), j + (c & 1), k + (c >> 2)]
                        value = float(0.0)
                        if row >= 0:
                            value = density[row]
                        densities[record, c] = value
                    record += 1
        blocks[n, block] = wp.vec2i(bits, begin)


@wp.func_native("""
    unsigned news = 0u;
    const unsigned* from = reinterpret_cast<const unsigned*>(density.data);
    unsigned* to = reinterpret_cast<unsigned*>(kept.data);
    for (int n = begin; n < end; ++n)
        news |= from[n] ^ to[n];
    if (news == 0u)
        return 0;
    for (int n = begin; n < end; ++n)
        to[n] = from[n];
    return 1;
""")
def take_news(density: wp.array(dtype=wp.float32), kept: wp.array(dtype=wp.float32), begin: int, end: int) -> int:
    """Copy a run of values where any bit of them differs; whether that was so."""
    ...


@wp.kernel
def note_densities(
    first: int, density: wp.array(dtype=wp.float32), kept: wp.array(dtype=wp.float32), changed: wp.array(dtype=wp.int32)
):
    """Keep the densities (rows,), COMPARED_VALUES an item; `changed` (1,) becomes 1 where one is news."""
    begin = (first + wp.tid()) * COMPARED_VALUES
    if take_news(density, kept, begin, wp.min(begin + COMPARED_VALUES, density.shape[0])) == 1:
        # all items write the same number
        changed[0] = 1
