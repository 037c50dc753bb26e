"""A shuffled order of any number of items, without a table."""

# A Feistel network is a bijection of the numbers below a power of four whatever its round function is (Luby and Rackoff
# 1988). Walked along its cycle until it lands below `count`, it is one of the numbers below `count` (Black and Rogaway
# 2002, "Ciphers with arbitrary finite domains"). The power is below 4 count, so that a walk takes four turns on average
# at most. The rounds mix as the finaliser of MurmurHash3 does (Appleby 2011).

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

ROUNDS = wp.constant(4)

#: Factors of the finaliser, and 2^32 over the golden ratio, which tells the rounds apart.
FIRST_FACTOR = wp.constant(wp.uint32(0x85EBCA6B))
SECOND_FACTOR = wp.constant(wp.uint32(0xC2B2AE35))
GOLDEN = wp.constant(wp.uint32(0x9E3779B9))


@wp.func
def mixed(value: wp.uint32):
    """All bits of a number mixed into all others."""
    x = value
    x = (x ^ (x >> wp.uint32(16))) * FIRST_FACTOR
    x = (x ^ (x >> wp.uint32(13))) * SECOND_FACTOR
    return x ^ (x >> wp.uint32(16))


@wp.func
def half_bits(count: int):
    """Bits of one half of a Feistel network over at least `count` numbers."""
    bits = int(1)
    while bits < 15 and (1 << (2 * bits)) < count:
        bits += 1
    return bits


@wp.func
def shuffled_place(place: int, count: int, key: int):
    """The item at a place of the shuffled order: a bijection of 0 .. count - 1 for each key. count: up to 2^30."""
    bits = wp.uint32(half_bits(count))
    mask = (wp.uint32(1) << bits) - wp.uint32(1)
    item = wp.uint32(place)
    inside = int(0)
    while inside == 0:
        left = item >> bits
        right = item & mask
        for turn in range(ROUNDS):
            both = (wp.uint32(key) + wp.uint32(turn) * GOLDEN) ^ (right << wp.uint32(8))
            other = left ^ (mixed(both) & mask)
            left = right
            right = other
        item = (left << bits) | right
        if item < wp.uint32(count):
            inside = 1
    return int(item)
