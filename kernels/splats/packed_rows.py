"""Rows of weights and gradients in ten bytes an entry instead of sixteen, for devices that wait for memory.

A pose reads every row once and does little with it (splats/pose), so that bytes are time. Weights stay float32: places
need their digits. Gradients are half floats, over a scale of each point's own, 1/1024 of its largest: each is off by
less than 2^-11 of itself, and neither overflows in cages with tiny faces nor vanishes beside large ones.

Four rows lie together: a word of 64 bits for each, the weight, then the first two numbers of its gradient; and one word
of the four third numbers. So all that a thread loads is 8 bytes wide, next to its neighbour's.

Shapes: points (m,), rows (j, m) of weight and gradient, packed in groups (g,) of four, zeros behind the last row.
Needs: splats/pose.
"""

import warp as wp

from .pose import CarriedSplats, put_splats

wp.set_module_options({"enable_backward": False})

#: Largest half float that a gradient becomes: a power of two, far from the largest there is.
LARGEST = wp.constant(1024.0)


@wp.struct
class PackedRows:
    heads: wp.array2d(dtype=wp.uint64)  # (4 g, m) weight, first and second number of the gradient
    tails: wp.array2d(dtype=wp.uint64)  # (g, m) third numbers of four gradients
    scales: wp.array(dtype=float)  # (m,) what gradients are multiplied by


@wp.func
def half_bits(value: float):
    """A number as a half float, in the lowest 16 bits."""
    return wp.uint64(wp.cast(wp.float16(value), wp.uint16))


@wp.func
def half_value(bits: wp.uint64):
    """The half float in the lowest 16 bits."""
    return float(wp.cast(wp.uint16(bits), wp.float16))


@wp.kernel
def pack_rows(first: int, begin: int, rows: wp.array2d(dtype=wp.vec4), packed: PackedRows):
    """rows (j, items) to points begin .. begin + items - 1 of packed, which has room for j rows or some more."""
    item = first + wp.tid()
    m = begin + item
    count = rows.shape[0]
    largest = float(0.0)
    for j in range(count):
        row = rows[j, item]
        largest = wp.max(largest, wp.max(wp.abs(row[1]), wp.max(wp.abs(row[2]), wp.abs(row[3]))))
    scale = wp.where(largest > 0.0, largest / LARGEST, 1.0)
    inverse = 1.0 / scale
    packed.scales[m] = scale
    for group in range(packed.tails.shape[0]):
        tail = wp.uint64(0)
        for k in range(4):
            j = 4 * group + k
            row = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if j < count:
                row = rows[j, item]
            head = wp.uint64(wp.cast(row[0], wp.uint32))
            head = head | (half_bits(inverse * row[1]) << wp.uint64(32))
            packed.heads[j, m] = head | (half_bits(inverse * row[2]) << wp.uint64(48))
            tail = tail | (half_bits(inverse * row[3]) << wp.uint64(16 * k))
        packed.tails[group, m] = tail


@wp.kernel
def carry_packed(
    first: int,
    members: wp.array(dtype=int),
    others: wp.array(dtype=int),
    anchors: wp.array(dtype=wp.vec3),
    offsets: wp.array(dtype=wp.vec3),
    packed: PackedRows,
    targets: wp.array(dtype=wp.vec3),
    begin: int,
    slope: wp.mat33,
    shift: wp.vec3,
    inverse_size: float,
    carried: CarriedSplats,
):
    """What `carry_bound` of splats/pose does, of packed rows; targets has zeros behind the last row's."""
    m = first + wp.tid()
    moved = wp.vec3(0.0, 0.0, 0.0)
    turned = wp.mat33()
    # A group is loaded while the one before it is summed up: compilers put loads next to what waits for them otherwise,
    # so that one or two are on their way at once.
    count = packed.tails.shape[0]
    tail = wp.uint64(packed.tails[0, m])
    head_0 = wp.uint64(packed.heads[0, m])
    head_1 = wp.uint64(packed.heads[1, m])
    head_2 = wp.uint64(packed.heads[2, m])
    head_3 = wp.uint64(packed.heads[3, m])
    for group in range(count):
        ahead = wp.min(group + 1, count - 1)
        next_tail = packed.tails[ahead, m]
        next_0 = packed.heads[4 * ahead, m]
        next_1 = packed.heads[4 * ahead + 1, m]
        next_2 = packed.heads[4 * ahead + 2, m]
        next_3 = packed.heads[4 * ahead + 3, m]
        for k in range(4):
            head = head_0
            if k == 1:
                head = head_1
            elif k == 2:
                head = head_2
            elif k == 3:
                head = head_3
            residual = targets[begin + 4 * group + k]
            slopes = wp.vec3(
                half_value(head >> wp.uint64(32)),
                half_value(head >> wp.uint64(48)),
                half_value(tail >> wp.uint64(16 * k)),
            )
            moved += wp.cast(wp.uint32(head), wp.float32) * residual
            turned += wp.outer(residual, slopes)
        tail = next_tail
        head_0 = next_0
        head_1 = next_1
        head_2 = next_2
        head_3 = next_3
    anchor = anchors[m]
    jacobian = wp.identity(n=3, dtype=float) + (slope + inverse_size * packed.scales[m] * turned)
    position = anchor + (slope * anchor + shift + moved) + jacobian * offsets[m]
    put_splats(members[m], others, position, jacobian, carried)
