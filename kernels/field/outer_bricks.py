"""Values of a sparse grid as a texture of bricks, so that frames read all around a place at once on a GPU."""

import warp as wp

from ..core.gradients import forward
from ..core.lanes import grid_place
from ..core.texels import BLENDED_TEXEL, WRITE_HALF_TEXEL
from ..core.variants import by_device
from .columns import Columns, node_row

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Cells along a brick, and nodes: those at its sides are kept in each of the bricks that they are of.
BRICK_CELLS = wp.constant(8)

BRICK_NODES = wp.constant(9)

#: Bricks along the first two axes of a texture: two to this power.
ACROSS_BITS = wp.constant(5)


@wp.struct
class OuterBricks:
    """Bricks of a cubic grid of nodes, those that hold anything. Empty on a CPU."""

    numbers: wp.array3d(dtype=wp.int32)  # (m, m, m) number of a brick in the texture, -1 for those without
    texture: wp.uint64  # of four halves a node: axis 2 of the grid, axis 1, axis 0 of a brick


@wp.func
def brick_texel(number: int):
    """The first texel of a brick."""
    last = (1 << ACROSS_BITS) - 1
    return BRICK_NODES * wp.vec3i(number & last, (number >> ACROSS_BITS) & last, number >> (2 * ACROSS_BITS))


@wp.func
def mark_bricks_of_node(marks: wp.array4d(dtype=wp.int32), layer: int, i: int, j: int, k: int):
    """1 in the marks (layers, bricks along each axis) of the bricks of the cells around a node, in a layer."""
    for corner in range(8):
        a = i - (corner >> 2)
        b = j - ((corner >> 1) & 1)
        c = k - (corner & 1)
        within = a >= 0 and b >= 0 and c >= 0
        a = a // BRICK_CELLS
        b = b // BRICK_CELLS
        c = c // BRICK_CELLS
        if within and a < marks.shape[1] and b < marks.shape[2] and c < marks.shape[3]:
            marks[layer, a, b, c] = 1


@wp.kernel
def mark_row_bricks(first: int, nodes: wp.array(dtype=wp.int32), ny: int, nz: int, marks: wp.array4d(dtype=wp.int32)):
    """1 in the first layer of marks for bricks that keep any of nodes (rows,), of field/columns. One item a row."""
    i, j, k = grid_place(nodes[first + wp.tid()], ny, nz)
    mark_bricks_of_node(marks, 0, i, j, k)


@wp.kernel
def mark_bricks(first: int, skip: wp.array3d(dtype=wp.uint8), marks: wp.array3d(dtype=wp.int32)):
    """1 in the marks (m, m, m) of bricks with a cell that holds anything, skip 0. One item a cell."""
    n = first + wp.tid()
    i = n // (skip.shape[1] * skip.shape[2])
    j = (n // skip.shape[2]) % skip.shape[1]
    k = n % skip.shape[2]
    if skip[i, j, k] == wp.uint8(0):
        marks[i // BRICK_CELLS, j // BRICK_CELLS, k // BRICK_CELLS] = 1


@forward.func_native("#if defined(__CUDA_ARCH__)\n" + WRITE_HALF_TEXEL + "#endif\n")
def write_texel(surface: wp.uint64, x: wp.int32, y: wp.int32, z: wp.int32, value: wp.vec4):
    """Keep a value in a texel."""
    ...


@wp.kernel
def fill_bricks(
    first: int, bricks: wp.array(dtype=wp.vec3i), columns: Columns, values: wp.array(dtype=wp.vec4), surface: wp.uint64
):
    """Write values of nodes, 0 where there is no row. bricks: (count,) place of each among all. One item a texel."""
    size = BRICK_NODES * BRICK_NODES * BRICK_NODES
    n = first + wp.tid()
    number = n // size
    x = n % BRICK_NODES
    y = (n // BRICK_NODES) % BRICK_NODES
    z = (n % size) // (BRICK_NODES * BRICK_NODES)
    node = BRICK_CELLS * bricks[number] + wp.vec3i(z, y, x)
    value = wp.vec4()
    if wp.max(node) < columns.node_counts[0]:
        row = node_row(columns, node[0], node[1], node[2])
        if row >= 0:
            value = values[row]
    at = brick_texel(number)
    write_texel(surface, at[0] + x, at[1] + y, at[2] + z, value)


@forward.func_native(by_device("1", "0"))
def reads_textures() -> int:
    """1 on a GPU, known to its compiler."""
    ...


@forward.func_native(
    """
#if defined(__CUDA_ARCH__)
    const int last = (1 << across_bits) - 1, m = bricks.numbers.shape[1];
    const int i = (int)at.c[0] / cells, j = (int)at.c[1] / cells, k = (int)at.c[2] / cells;
    const int number = __ldg(reinterpret_cast<const int*>(bricks.numbers.data) + (i * m + j) * m + k);
    const auto texture = bricks.texture;
    const float x = at.c[2] + (float)((cells + 1) * (number & last) - cells * k);
    const float y = at.c[1] + (float)((cells + 1) * ((number >> across_bits) & last) - cells * j);
    const float z = at.c[0] + (float)((cells + 1) * (number >> (2 * across_bits)) - cells * i);
"""
    + BLENDED_TEXEL
    + """
    return wp::vec_t<4, wp::float32>(r, g, b, a);
#else
    return wp::vec_t<4, wp::float32>();
#endif
"""
)
def brick_value(bricks: OuterBricks, at: wp.vec3, cells: int, across_bits: int) -> wp.vec4:
    """Trilinear value at node coordinates in a cell that holds anything."""
    ...
