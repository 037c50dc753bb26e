"""Entries of arrays by bare address arithmetic, and quick roots and quotients: for loops bound by instructions."""

import warp as wp

from .variants import by_device

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})


@wp.func_native(
    """
    const char* begin = reinterpret_cast<const char*>(array.data);
    const unsigned long long offset = (unsigned long long)(unsigned)i * (unsigned)array.strides[0];
    return *reinterpret_cast<const wp::vec_t<3, wp::float32>*>(begin + offset);
""",
    adj_snippet="wp::adj_address(array, i, adj_array, 0, adj_ret);",
)
def vec3_entry(array: wp.array(dtype=wp.vec3), i: int) -> wp.vec3:
    """array[i]"""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    const float4 entry = *(reinterpret_cast<const float4*>(array.data) + (unsigned)i);
    return wp::vec_t<4, wp::float32>(entry.x, entry.y, entry.z, entry.w);
#else
    return array.data[i];
#endif
""",
    adj_snippet="wp::adj_address(array, i, adj_array, 0, adj_ret);",
)
def vec4_entry(array: wp.array(dtype=wp.vec4), i: int) -> wp.vec4:
    """array[i], in one read, of an array without gaps that begins at a multiple of 16 bytes, as allocations do."""
    ...


@wp.func_native("""
    const char* begin = reinterpret_cast<const char*>(array.data);
    const unsigned long long offset = (unsigned long long)(unsigned)i * (unsigned)array.strides[0];
    return *reinterpret_cast<const wp::vec_t<3, wp::int32>*>(begin + offset);
""")
def vec3i_entry(array: wp.array(dtype=wp.vec3i), i: int) -> wp.vec3i:
    """array[i]"""
    ...


@wp.func_native("""
    return (int)reinterpret_cast<const unsigned char*>(array.data)[(unsigned)i];
""")
def byte_entry(array: wp.array(dtype=wp.uint8), i: int) -> int:
    """array[i], of an array without gaps."""
    ...


@wp.func_native("""
    return (int)reinterpret_cast<const unsigned char*>(array.data)[
        ((size_t)(unsigned)(i * array.shape[1] + j)) * (unsigned)array.shape[2] + (unsigned)k];
""")
def cell_byte(array: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int) -> int:
    """array[i, j, k], of an array without gaps."""
    ...


@wp.func_native("""
    const unsigned char* begin = reinterpret_cast<const unsigned char*>(array.data)
        + ((size_t)(unsigned)(i * array.shape[1] + j)) * (unsigned)array.shape[2] + (unsigned)k;
#if defined(__CUDA_ARCH__)
    const size_t address = reinterpret_cast<size_t>(begin);
    const unsigned* uint32s = reinterpret_cast<const unsigned*>(address & ~(size_t)3);
    const unsigned from = 8u * (unsigned)(address & 3), to = 8u * (unsigned)(last + 1);
    unsigned bytes = __ldg(uint32s) >> from;
    if (from + to > 32u)
        bytes |= __ldg(uint32s + 1) << (32u - from);
    bytes |= to < 32u ? ~0u << to : 0u;
    return ((bytes - 0x01010101u) & ~bytes & 0x80808080u) != 0u ? 1 : 0;
#else
    for (int n = 0; n <= last; ++n)
        if (begin[n] == 0)
            return 1;
    return 0;
