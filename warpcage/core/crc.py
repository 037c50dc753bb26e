"""CRC-32 of files that are read in parts: the checksum of the whole from those of its parts."""

from __future__ import annotations

import functools

#: The polynomial of zip files, and the polynomials 1 and x; the highest bit is the constant one.
POLYNOMIAL, ONE, X = 0xEDB88320, 1 << 31, 1 << 30


def joined_crc(first: int, second: int, length: int) -> int:
    """The checksum of two parts one after the other, by that of each and the bytes of the second."""
    # `crc32_combine` of zlib.
    return _product(_shift(8 * length), first) ^ second


def _product(a: int, b: int) -> int:
    """The product of two polynomials, modulo POLYNOMIAL."""
    product, bit = 0, ONE
    while bit:
        if a & bit:
            product ^= b
        b = b >> 1 ^ POLYNOMIAL if b & 1 else b >> 1
        bit >>= 1
    return product


@functools.lru_cache(maxsize=16)
def _shift(bits: int) -> int:
    """x to the power of a number of bits."""
    power, square = ONE, X
    while bits:
        if bits & 1:
            power = _product(square, power)
        square = _product(square, square)
        bits >>= 1
    return power
