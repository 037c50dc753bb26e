"""Distances that let a march jump over empty cells: a Chebyshev (L-infinity) distance transform of occupied cells."""

import warp as wp

from ..core.gradients import forward
from ..core.lanes import grid_place
from .columns import Columns, cell_rows

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
    running_count: (columns,) inclusive scan of how many cells of each have `skip` 0."""
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


@forward.func_native("""
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
    """Copy a run of values if any bit differs, and return whether one did."""
    ...


@wp.kernel
def note_densities(
    first: int, density: wp.array(dtype=wp.float32), kept: wp.array(dtype=wp.float32), changed: wp.array(dtype=wp.int32)
):
    """Keep the densities (rows,), COMPARED_VALUES an item; `changed` (1,) becomes 1 where one differs."""
    begin = (first + wp.tid()) * COMPARED_VALUES
    if take_news(density, kept, begin, wp.min(begin + COMPARED_VALUES, density.shape[0])) == 1:
        changed[0] = 1  # all items write the same number


#: Distances are cut here: larger empty regions are crossed in several jumps.
SKIP_LIMIT = wp.constant(32)


@wp.kernel
def mark_cells(first: int, links: wp.array3d(dtype=wp.int32), distance: wp.array3d(dtype=wp.uint8)):
    """0 where any of a cell's eight nodes has a row, SKIP_LIMIT elsewhere. distance: (nx-1, ny-1, nz-1)."""
    i, j, k = grid_place(first + wp.tid(), distance.shape[1], distance.shape[2])
    value = int(SKIP_LIMIT)
    for c in range(8):
        if links[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)] >= 0:
            value = int(0)
    distance[i, j, k] = wp.uint8(value)


@wp.kernel
def mark_column_cells(first: int, columns: Columns, distance: wp.array3d(dtype=wp.uint8)):
    """As mark_cells, of the rows of a table."""
    i, j, k = grid_place(first + wp.tid(), distance.shape[1], distance.shape[2])
    rows = cell_rows(columns, i, j, k)
    value = int(SKIP_LIMIT)
    for c in range(8):
        if rows[c] >= 0:
            value = int(0)
    distance[i, j, k] = wp.uint8(value)


@wp.kernel
def mark_matter(
    first: int, columns: Columns, density: wp.array(dtype=wp.float32), distance: wp.array3d(dtype=wp.uint8)
):
    """0 where any of a cell's eight nodes has a density above zero, SKIP_LIMIT elsewhere: no place in such a cell has
    one, as trilinear weights are not negative. distance: (nx-1, ny-1, nz-1)."""
    i, j, k = grid_place(first + wp.tid(), distance.shape[1], distance.shape[2])
    value = int(SKIP_LIMIT)
    rows = cell_rows(columns, i, j, k)
    for c in range(8):
        row = rows[c]
        if row >= 0:
            if columns.order.shape[0] > 0:
                row = columns.order[row]
            if density[row] > 0.0:
                value = int(0)
    distance[i, j, k] = wp.uint8(value)


@wp.kernel
def note_signs(
    first: int,
    density: wp.array(dtype=wp.float32),
    positive: wp.array(dtype=wp.uint8),
    changed: wp.array(dtype=wp.int32),
):
    """Keep which densities (rows,) are above zero; `changed` (1,) becomes 1 where a sign differs."""
    n = first + wp.tid()
    value = wp.uint8(wp.where(density[n] > 0.0, 1, 0))
    if positive[n] != value:
        positive[n] = value
        changed[0] = 1  # all items write the same number


@wp.kernel
def spread_distance(first: int, axis: int, source: wp.array3d(dtype=wp.uint8), distance: wp.array3d(dtype=wp.uint8)):
    """One pass of the transform along an axis."""
    i, j, k = grid_place(first + wp.tid(), source.shape[1], source.shape[2])
    best = int(source[i, j, k])
    step = int(1)
    while step < best:
        for side in range(2):
            offset = wp.where(side == 0, -step, step)
            a = i + wp.where(axis == 0, offset, 0)
            b = j + wp.where(axis == 1, offset, 0)
            c = k + wp.where(axis == 2, offset, 0)
            if a >= 0 and b >= 0 and c >= 0 and a < source.shape[0] and b < source.shape[1] and c < source.shape[2]:
                best = wp.min(best, wp.max(step, int(source[a, b, c])))
        step += 1
    distance[i, j, k] = wp.uint8(best)


@wp.func_native("""
    const int nx = source.shape[0], ny = source.shape[1], nz = source.shape[2];
    const unsigned char* line = source.data + (size_t)(i * ny + j) * nz;
    unsigned char* best = distance.data + (size_t)(i * ny + j) * nz;
    for (int k = 0; k < nz; ++k)
        best[k] = line[k];
    auto take = [&](const unsigned char* other, int from, int to, int step) {
        for (int k = from; k < to; ++k)
        {
            const unsigned char reach = other[k] > step ? other[k] : (unsigned char)step;
            best[k] = reach < best[k] ? reach : best[k];
        }
    };
    for (int step = 1; step < 255; ++step)
    {
        int farthest = 0;
        for (int k = 0; k < nz; ++k)
            farthest = best[k] > farthest ? best[k] : farthest;
        if (step >= farthest)
            return;
        if (axis == 2)
        {
            take(line - step, step, nz, step);
            take(line + step, 0, nz - step, step);
            continue;
        }
        const int place = axis == 0 ? i : j, count = axis == 0 ? nx : ny;
        const long long stride = (long long)(axis == 0 ? ny : 1) * nz * step;
        if (place >= step)
            take(line - stride, 0, nz, step);
        if (place + step < count)
            take(line + stride, 0, nz, step);
    }
""")
def spread_line(axis: int, source: wp.array3d(dtype=wp.uint8), i: int, j: int, distance: wp.array3d(dtype=wp.uint8)):
    """spread_distance for the cells (i, j, k) of all k, in arrays without gaps."""
    ...


@wp.kernel
def spread_lines(first: int, axis: int, source: wp.array3d(dtype=wp.uint8), distance: wp.array3d(dtype=wp.uint8)):
    """As spread_distance, one item per line along the last axis: what a CPU does many cells at once."""
    n = first + wp.tid()
    spread_line(axis, source, n // source.shape[1], n % source.shape[1], distance)
