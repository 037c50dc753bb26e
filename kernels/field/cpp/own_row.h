// the harmonics of a row of 24 numbers in registers, on CUDA; `whole`: whether they are
float own[24];
const bool whole = width == 24 && ((reinterpret_cast<size_t>(sh.data) | reinterpret_cast<size_t>(halves.data)) & 15u) == 0;
if (whole && halves.data)
{
    const uint4* parts = reinterpret_cast<const uint4*>(halves.data) + (size_t)(unsigned)row * 3;
    uint4 part[3];
    #pragma unroll
    for (int p = 0; p < 3; ++p)
        part[p] = __ldg(parts + p);
    #pragma unroll
    for (int p = 0; p < 12; ++p)
    {
        const uint4 four = part[p / 4];
        const unsigned pair = p % 4 == 0 ? four.x : p % 4 == 1 ? four.y : p % 4 == 2 ? four.z : four.w;
        wp::half h;
        h.u = pair & 0xffffu;
        own[2 * p] = wp::half_to_float(h);
        h.u = pair >> 16;
        own[2 * p + 1] = wp::half_to_float(h);
    }
}
else if (whole)
{
    // six reads of 16 bytes, all under way at once; what a read leaves of a sector the next one finds in the cache
    const float4* parts = reinterpret_cast<const float4*>(sh.data) + (size_t)(unsigned)row * 6;
    float4 part[6];
    #pragma unroll
    for (int p = 0; p < 6; ++p)
        part[p] = __ldg(parts + p);
    #pragma unroll
    for (int p = 0; p < 6; ++p)
    {
        own[4 * p] = part[p].x;
        own[4 * p + 1] = part[p].y;
        own[4 * p + 2] = part[p].z;
        own[4 * p + 3] = part[p].w;
    }
}
