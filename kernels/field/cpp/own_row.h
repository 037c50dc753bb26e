// the harmonics of a row of 24 numbers in registers, on CUDA; `whole`: whether they are
float own[24];
const bool whole = width == 24 && (reinterpret_cast<size_t>(sh.data) & 15u) == 0;
if (whole)
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
