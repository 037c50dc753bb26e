#if defined(__CUDA_ARCH__)
__shared__ float4 places[8][32];
__shared__ float2 shapes[8][32], reds[8][32], blues[8][32];
const float gx = slope.c[0], gy = slope.c[1], gz = slope.c[2];
if (__ballot_sync(0xffffffffu, gx != 0.0f || gy != 0.0f || gz != 0.0f) == 0u)
    return;
#include "warp_members.h"
float* sum_of = reinterpret_cast<float*>(sums.data);
float T = inside ? 1.0f : 0.0f, behind = color.c[0] * gx + color.c[1] * gy + color.c[2] * gz;
for (int base = begin; base < end; base += 32)
{
    if (__ballot_sync(0xffffffffu, T > stop) == 0u)
        break;
#include "warp_round.h"
    if (touched)
    {
        places[warp][slot] = a;
        shapes[warp][slot] = make_float2(b.x, b.y);
        reds[warp][slot] = make_float2(b.z, b.w);
        blues[warp][slot] = make_float2(c.x, __int_as_float(number));
    }
    __syncwarp();
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
        // eight sums: lanes keep a half, then a quarter, then one of them; lane l has sum l / 4
        const bool half = lane & 16, quarter = lane & 8, eighth = lane & 4;
        const float qw = q * w, qs = q * s;
        const float v0 = q, v1 = qw, v2 = qs, v3 = qw * dx, v4 = qw * dy, v5 = qs * dy, v6 = weight * gx,
                    v7 = weight * gy;
        const float a0 = (half ? v4 : v0) + __shfl_xor_sync(0xffffffffu, half ? v0 : v4, 16);
        const float a1 = (half ? v5 : v1) + __shfl_xor_sync(0xffffffffu, half ? v1 : v5, 16);
        const float a2 = (half ? v6 : v2) + __shfl_xor_sync(0xffffffffu, half ? v2 : v6, 16);
        const float a3 = (half ? v7 : v3) + __shfl_xor_sync(0xffffffffu, half ? v3 : v7, 16);
        const float b0 = (quarter ? a2 : a0) + __shfl_xor_sync(0xffffffffu, quarter ? a0 : a2, 8);
        const float b1 = (quarter ? a3 : a1) + __shfl_xor_sync(0xffffffffu, quarter ? a1 : a3, 8);
        float one = (eighth ? b1 : b0) + __shfl_xor_sync(0xffffffffu, eighth ? b0 : b1, 4);
        one += __shfl_xor_sync(0xffffffffu, one, 2);
        one += __shfl_xor_sync(0xffffffffu, one, 1);
        float last = weight * gz;
        for (int reach = 16; reach > 0; reach >>= 1)
            last += __shfl_xor_sync(0xffffffffu, last, reach);
        if ((lane & 3) == 0 || lane == 1)
            atomicAdd(sum_of + 9 * (size_t)__float_as_int(blue.y) + (lane == 1 ? 8 : lane >> 2), lane == 1 ? last : one);
    }
    __syncwarp();
}
#endif
