"""Rows of weights and gradients in ten bytes an entry instead of sixteen, for devices that wait for memory."""

# A pose reads every row once and does little with it (splats/pose): bytes are time. Weights stay float32, as places
# need their digits. Gradients are halves over a scale of each point's own, 1/1024 of its largest: off by less than
# 2^-11 of themselves, they neither overflow in cages with tiny faces nor vanish beside large ones. Four rows of 32
# points lie together, 1280 bytes: of each row the weight and two numbers of the gradient in 64 bits, rows 0 and 1 of a
# point side by side, then rows 2 and 3, at the end one uint64 a point of the four third numbers.
# Points (m,), rows (j, m), packed in groups (g,) of four, zeros behind the last row.

import warp as wp

from ..core.gradients import forward
from .pose import CarriedSplats, put_splats

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "block_dim": 128})

#: Largest half float that a gradient becomes: a power of two, far from the largest there is.
LARGEST = wp.constant(1024.0)

#: What targets add up to at a point: the move (3), then the rows of its gradient (9).
RowSums = wp.types.vector(length=12, dtype=wp.float32)


@wp.struct
class PackedRows:
    groups: wp.array3d(dtype=wp.uint64)  # (tiles of 32 points, g, 160) the groups, contiguous
    scales: wp.array(dtype=float)  # (m,) what gradients are multiplied by


@wp.func
def half_bits(value: float):
    """A number as a half float, in the lowest 16 bits."""
    return wp.uint64(wp.cast(wp.float16(value), wp.uint16))


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
    tile, lane = m // 32, m % 32
    for group in range(packed.groups.shape[1]):
        tail = wp.uint64(0)
        for k in range(4):
            j = 4 * group + k
            row = wp.vec4(0.0, 0.0, 0.0, 0.0)
            if j < count:
                row = rows[j, item]
            head = wp.uint64(wp.cast(row[0], wp.uint32))
            head = head | (half_bits(inverse * row[1]) << wp.uint64(32))
            packed.groups[tile, group, 64 * (k // 2) + 2 * lane + k % 2] = head | (
                half_bits(inverse * row[2]) << wp.uint64(48)
            )
            tail = tail | (half_bits(inverse * row[3]) << wp.uint64(16 * k))
        packed.groups[tile, group, 128 + lane] = tail


@forward.func_native(
    """
    struct Group
    {
        wp::uint64 groups[5];
    };
    const int last = groups.shape[1] - 1;
    const wp::uint64* rows = groups.data + (size_t)(m >> 5) * (size_t)groups.shape[1] * 160;
    const int lane = m & 31;
    const float* target = reinterpret_cast<const float*>(targets.data + begin);
    wp::vec_t<12, float> sums;
    const auto load = [&](int group) {
        const wp::uint64* at = rows + (size_t)(group < last ? group : last) * 160;
        Group found;
#if defined(__CUDA_ARCH__)
        const ulonglong2 low = __ldg(reinterpret_cast<const ulonglong2*>(at) + lane);
        const ulonglong2 high = __ldg(reinterpret_cast<const ulonglong2*>(at) + 32 + lane);
        found.groups[0] = low.x;
        found.groups[1] = low.y;
        found.groups[2] = high.x;
        found.groups[3] = high.y;
        found.groups[4] = __ldg(reinterpret_cast<const unsigned long long*>(at) + 128 + lane);
#else
        for (int k = 0; k < 4; ++k)
            found.groups[k] = at[64 * (k / 2) + 2 * lane + k % 2];
        found.groups[4] = at[128 + lane];
#endif
        return found;
    };
    const auto add = [&](const Group& group, const float* residuals) {
        #pragma unroll
        for (int k = 0; k < 4; ++k)
        {
            union
            {
                unsigned bits;
                float value;
            } weight;
            weight.bits = (unsigned)group.groups[k];
            const wp::uint64 numbers[3] = {group.groups[k] >> 32, group.groups[k] >> 48, group.groups[4] >> (16 * k)};
            float slopes[3];
            #pragma unroll
            for (int c = 0; c < 3; ++c)
            {
                wp::half number;
                number.u = (unsigned short)numbers[c];
                slopes[c] = wp::half_to_float(number);
            }
            #pragma unroll
            for (int c = 0; c < 3; ++c)
            {
                const float residual = residuals[3 * k + c];
                sums.c[c] += weight.value * residual;
                #pragma unroll
                for (int d = 0; d < 3; ++d)
                    sums.c[3 + 3 * c + d] += residual * slopes[d];
            }
        }
    };
    Group one = load(0), two = load(1);
    for (int group = 0; group <= last; group += 2)
    {
        add(one, target + 12 * group);
        one = load(group + 2);
        add(two, target + 12 * group + 12);
        two = load(group + 3);
    }
    return sums;
    """
)
def sum_rows(
    m: wp.int32, groups: wp.array3d(dtype=wp.uint64), targets: wp.array(dtype=wp.vec3), begin: wp.int32
) -> RowSums:
    """Sums over the rows of point m. Two groups are on their way by turns: one is loaded while the other is summed up.
    The second of the last pair may be behind the last group; then it is that one again, of targets that are zeros."""
    ...


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
    """What `carry_bound` of splats/pose does, of packed rows; behind the last row's, targets has zeros up to eight."""
    m = first + wp.tid()
    sums = sum_rows(m, packed.groups, targets, begin)
    moved = wp.vec3(sums[0], sums[1], sums[2])
    turned = wp.mat33(sums[3], sums[4], sums[5], sums[6], sums[7], sums[8], sums[9], sums[10], sums[11])
    anchor = anchors[m]
    jacobian = wp.identity(n=3, dtype=float) + (slope + inverse_size * packed.scales[m] * turned)
    position = anchor + (slope * anchor + shift + moved) + jacobian * offsets[m]
    put_splats(members[m], others, position, jacobian, carried)
