#if defined(__CUDA_ARCH__)
// A lane is a pixel while splats are drawn. Every eight of them, four lanes are a splat, and each sums a row of pixels.
__shared__ float4 places[8][32];
__shared__ float2 shapes[8][32], reds[8][32], blues[8][32], kept[8][8][37];
__shared__ float totals[8][72];
__shared__ int numbers[8][8];
const int warp = (threadIdx.x >> 5) & 7, lane = threadIdx.x & 31, line = lane & 3;
const float gx = slope.c[0], gy = slope.c[1], gz = slope.c[2];
if (__ballot_sync(0xffffffffu, gx != 0.0f || gy != 0.0f || gz != 0.0f) == 0u)
    return;
float3 slopes_of_row[8];
for (int i = 0; i < 8; ++i)
    slopes_of_row[i] = make_float3(
        __shfl_sync(0xffffffffu, gx, 8 * line + i), __shfl_sync(0xffffffffu, gy, 8 * line + i),
        __shfl_sync(0xffffffffu, gz, 8 * line + i));
const float4* rows_of = reinterpret_cast<const float4*>(view.data);
const int* member = reinterpret_cast<const int*>(members.data);
float* sum_of = reinterpret_cast<float*>(sums.data);
const float left = x - (float)(lane & 7), top = y - (float)(lane >> 3);
const float low = top - 0.002f, high = top + 3.002f, right = left + 7.002f;
const int place = lane + ((lane >> 4) << 2);  // a gap in the middle and rows of 37: lanes of a splat read other banks
float T = inside ? 1.0f : 0.0f, behind = color.c[0] * gx + color.c[1] * gy + color.c[2] * gz;
int filled = 0, own = 0;  // splats that are kept, and which of all this lane will sum
float4 own_place;
float2 own_shape;
const auto add_kept = [&]()
{
    __syncwarp();
    const bool half = line & 2, odd = line & 1;
    const float dy = top + (float)line - own_place.y, begin_x = left - own_place.x;
    const float begin_w = own_place.w * begin_x + own_shape.x * dy;
    float v0 = 0.0f, v1 = 0.0f, v3 = 0.0f, v6 = 0.0f, v7 = 0.0f, last = 0.0f;
#pragma unroll
    for (int i = 0; i < 8; ++i)
    {
        const float2 pair = kept[warp][lane >> 2][8 * line + 4 * (line >> 1) + i];
        const float qw = pair.x * (begin_w + (float)i * own_place.w);
        v0 += pair.x;
        v1 += qw;
        v3 += qw * (begin_x + (float)i);
        v6 += pair.y * slopes_of_row[i].x;
        v7 += pair.y * slopes_of_row[i].y;
        last += pair.y * slopes_of_row[i].z;
    }
    // eight sums: lanes keep a half, then a quarter of them
    const float v2 = own_shape.y * dy * v0, v4 = dy * v1, v5 = dy * v2;
    const float a0 = (half ? v4 : v0) + __shfl_xor_sync(0xffffffffu, half ? v0 : v4, 2);
    const float a1 = (half ? v5 : v1) + __shfl_xor_sync(0xffffffffu, half ? v1 : v5, 2);
    const float a2 = (half ? v6 : v2) + __shfl_xor_sync(0xffffffffu, half ? v2 : v6, 2);
    const float a3 = (half ? v7 : v3) + __shfl_xor_sync(0xffffffffu, half ? v3 : v7, 2);
    const float b0 = (odd ? a2 : a0) + __shfl_xor_sync(0xffffffffu, odd ? a0 : a2, 1);
    const float b1 = (odd ? a3 : a1) + __shfl_xor_sync(0xffffffffu, odd ? a1 : a3, 1);
    last += __shfl_xor_sync(0xffffffffu, last, 2);
    last += __shfl_xor_sync(0xffffffffu, last, 1);
    // numbers that lie beside each other are added together
    float* joined = &totals[warp][9 * (lane >> 2)];
    joined[2 * line] = b0;
    joined[2 * line + 1] = b1;
    if (line == 0)
    {
        joined[8] = last;
        numbers[warp][lane >> 2] = own;
    }
    __syncwarp();
    for (int i = lane; i < 9 * filled; i += 32)
        atomicAdd(sum_of + 9 * (size_t)numbers[warp][i / 9] + i % 9, totals[warp][i]);
    filled = 0;
    __syncwarp();
};
for (int base = begin; base < end; base += 32)
{
    if (__ballot_sync(0xffffffffu, T > stop) == 0u)
        break;
    bool touched = false;
    float4 a, b;
    const float4* row = rows_of;
    int number = 0;
    if (base + lane < end)
    {
        number = member[base + lane];
        row += 3u * (unsigned)number;
        a = row[0];
        b = row[1];
#include "warp_reach.h"
    }
    const unsigned which = __ballot_sync(0xffffffffu, touched);
    if (touched)
    {
        const int slot = __popc(which & ((1u << lane) - 1u));
        places[warp][slot] = a;
        shapes[warp][slot] = make_float2(b.x, b.y);
        reds[warp][slot] = make_float2(b.z, b.w);
        blues[warp][slot] = make_float2(row[2].x, __int_as_float(number));
    }
    __syncwarp();
    const int count = __popc(which);
    for (int k = 0; k < count; ++k)
    {
#include "warp_power.h"
        const bool drawn = power >= -7.994353437f && T > stop;
        if (__ballot_sync(0xffffffffu, drawn) == 0u)
            continue;
        const float2 rg = reds[warp][k], blue = blues[warp][k];
        float q = 0.0f, weight = 0.0f;
        if (drawn)
        {
            const float lit = rg.x * gx + rg.y * gy + blue.x * gz;
            weight = alpha * T;
            behind -= weight * lit;
            if (raised < 0.999f)
                q = 0.6931471806f * alpha * (T * lit - __fdividef(behind, 1.0f - alpha));
            T -= weight;
        }
        kept[warp][filled][place] = make_float2(q, weight);
        if ((lane >> 2) == filled)
        {
            own = __float_as_int(blue.y);
            own_place = a;
            own_shape = b;
        }
        if (++filled == 8)
            add_kept();
    }
    __syncwarp();
}
if (filled > 0)
    add_kept();
#endif
