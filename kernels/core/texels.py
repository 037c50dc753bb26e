"""Texels of three-dimensional textures: written one by one through a surface, and blended by a GPU's texture units."""

# A texture unit blends the eight texels around a place in one instruction: of four halves in one cycle a lane, of four
# floats in five (H200). It rounds the place to 1/256 of a texel: off by at most 1/512 of what neighbours differ along
# each axis (CUDA C++ Programming Guide, "Texture Fetching"). CPUs have none: C++ functions take arrays there.

import warp as wp

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: C++ for CUDA that makes halves r, g, b and a of `value`, or the largest that they hold.
FOUR_HALVES = """
    const float limit = 65504.0f;
    const unsigned r = wp::float_to_half(fminf(fmaxf(value.c[0], -limit), limit)).u;
    const unsigned g = wp::float_to_half(fminf(fmaxf(value.c[1], -limit), limit)).u;
    const unsigned b = wp::float_to_half(fminf(fmaxf(value.c[2], -limit), limit)).u;
    const unsigned a = wp::float_to_half(fminf(fmaxf(value.c[3], -limit), limit)).u;
"""

#: C++ for CUDA that writes those halves to texel (x, y, z) of a surface of four halves; both steps at once.
WRITE_HALVES = """
    asm volatile("sust.b.3d.v2.b32.zero [%0, {%1, %2, %3, %4}], {%5, %6};"
        :: "l"(surface), "r"(8 * x), "r"(y), "r"(z), "r"(0), "r"(r | (g << 16)), "r"(b | (a << 16)) : "memory");
"""
WRITE_HALF_TEXEL = FOUR_HALVES + WRITE_HALVES

#: C++ for CUDA that sets r, g, b and a to the trilinear value at (x, y, z) of a texture that is asked by unnormalised
#: coordinates; texel (i, j, k) is at (i + 0.5, j + 0.5, k + 0.5), and in the second one at (i, j, k).
BLENDED_TEXEL_MIDDLES = """
    float r, g, b, a;
    asm("tex.3d.v4.f32.f32 {%0, %1, %2, %3}, [%4, {%5, %6, %7, %8}];"
        : "=f"(r), "=f"(g), "=f"(b), "=f"(a) : "l"(texture), "f"(x), "f"(y), "f"(z), "f"(0.0f));
"""
BLENDED_TEXEL = BLENDED_TEXEL_MIDDLES.replace('"f"(x), "f"(y), "f"(z)', '"f"(x + 0.5f), "f"(y + 0.5f), "f"(z + 0.5f)')


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const wp::vec_t<4, wp::float32> value(0.0f, 0.0f, 0.0f, 0.0f);
"""
    + WRITE_HALF_TEXEL
    + "#endif\n"
)
def clear_half_texel(surface: wp.uint64, x: wp.int32, y: wp.int32, z: wp.int32):
    """0 in a texel of a surface of four halves."""
    ...


@wp.kernel
def clear_half_texels(first: int, surface: wp.uint64, width: int, height: int, begin: int):
    """0 in the texels of a surface of four halves, from its layer `begin` on. One item a texel."""
    n = first + wp.tid()
    clear_half_texel(surface, n % width, (n // width) % height, begin + n // (width * height))
