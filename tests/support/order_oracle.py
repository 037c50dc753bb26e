"""The order in which a fit takes its tiles, in whole numbers of Python: what fitting/shuffle is compared with."""

import numpy as np


def mixed(value: int) -> int:
    value ^= value >> 16
    value = value * 0x85EBCA6B & 0xFFFFFFFF
    value ^= value >> 13
    value = value * 0xC2B2AE35 & 0xFFFFFFFF
    return value ^ value >> 16


def shuffled_place(place: int, count: int, key: int) -> int:
    bits = next(bits for bits in range(1, 16) if 4**bits >= count)
    mask = 2**bits - 1
    item = place
    while True:
        left, right = item >> bits, item & mask
        for turn in range(4):
            both = (key + turn * 0x9E3779B9 & 0xFFFFFFFF) ^ right << 8
            left, right = right, left ^ mixed(both) & mask
        item = left << bits | right
        if item < count:
            return item


def shuffled(items: np.ndarray, key: int) -> np.ndarray:
    """Items (n,) in the order of a key."""
    return np.array([items[shuffled_place(place, len(items), key)] for place in range(len(items))])
