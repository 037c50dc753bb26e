// packs the numbers `c` of a row, `luminous` where they are 24, and writes them
const float limit = 65504.0f;
// where the three parts of a row begin, each with its constant term
const int starts[3] = {0, luminous ? 16 : 9, luminous ? 20 : 18};
float largest = 0.0f;
#pragma unroll
for (int n = 1; n < (luminous ? 24 : 27); ++n)
    if (n != starts[1] && n != starts[2])
        largest = fmaxf(largest, fabsf(c[n]));
// rounded up, so that no number needs more than 127 units
const wp::half unit = wp::float_to_half(fminf(largest * (1.0005f / 127.0f) + 6.0e-8f, limit));
const float scale = 1.0f / wp::half_to_float(unit);
unsigned uint32s[8];
uint32s[0] = (unsigned)wp::float_to_half(fminf(fmaxf(c[0], -limit), limit)).u
    | ((unsigned)wp::float_to_half(fminf(fmaxf(c[starts[1]], -limit), limit)).u << 16);
uint32s[1] = (unsigned)wp::float_to_half(fminf(fmaxf(c[starts[2]], -limit), limit)).u | ((unsigned)unit.u << 16);
#pragma unroll
for (int w = 0; w < 6; ++w)
{
    // number of the first entry, and where the part that it belongs to ends
    const int from = luminous ? (w < 4 ? 1 + 4 * w : 4 * w + 1) : 9 * (w >> 1) + 1 + 4 * (w & 1);
    const int end = luminous ? (w < 4 ? 16 : 4 * w + 4) : 9 * (w >> 1) + 9;
    unsigned bytes = 0u;
    #pragma unroll
    for (int b = 0; b < 4; ++b)
        if (from + b < end)
            bytes |= ((unsigned)max(-127, min(127, __float2int_rn(c[from + b] * scale))) & 0xffu) << (8 * b);
    uint32s[2 + w] = bytes;
}
uint4* to = reinterpret_cast<uint4*>(packed.data) + (size_t)target * 2;
to[0] = make_uint4(uint32s[0], uint32s[1], uint32s[2], uint32s[3]);
to[1] = make_uint4(uint32s[4], uint32s[5], uint32s[6], uint32s[7]);
