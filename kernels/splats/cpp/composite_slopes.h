#if defined(__CUDA_ARCH__)
__shared__ float4 rows[8][32][3];
const int warp = (threadIdx.x >> 5) & 7, lane = threadIdx.x & 31;
const float gx = slope.c[0], gy = slope.c[1], gz = slope.c[2];
if (__ballot_sync(0xffffffffu, gx != 0.0f || gy != 0.0f || gz != 0.0f) == 0u)
    return;
const float4* rows_of = reinterpret_cast<const float4*>(view.data);
const int* member = reinterpret_cast<const int*>(members.data);
float* sum_of = reinterpret_cast<float*>(sums.data);
const float left = x - (float)(lane & 7), top = y - (float)(lane >> 3);
const float low = top - 0.002f, high = top + 3.002f, right = left + 7.002f;
float T = inside ? 1.0f : 0.0f, behind = color.c[0] * gx + color.c[1] * gy + color.c[2] * gz;
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
        float4* slot = rows[warp][__popc(which & ((1u << lane) - 1u))];
        slot[0] = a;
        slot[1] = b;
        slot[2] = make_float4(row[2].x, __int_as_float(number), 0.0f, 0.0f);
    }
    __syncwarp();
    const int count = __popc(which);
    for (int k = 0; k < count; ++k)
    {
#include "warp_power.h"
        const bool drawn = power >= -7.994353437f && T > stop;
        if (__ballot_sync(0xffffffffu, drawn) == 0u)
            continue;
        const float4 c = rows[warp][k][2];
        float q = 0.0f, weight = 0.0f;
        if (drawn)
        {
            const float raw = exp2f(power), alpha = fminf(raw, 0.999f);
            const float lit = b.z * gx + b.w * gy + c.x * gz;
            weight = alpha * T;
            behind -= weight * lit;
            if (raw < 0.999f)
                q = 0.6931471806f * alpha * (T * lit - behind / (1.0f - alpha));
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
            atomicAdd(sum_of + 9 * (size_t)__float_as_int(c.y) + (lane == 1 ? 8 : lane >> 2), lane == 1 ? last : one);
    }
    __syncwarp();
}
#endif
