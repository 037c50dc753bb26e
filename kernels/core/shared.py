"""Memory that the lanes of a warp share, on CUDA: numbers that one lane leaves for the others, or for later."""

import warp as wp

from .gradients import forward

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

#: Numbers of a warp, and warps of a block, at most. A block takes 4 * 4 * WARP_NUMBERS bytes of shared memory.
WARP_NUMBERS = wp.constant(1344)

BLOCK_WARPS = wp.constant(4)


@forward.func_native(f"""
#if defined(__CUDA_ARCH__)
    // one function for all that is done with it: another would have another array
    __shared__ float4 memory[{BLOCK_WARPS} * {WARP_NUMBERS // 4}];
    float4* own = memory + ((threadIdx.x >> 5) & {BLOCK_WARPS - 1}) * {WARP_NUMBERS // 4};
    if (action == 0)
    {{
        const float4 found = own[place];
        return wp::vec_t<4, wp::float32>(found.x, found.y, found.z, found.w);
    }}
    if (action == 1)
        own[place] = make_float4(values.c[0], values.c[1], values.c[2], values.c[3]);
    if (action == 2)
        return wp::vec_t<4, wp::float32>(reinterpret_cast<const float*>(own)[place], 0.0f, 0.0f, 0.0f);
    if (action == 3)
        reinterpret_cast<float*>(own)[place] = values.c[0];
#endif
    return values;
""")
def warp_memory(action: wp.int32, place: wp.int32, values: wp.vec4) -> wp.vec4:
    """Read (0) or write (1) four numbers, at a place in fours; read (2) or write (3) one, at a place in ones."""
    ...


@wp.func
def four_kept(place: int):
    """The four numbers at a place, which counts in fours."""
    return warp_memory(0, place, wp.vec4())


@wp.func
def keep_four(place: int, values: wp.vec4):
    """Put four numbers to a place, which counts in fours."""
    warp_memory(1, place, values)


@wp.func
def one_kept(place: int):
    """The number at a place."""
    return warp_memory(2, place, wp.vec4())[0]


@wp.func
def keep_one(place: int, value: float):
    """Put a number to a place."""
    warp_memory(3, place, wp.vec4(value, 0.0, 0.0, 0.0))


@forward.func_native("""
    union { int whole; float bits; } both;
    both.whole = value;
    return both.bits;
""")
def bits_as_float(value: wp.int32) -> wp.float32:
    """A float32 with the bits of a whole number. Only to be kept, not to be reckoned with."""
    ...


@wp.func_native("""
    union { int whole; float bits; } both;
    both.bits = value;
    return both.whole;
""")
def bits_as_int(value: wp.float32) -> wp.int32:
    """The whole number that bits_as_float hid."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncwarp();
#endif
""")
def warp_meets():
    """Wait until all lanes are here, and have written what they keep. All lanes."""
    ...