#endif
""")
def row_has_zero(array: wp.array3d(dtype=wp.uint8), i: int, j: int, k: int, last: int) -> int:
    """1 where any of array[i, j, k] to array[i, j, k + last] is 0, `last` at most 3, of an array without gaps whose
    memory goes on for three bytes: a GPU reads the uint32s around them."""
    ...


@wp.func_native(
    """
    const int ny = values.shape[1], nz = values.shape[2];
    const int i = (int)floorf(g.c[0]), j = (int)floorf(g.c[1]), k = (int)floorf(g.c[2]);
    if (i < 0 || j < 0 || k < 0 || i >= values.shape[0] - 1 || j >= ny - 1 || k >= nz - 1)
        return beyond;
    const float x = g.c[0] - (float)i, y = g.c[1] - (float)j, z = g.c[2] - (float)k;
    const float* at = reinterpret_cast<const float*>(values.data) + ((size_t)(unsigned)(i * ny + j) * (unsigned)nz + k);
    const float a = at[0] + z * (at[1] - at[0]);
    const float b = at[nz] + z * (at[nz + 1] - at[nz]);
    at += (size_t)ny * nz;
    const float c = at[0] + z * (at[1] - at[0]);
    const float d = at[nz] + z * (at[nz + 1] - at[nz]);
    const float low = a + y * (b - a), high = c + y * (d - c);
    return low + x * (high - low);
""",
    adj_snippet="""
    const int ny = values.shape[1], nz = values.shape[2];
    const int i = (int)floorf(g.c[0]), j = (int)floorf(g.c[1]), k = (int)floorf(g.c[2]);
    if (i < 0 || j < 0 || k < 0 || i >= values.shape[0] - 1 || j >= ny - 1 || k >= nz - 1) {
        adj_beyond += adj_ret;
        return;
    }
    const float x = g.c[0] - (float)i, y = g.c[1] - (float)j, z = g.c[2] - (float)k;
    for (int corner = 0; corner < 8; ++corner) {
        const int p = corner >> 2, q = (corner >> 1) & 1, r = corner & 1;
        const float u = p ? x : 1.0f - x, v = q ? y : 1.0f - y, w = r ? z : 1.0f - z;
        const float value = values.data[((size_t)(unsigned)((i + p) * ny + j + q)) * (unsigned)nz + (k + r)];
        adj_g.c[0] += adj_ret * value * (p ? v * w : -v * w);
        adj_g.c[1] += adj_ret * value * (q ? u * w : -u * w);
        adj_g.c[2] += adj_ret * value * (r ? u * v : -u * v);
        wp::adj_address(values, i + p, j + q, k + r, adj_values, 0, 0, 0, adj_ret * u * v * w);
    }
""",
)
def trilinear_entry(values: wp.array3d(dtype=float), g: wp.vec3, beyond: float) -> float:
    """Trilinear value at node coordinates, of an array without gaps; `beyond` outside its nodes."""
    ...


@wp.func_native(
    by_device("rsqrtf(x)", "1.0f / sqrtf(x)"),
    adj_snippet="""
    const float root = sqrtf(x);
    adj_x -= adj_ret * 0.5f / (root * root * root);
""",
)
def reciprocal_root(x: wp.float32) -> wp.float32:
    """1 / sqrt(x), to two units in the last place; infinite at zero."""
    ...


@wp.func_native(by_device("__expf(x)", "expf(x)"), adj_snippet="adj_x += adj_ret * expf(x);")
def near_exp(x: wp.float32) -> wp.float32:
    """exp(x), on CUDA to 2 + 1.2 |x| units in the last place."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    float root;
    asm("sqrt.approx.ftz.f32 %0, %1;" : "=f"(root) : "f"(x));
    return root;
#else
    return sqrtf(x);
#endif
""",
    adj_snippet="adj_x += adj_ret * 0.5f / sqrtf(x);",
)
def near_root(x: wp.float32) -> wp.float32:
    """sqrt(x), to two units in the last place. On CUDA an exact root is a call, this one an instruction."""
    ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    float reciprocal;
    asm("rcp.approx.f32 %0, %1;" : "=f"(reciprocal) : "f"(x));
    return reciprocal;
#else
    return 1.0f / x;
#endif
""",
    adj_snippet="adj_x -= adj_ret / (x * x);",
)
def near_reciprocal(x: wp.float32) -> wp.float32:
    """1 / x, to two units in the last place. On CUDA an exact quotient is a call, this one an instruction."""
    ...
