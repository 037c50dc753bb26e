"""What an item of a launch is for: a place of a grid, or a lane of the group that shares a piece of work."""

# A group of lanes is the 32 threads of a warp on CUDA, one thread on a CPU. Kernels for a group take lane_count() items
# for each piece of work (lane_place). All lanes of a group must reach every function below that says "all lanes".
# Where there is little to share, octets are enough: eight lanes of a warp, or one thread on a CPU. The octets of a warp
# take turns of a loop together, until none has anything left to do (`octets_go_on`).

import warp as wp

from .gradients import forward
from .variants import by_device

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func
def grid_place(n: int, ny: int, nz: int):
    """(i, j, k) of the n-th place of a grid whose last axes have ny and nz places, in the order of memory."""
    return n // (nz * ny), (n // nz) % ny, n % nz


@wp.func_native(by_device("32", "1"))
def lane_count() -> wp.int32:
    """Lanes of a group."""
    ...


@wp.func
def lane_place(item: int):
    """The piece of work of an item, its lane in the group that shares it, and how many lanes there are."""
    lanes = lane_count()
    return item / lanes, item % lanes, lanes


@wp.func_native(by_device("(int)__ballot_sync(0xffffffffu, flag)", "flag != 0"))
def ballot(flag: wp.int32) -> wp.int32:
    """Bit i is set where lane i has a flag. All lanes."""
    ...


@forward.func_native(by_device("__shfl_sync(0xffffffffu, value, lane)", "value"))
def from_lane(value: wp.float32, lane: wp.int32) -> wp.float32:
    """The value that another lane holds. All lanes."""
    ...


@wp.func_native(by_device("__shfl_sync(0xffffffffu, value, lane)", "value"))
def index_from_lane(value: wp.int32, lane: wp.int32) -> wp.int32:
    """The whole number that another lane holds. All lanes."""
    ...


@wp.func_native(by_device("__shfl_sync(0xffffffffu, value, lane)", "value"))
def mask_from_lane(value: wp.uint64, lane: wp.int32) -> wp.uint64:
    """The bits that another lane holds. All lanes."""
    ...


@forward.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach >>= 1)
        value = fminf(value, __shfl_xor_sync(0xffffffffu, value, reach));
#endif
    return value;
""")
def least_of_lanes(value: wp.float32) -> wp.float32:
    """The smallest of the lanes' values, in each of them. All lanes."""
    ...


@forward.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, reach);
#endif
    return value;
""")
def sum_of_lanes(value: wp.float32) -> wp.float32:
    """The sum of the lanes' values, the same in each of them. All lanes."""
    ...


@wp.func_native(by_device("8", "1"))
def octet_count() -> wp.int32:
    """Lanes of an octet."""
    ...


@wp.func
def octet_place(item: int):
    """The piece of work of an item, its lane in the octet that shares it, and how many lanes there are."""
    lanes = octet_count()
    return item / lanes, item % lanes, lanes


@wp.func_native(by_device("__any_sync(0xffffffffu, flag)", "flag"))
def octets_go_on(flag: wp.int32) -> wp.int32:
    """Whether any lane has a flag. All lanes of the warp."""
    ...


@wp.func_native(by_device("__ballot_sync(0xffffffffu, flag) >> (threadIdx.x & 24u) & 255u", "flag != 0"))
def octet_ballot(flag: wp.int32) -> wp.int32:
    """Bit i is set where lane i of the octet has a flag. All lanes of the warp."""
    ...


@forward.func_native(by_device("__shfl_sync(0xffffffffu, value, lane, 8)", "value"))
def from_octet_lane(value: wp.float32, lane: wp.int32) -> wp.float32:
    """The value that another lane of the octet holds. All lanes of the warp."""
    ...


@wp.func_native(by_device("__shfl_sync(0xffffffffu, value, lane, 8)", "value"))
def index_from_octet_lane(value: wp.int32, lane: wp.int32) -> wp.int32:
    """The whole number that another lane of the octet holds. All lanes of the warp."""
    ...


@wp.func
def octet_sum_before(value: float, lane: int):
    """Sum of the values of the octet's lanes before this one. All lanes of the warp."""
    total = float(value)
    for i in range(3):
        other = from_octet_lane(total, wp.max(lane - (1 << i), 0))
        if lane >= (1 << i):
            total += other
    return total - value


@wp.func
def octet_product_before(value: float, lane: int):
    """Product of the values of the octet's lanes before this one. All lanes of the warp."""
    total = float(value)
    for i in range(3):
        other = from_octet_lane(total, wp.max(lane - (1 << i), 0))
        if lane >= (1 << i):
            total *= other
    before = from_octet_lane(total, wp.max(lane - 1, 0))
    return wp.where(lane > 0, before, 1.0)


@forward.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 4; reach > 0; reach >>= 1)
        value += __shfl_xor_sync(0xffffffffu, value, reach);
#endif
    return value;
""")
def sum_of_octet(value: wp.float32) -> wp.float32:
    """The sum of the values of an octet's lanes, the same in each of them. All lanes of the warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int reach = 16; reach > 0; reach >>= 1)
        bits |= __shfl_xor_sync(0xffffffffu, bits, reach);
#endif
    return bits;
""")
def union_of_lanes(bits: wp.int32) -> wp.int32:
    """The bits that any of the lanes has set. All lanes."""
    ...


@wp.func
def sum_before(value: float, lane: int):
    """Sum of the values of the lanes before this one. All lanes."""
    total = float(value)
    for i in range(5):
        other = from_lane(total, wp.max(lane - (1 << i), 0))
        if lane >= (1 << i):
            total += other
    return total - value


@wp.func
def largest_of_lanes(value: float):
    """The largest of the lanes' values, in each of them. All lanes."""
    return -least_of_lanes(-value)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned same = __match_any_sync(__activemask(), entry);
    const int lane = threadIdx.x & 31, first = __ffs(same) - 1;
    int before = 0;
    if (lane == first)
        before = atomicAdd(counts.data + entry, __popc(same));
    return __shfl_sync(same, before, first) + __popc(same & ((1u << lane) - 1u));
#else
    return counts.data[entry]++;
#endif
""")
def count_up(counts: wp.array(dtype=wp.int32), entry: wp.int32) -> wp.int32:
    """What counts[entry] was before it goes up by 1; lanes that count the same take turns in one atomic. On a CPU one
    thread at a time."""
    ...


@wp.func_native("""
    unsigned int left = (unsigned int)bits;
#if defined(__CUDA_ARCH__)
    return __popc(left);
#else
    int count = 0;
    for (; left != 0u; left &= left - 1u)
        ++count;
    return count;
#endif
""")
def bit_count(bits: wp.int32) -> wp.int32:
    """How many bits are set."""
    ...


@wp.func_native("""
    unsigned int left = (unsigned int)bits;
#if defined(__CUDA_ARCH__)
    return __ffs(left) - 1;
#else
    int place = 0;
    for (; left != 0u && (left & 1u) == 0u; left >>= 1)
        ++place;
    return left == 0u ? -1 : place;
#endif
""")
def lowest_bit(bits: wp.int32) -> wp.int32:
    """Place of the lowest bit that is set, -1 for none."""
    ...


@wp.func_native("""
    return (int)((unsigned int)bits & ((unsigned int)bits - 1u));
""")
def without_lowest_bit(bits: wp.int32) -> wp.int32:
    """The bits but for the lowest that is set."""
    ...


@wp.func_native("""
    return (int)((unsigned int)bits & ((1u << lane) - 1u));
""")
def bits_before(bits: wp.int32, lane: wp.int32) -> wp.int32:
    """The bits of the lanes before one."""
    ...
