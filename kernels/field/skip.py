"""Distances that let a march jump over empty cells: a Chebyshev (L-infinity) distance transform of occupied cells."""

# The transform is separable: along each axis in turn, d(i) = min over j of max(|i - j|, d(j)).

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Distances are cut here: larger empty regions are crossed in several jumps.
SKIP_LIMIT = wp.constant(32)


@wp.kernel
def mark_cells(first: int, links: wp.array3d(dtype=wp.int32), distance: wp.array3d(dtype=wp.uint8)):
    """0 where any of a cell's eight nodes has a row, SKIP_LIMIT elsewhere. distance: (nx-1, ny-1, nz-1)."""
    n = first + wp.tid()
    k = n % distance.shape[2]
    j = (n // distance.shape[2]) % distance.shape[1]
    i = n // (distance.shape[2] * distance.shape[1])
    value = int(SKIP_LIMIT)
    for c in range(8):
        if links[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)] >= 0:
            value = int(0)
    distance[i, j, k] = wp.uint8(value)


@wp.kernel
def mark_matter(
    first: int,
    links: wp.array3d(dtype=wp.int32),
    density: wp.array(dtype=wp.float32),
    distance: wp.array3d(dtype=wp.uint8),
):
    """0 where any of a cell's eight nodes has a density above zero, SKIP_LIMIT elsewhere: no place in such a cell has
    one, as trilinear weights are not negative. distance: (nx-1, ny-1, nz-1)."""
    n = first + wp.tid()
    k = n % distance.shape[2]
    j = (n // distance.shape[2]) % distance.shape[1]
    i = n // (distance.shape[2] * distance.shape[1])
    value = int(SKIP_LIMIT)
    for c in range(8):
        row = links[i + (c >> 2), j + ((c >> 1) & 1), k + (c & 1)]
        if row >= 0:
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
    """Keep which densities (rows,) are above zero; `changed` (1,) becomes 1 where that is news."""
    n = first + wp.tid()
    value = wp.uint8(wp.where(density[n] > 0.0, 1, 0))
    if positive[n] != value:
        positive[n] = value
        # all items write the same number
        changed[0] = 1


@wp.kernel
def spread_distance(first: int, axis: int, source: wp.array3d(dtype=wp.uint8), distance: wp.array3d(dtype=wp.uint8)):
    """One pass of the transform along an axis."""
    n = first + wp.tid()
    k = n % source.shape[2]
    j = (n // source.shape[2]) % source.shape[1]
    i = n // (source.shape[2] * source.shape[1])
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
