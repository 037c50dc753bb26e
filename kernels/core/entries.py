"""Entries of arrays by bare address arithmetic, and a reciprocal root: for loops that are bound by their instructions.

Warp's own indexing also takes negative and long indices, at eight instructions an entry. These take an index from
zero up to the array's end, which nobody checks.
Needs: none.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    const char* begin = reinterpret_cast<const char*>(array.data);
    const unsigned long long offset = (unsigned long long)(unsigned)i * (unsigned)array.strides[0];
    return *reinterpret_cast<const wp::vec_t<3, wp::float32>*>(begin + offset);
""")
def vec3_entry(array: wp.array(dtype=wp.vec3), i: int) -> wp.vec3:
    """array[i]"""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 entry = *(reinterpret_cast<const float4*>(array.data) + (unsigned)i);
    return wp::vec_t<4, wp::float32>(entry.x, entry.y, entry.z, entry.w);
#else
    return array.data[i];
#endif
""")
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
#if defined(__CUDA_ARCH__)
    return rsqrtf(x);
#else
    return 1.0f / sqrtf(x);
#endif
""")
def reciprocal_root(x: wp.float32) -> wp.float32:
    """1 / sqrt(x), to two units in the last place; infinite at zero."""
    ...
