const int width = sh.shape[1];
#include "cell_place.h"
#if defined(__CUDA_ARCH__)
const bool luminous = width == 24;
const int last = luminous ? 16 : 9;
float largest = 1.0e-20f;
#pragma unroll
for (int b = 1; b < 16; ++b)
    if (b < last)
        largest = fmaxf(largest, fabsf(basis.c[b]));
const float unit = largest * (1.0f / 127.0f);
const float scale = __fdividef(127.0f, largest);
int rounded[4];
#pragma unroll
for (int w = 0; w < 4; ++w)
{
    unsigned bytes = 0u;
    #pragma unroll
    for (int b = 0; b < 4; ++b)
        if (4 * w + b + 1 < last)
            bytes |= ((unsigned)__float2int_rn(basis.c[4 * w + b + 1] * scale) & 0xffu) << (8 * b);
    rounded[w] = (int)bytes;
}
// what the third to sixth uint32 of a row are multiplied by; the first two take the first two
const int third = luminous ? rounded[2] : rounded[0];
const int fourth = luminous ? rounded[3] : rounded[1];
const int sixth = luminous ? rounded[0] : rounded[1];
float first = 0.0f, second = 0.0f, extra = 0.0f, rest = 0.0f;
const uint4* numbers = reinterpret_cast<const uint4*>(packed.data);
uint2 entries[4]; // waited for together
#pragma unroll
for (int column = 0; column < 4; ++column)
    entries[column] = __ldg(reinterpret_cast<const uint2*>(columns.blocks.data) + begin
        + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * block_width);
#pragma unroll
for (int column = 0; column < 4; ++column)
{
    const uint2 entry = entries[column];
    const unsigned bits = entry.x >> place;
    int row = (int)entry.y + __popc(entry.x & low);
    const float share =
        ((column & 2) ? offset.c[0] : 1.0f - offset.c[0]) * ((column & 1) ? offset.c[1] : 1.0f - offset.c[1]);
    #pragma unroll
    for (int side = 0; side < 2; ++side)
    {
        if (bits & (1u << side))
        {
            const uint4 a = __ldg(numbers + (size_t)(unsigned)row * 2);
            const uint4 b = __ldg(numbers + (size_t)(unsigned)row * 2 + 1);
            ++row;
            const float weight = share * (side ? offset.c[2] : 1.0f - offset.c[2]);
            wp::half h;
            h.u = a.y >> 16;
            const float size = weight * unit * wp::half_to_float(h);
            const float constant = weight * basis.c[0];
            int sums[4] = {0, 0, 0, 0};
            asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[0]) : "r"(a.z), "r"(rounded[0]));
            asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[0]) : "r"(a.w), "r"(rounded[1]));
            asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[1]) : "r"(b.x), "r"(third));
            asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[1]) : "r"(b.y), "r"(fourth));
            asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[2]) : "r"(b.z), "r"(rounded[0]));
            asm("dp4a.s32.s32 %0, %1, %2, %0;" : "+r"(sums[3]) : "r"(b.w), "r"(sixth));
            h.u = a.x & 0xffffu;
            first += constant * wp::half_to_float(h) + size * (float)sums[0];
            h.u = a.x >> 16;
            const float middle = constant * wp::half_to_float(h);
            h.u = a.y & 0xffffu;
            const float end = constant * wp::half_to_float(h);
            // luminance: both halves of it, orange, green; else red, green, both halves of blue
            second += size * (float)sums[1] + (luminous ? 0.0f : middle);
            extra += size * (float)sums[2] + (luminous ? middle : end);
            rest += size * (float)sums[3] + (luminous ? end : 0.0f);
        }
    }
}
if (luminous)
{
    const float y = first + second + 0.5f - 0.5f * rest;
    return wp::vec_t<3, wp::float32>(y + extra, y + 1.5f * rest, y - extra);
}
return wp::vec_t<3, wp::float32>(first + 0.5f, second + 0.5f, extra + rest + 0.5f);
#else
// eight numbers at a time; the last eight may overlap those before them
typedef float lanes __attribute__((ext_vector_type(8), aligned(4)));
const int* order = columns.order.data;
lanes sum[4];
for (int part = 0; part < 4; ++part)
    sum[part] = 0.0f;
for (int column = 0; column < 4; ++column)
{
    const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * block_width;
    const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data) + 2 * (size_t)at;
    const unsigned bits = entry[0] >> place;
    int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
    const float share =
        ((column & 2) ? offset.c[0] : 1.0f - offset.c[0]) * ((column & 1) ? offset.c[1] : 1.0f - offset.c[1]);
    for (int side = 0; side < 2; ++side)
        if (bits & (1u << side))
        {
            #pragma clang fp contract(fast)
            const float weight = share * (side ? offset.c[2] : 1.0f - offset.c[2]);
            const float* numbers = sh.data + (size_t)(order ? order[row] : row) * width;
            ++row;
            sum[0] += weight * *reinterpret_cast<const lanes*>(numbers);
            sum[1] += weight * *reinterpret_cast<const lanes*>(numbers + 8);
            sum[2] += weight * *reinterpret_cast<const lanes*>(numbers + 16);
            if (width == 27)
                sum[3] += weight * *reinterpret_cast<const lanes*>(numbers + 19);
        }
}
float c[27];
*reinterpret_cast<lanes*>(c) = sum[0];
*reinterpret_cast<lanes*>(c + 8) = sum[1];
*reinterpret_cast<lanes*>(c + 16) = sum[2];
if (width == 27)
    *reinterpret_cast<lanes*>(c + 19) = sum[3];
#include "color_of_row.h"
return wp::vec_t<3, wp::float32>(red + 0.5f, green + 0.5f, blue + 0.5f);
#endif
