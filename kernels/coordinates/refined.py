"""Weights of the vertices of a refined surface as weights of the vertices that it follows from."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def merge_rows(
    first: int,
    rows: wp.array2d(dtype=Any),
    starts: wp.array(dtype=int),
    which: wp.array(dtype=int),
    shares: wp.array(dtype=Any),
    surface_count: int,
    merged: wp.array2d(dtype=Any),
):
    """merged (v + k, n): row j < v is the sum of rows `which` by `shares`, from starts[j] to starts[j + 1]; the last k
    are those behind the `surface_count` vertices of rows (surface_count + k, n)."""
    n = first + wp.tid()
    count = starts.shape[0] - 1
    for j in range(count):
        total = shares[starts[j]] * rows[which[starts[j]], n]
        for k in range(starts[j] + 1, starts[j + 1]):
            total += shares[k] * rows[which[k], n]
        merged[j, n] = merged.dtype(total)
    for j in range(count, merged.shape[0]):
        merged[j, n] = merged.dtype(rows[j - count + surface_count, n])


for sums, shares, kept in (
    (wp.float32, wp.float32, wp.float32),
    (wp.vec4, wp.float32, wp.vec4),
    (wp.float64, wp.float64, wp.float32),
    (wp.vec4d, wp.float64, wp.vec4),
):
    arrays = {"rows": wp.array2d(dtype=sums), "shares": wp.array(dtype=shares), "merged": wp.array2d(dtype=kept)}
    wp.overload(merge_rows, arrays)
