"""Prune, dilate and refine the nodes of a sparse voxel grid."""

from typing import Any

import warp as wp

from ..core.lanes import grid_place
from .grid import VoxelGrid, eight_rows, eight_weights

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def dilate_mask(first: int, source: wp.array3d(dtype=wp.uint8), mask: wp.array3d(dtype=wp.uint8)):
    """1 where any of a node's 27 neighbours is set."""
    i, j, k = grid_place(first + wp.tid(), mask.shape[1], mask.shape[2])
    value = wp.uint8(0)
    for a in range(wp.max(i - 1, 0), wp.min(i + 2, mask.shape[0])):
        for b in range(wp.max(j - 1, 0), wp.min(j + 2, mask.shape[1])):
            for c in range(wp.max(k - 1, 0), wp.min(k + 2, mask.shape[2])):
                if source[a, b, c] != wp.uint8(0):
                    value = wp.uint8(1)
    mask[i, j, k] = value


@wp.kernel
def mark_weighty_nodes(
    first: int,
    nodes: wp.array(dtype=wp.int32),
    weights: wp.array(dtype=wp.float32),
    threshold: float,
    mask: wp.array(dtype=wp.uint8),
):
    """1 at the nodes of rows whose recorded weight reaches a threshold; the rest of `mask` stays. nodes: (rows,) flat
    indices, as all below."""
    row = first + wp.tid()
    if weights[row] >= threshold:
        mask[nodes[row]] = wp.uint8(1)


@wp.kernel
def take_nodes(
    first: int, nodes: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.uint8), mask: wp.array(dtype=wp.uint8)
):
    """Copy a mask at the nodes of rows: dilation may not bring back what was pruned before."""
    row = first + wp.tid()
    mask[nodes[row]] = source[nodes[row]]


@wp.kernel
def refine_mask(first: int, ratio: wp.vec3, source: wp.array3d(dtype=wp.uint8), mask: wp.array3d(dtype=wp.uint8)):
    """Each finer voxel takes the value of the voxel that its center lies in; ratio: finer voxels per voxel, along each
    axis."""
    i, j, k = grid_place(first + wp.tid(), mask.shape[1], mask.shape[2])
    a = wp.min(int((float(i) + 0.5) / ratio[0]), source.shape[0] - 1)
    b = wp.min(int((float(j) + 0.5) / ratio[1]), source.shape[1] - 1)
    c = wp.min(int((float(k) + 0.5) / ratio[2]), source.shape[2] - 1)
    mask[i, j, k] = source[a, b, c]


@wp.kernel
def count_lines(first: int, values: wp.array3d(dtype=Any), least: int, most: int, counts: wp.array(dtype=wp.int32)):
    """How many values of each line (i, j) along the last axis are from `least` to `most`. counts: (nx * ny,)."""
    n = first + wp.tid()
    i = n // values.shape[1]
    j = n % values.shape[1]
    count = int(0)
    for k in range(values.shape[2]):
        value = int(values[i, j, k])
        if value >= least and value <= most:
            count += 1
    counts[n] = count


for number in (wp.uint8, wp.int32):
    wp.overload(count_lines, {"values": wp.array3d(dtype=number)})


@wp.kernel
def link_nodes(
    first: int,
    mask: wp.array3d(dtype=wp.uint8),
    running_count: wp.array(dtype=wp.int32),
    links: wp.array3d(dtype=wp.int32),
    nodes: wp.array(dtype=wp.int32),
):
    """Number the set nodes in memory order, one item per line. running_count: inclusive scan of the lines' counts.
    Without `links` or without `nodes`, only the other is written."""
    n = first + wp.tid()
    i = n // mask.shape[1]
    j = n % mask.shape[1]
    row = int(0)
    if n > 0:
        row = running_count[n - 1]
    for k in range(mask.shape[2]):
        link = int(-1)
        if mask[i, j, k] != wp.uint8(0):
            link = row
            if nodes:
                nodes[row] = n * mask.shape[2] + k
            row += 1
        if links:
            links[i, j, k] = link


@wp.kernel
def resample_rows(
    first: int,
    coarse: VoxelGrid,
    shape: wp.vec3i,
    nodes: wp.array(dtype=wp.int32),
    density: wp.array(dtype=wp.float32),
    sh: wp.array2d(dtype=wp.float32),
):
    """Values of nodes of a grid of a finer shape by trilinear interpolation among the coarse nodes that have rows
    (weights renormalised)."""
    row = first + wp.tid()
    x, y, z = grid_place(nodes[row], shape[1], shape[2])
    g = wp.vec3(float(x), float(y), float(z)) + wp.vec3(0.5, 0.5, 0.5)
    ratio = wp.vec3()
    for axis in range(3):
        ratio[axis] = float(shape[axis]) / float(coarse.links.shape[axis])
    g = wp.cw_div(g, ratio) - wp.vec3(0.5, 0.5, 0.5)
    total = float(0.0)
    value = float(0.0)
    rows = eight_rows()
    weights = eight_weights()
    i = int(wp.floor(g[0]))
    j = int(wp.floor(g[1]))
    k = int(wp.floor(g[2]))
    for c in range(8):
        a = wp.clamp(i + (c >> 2), 0, coarse.links.shape[0] - 1)
        b = wp.clamp(j + ((c >> 1) & 1), 0, coarse.links.shape[1] - 1)
        d = wp.clamp(k + (c & 1), 0, coarse.links.shape[2] - 1)
        wx = wp.where((c >> 2) == 1, g[0] - float(i), 1.0 - g[0] + float(i))
        wy = wp.where(((c >> 1) & 1) == 1, g[1] - float(j), 1.0 - g[1] + float(j))
        wz = wp.where((c & 1) == 1, g[2] - float(k), 1.0 - g[2] + float(k))
        other = coarse.links[a, b, d]
        weight = wx * wy * wz
        rows[c] = -1
        if other >= 0 and weight > 0.0:
            total += weight
            value += weight * coarse.density[other]
            rows[c] = other
            weights[c] = weight
    scale = wp.where(total > 0.0, 1.0 / wp.max(total, 1.0e-12), 0.0)
    density[row] = scale * value
    for number in range(sh.shape[1]):
        blended = float(0.0)
        for c in range(8):
            if rows[c] >= 0:
                blended += weights[c] * coarse.sh[rows[c], number]
        sh[row, number] = scale * blended


@wp.kernel
def gather_rows(first: int, rows: wp.array(dtype=wp.int32), before: wp.array(dtype=Any), kept: wp.array(dtype=Any)):
    """Values of the rows (rows,) that stay. rows: which each was before."""
    n = first + wp.tid()
    kept[n] = before[rows[n]]


for number in (wp.uint8, wp.int32, wp.float32, wp.vec4):
    wp.overload(gather_rows, {"before": wp.array(dtype=number), "kept": wp.array(dtype=number)})


#: Numbers of a thread: rows of harmonics are multiples of it, and those of large fields have more than 2^31 numbers.
RUN = wp.constant(3)


@wp.kernel
def widen_rows(first: int, halves: wp.array2d(dtype=wp.float16), singles: wp.array2d(dtype=wp.float32)):
    """Copy RUN numbers, from halves (rows, n) to singles (rows, n), n a multiple of RUN. first: of the launch's runs,
    which follow each other row by row."""
    run = first + wp.tid()
    runs = halves.shape[1] // RUN
    row, column = run // runs, RUN * (run % runs)
    for k in range(RUN):
        singles[row, column + k] = wp.float32(halves[row, column + k])
