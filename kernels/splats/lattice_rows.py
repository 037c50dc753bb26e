"""Harmonic coordinates of points and their gradients, from a lattice: rows by which points are carried with a cage."""

# Joshi et al., "Harmonic Coordinates for Character Articulation" (SIGGRAPH 2007). Weights are trilinear; gradients are
# central differences over a cell to each side, which the three rings of nodes around the cage's inside hold.

import warp as wp

from ..lattice.cage_map import CageMap, map_position

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.kernel
def bind_lattice(
    first: int,
    column: int,
    scale: float,
    cage_map: CageMap,
    points: wp.array(dtype=wp.vec3),
    rows: wp.array2d(dtype=wp.vec4),
):
    """Rows column .. column + 2 of rows (v, n): weight and gradient at points (n,), node units. cage_map: has the
    weights of three vertices where others have positions; scale: cells to a unit of length of the gradients."""
    n = first + wp.tid()
    x = points[n]
    value = map_position(cage_map, x)
    i = wp.vec3(1.0, 0.0, 0.0)
    j = wp.vec3(0.0, 1.0, 0.0)
    k = wp.vec3(0.0, 0.0, 1.0)
    dx = 0.5 * scale * (map_position(cage_map, x + i) - map_position(cage_map, x - i))
    dy = 0.5 * scale * (map_position(cage_map, x + j) - map_position(cage_map, x - j))
    dz = 0.5 * scale * (map_position(cage_map, x + k) - map_position(cage_map, x - k))
    for c in range(3):
        if column + c < rows.shape[0]:
            rows[column + c, n] = wp.vec4(value[c], dx[c], dy[c], dz[c])


@wp.kernel
def settle_rows(first: int, rows: wp.array2d(dtype=wp.vec4)):
    """Weights (v, n) that sum to one, and gradients that sum to zero, as those of the solved values nearly do."""
    n = first + wp.tid()
    total = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for j in range(rows.shape[0]):
        total += rows[j, n]
    inverse = 1.0 / total[0]
    for j in range(rows.shape[0]):
        row = rows[j, n]
        share = row[0] * inverse
        rows[j, n] = wp.vec4(
            share,
            (row[1] - share * total[1]) * inverse,
            (row[2] - share * total[2]) * inverse,
            (row[3] - share * total[3]) * inverse,
        )
