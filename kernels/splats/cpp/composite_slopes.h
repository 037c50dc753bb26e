#if defined(__CUDA_ARCH__)
// Members that touch the 8x4 pixels of a warp queue up. Eight at a time are drawn, a lane a pixel, with nothing exchanged
// between lanes; then four lanes are a splat, and each sums a row of pixels.
constexpr int GROUP = 8, QUEUE = 40;  // less than a group that waits, and 32 of a round
__shared__ float4 places[8][QUEUE], shapes[8][QUEUE];
__shared__ float2 blues[8][QUEUE], kept[8][GROUP][37], slope_of[8][36];
__shared__ float blue_slope_of[8][36];
#if defined(WITH_DEPTHS)
__shared__ float2 leans[8][QUEUE];
__shared__ float distances[8][QUEUE], far_slope_of[8][36];
#endif
const float gx = slope.c[0], gy = slope.c[1], gz = slope.c[2];
bool counts = gx != 0.0f || gy != 0.0f || gz != 0.0f;
#if defined(WITH_DEPTHS)
const float solid = other.c[0], far = other.c[1];
counts = counts || solid != 0.0f || far != 0.0f;
#endif
if (__ballot_sync(0xffffffffu, counts) == 0u)
    return;
#include "warp_members.h"
float* sum_of = reinterpret_cast<float*>(sums.data);
const int line = lane & 3, pixel = lane + ((lane >> 4) << 2);  // a gap and rows of 37: lanes read other banks
slope_of[warp][pixel] = make_float2(gx, gy);
blue_slope_of[warp][pixel] = gz;
#if defined(WITH_DEPTHS)
far_slope_of[warp][pixel] = far;
float* depths_of = reinterpret_cast<float*>(depth_sums.data);
#endif
float T = inside ? 1.0f : 0.0f, behind = color.c[0] * gx + color.c[1] * gy + color.c[2] * gz;
#if defined(WITH_DEPTHS)
behind += other.c[2];
#endif
int head = 0, filled = 0;
for (int base = begin; base < end; base += 32)
{
    if (__ballot_sync(0xffffffffu, T > stop) == 0u)
        break;
#include "warp_round.h"
    if (touched)
    {
        const int at = head + filled + slot, place = at < QUEUE ? at : at - QUEUE;
        places[warp][place] = a;
        shapes[warp][place] = b;
        blues[warp][place] = make_float2(c.x, __int_as_float(number));
#if defined(WITH_DEPTHS)
        distances[warp][place] = c.y;
        leans[warp][place] = make_float2(c.z, c.w);
#endif
    }
    filled += count;
    const int missing = base + 32 < end ? 0 : -filled & (GROUP - 1);
    if (lane < missing)  // the last group is filled with what is not seen
    {
        const int at = head + filled + lane, place = at < QUEUE ? at : at - QUEUE;
        places[warp][place] = make_float4(0.0f, 0.0f, -100.0f, 0.0f);
        shapes[warp][place] = make_float4(0.0f, 0.0f, 0.0f, 0.0f);
        blues[warp][place] = make_float2(0.0f, __int_as_float(-1));
#if defined(WITH_DEPTHS)
        distances[warp][place] = 0.0f;
        leans[warp][place] = make_float2(0.0f, 0.0f);
#endif
    }
    filled += missing;
    __syncwarp();
    for (; filled >= GROUP; filled -= GROUP)
    {
#pragma unroll
        for (int k = 0; k < GROUP; ++k)
        {
            const float4 place = places[warp][head + k], shape = shapes[warp][head + k];
            const float dx = x - place.x, dy = y - place.y;
            const float w = place.w * dx + shape.x * dy, s = shape.y * dy;
            const float power = place.z - w * w - s * s;
            float raised;
            asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(raised) : "f"(power));
            const float alpha = power >= -7.994353437f && T > stop ? fminf(raised, 0.999f) : 0.0f;
            const float weight = alpha * T;
            float lit = shape.z * gx + shape.w * gy + blues[warp][head + k].x * gz;
#if defined(WITH_DEPTHS)
            const float2 lean = leans[warp][head + k];
            lit += solid + far * (distances[warp][head + k] + lean.x * dx + lean.y * dy);
#endif
            behind -= weight * lit;
            const float q = alpha * (T * lit - __fdividef(behind, 1.0f - alpha));
            T -= weight;
            kept[warp][k][pixel] = make_float2(raised < 0.999f ? q : 0.0f, weight);
        }
        __syncwarp();
        const int own = head + (lane >> 2);
        const float4 place = places[warp][own];
        const float2 shape = make_float2(shapes[warp][own].x, shapes[warp][own].y);
        const float dx = left - place.x, dy = top + (float)line - place.y;
        float m0 = 0.0f, m1 = 0.0f, m2 = 0.0f, v6 = 0.0f, v7 = 0.0f, last = 0.0f;
#if defined(WITH_DEPTHS)
        float d0 = 0.0f, d1 = 0.0f;
#endif
#pragma unroll
        for (int i = 0; i < 8; ++i)
        {
            const int from = 8 * line + 4 * (line >> 1) + i;
            const float2 pair = kept[warp][lane >> 2][from], rg = slope_of[warp][from];
            m0 += pair.x;
            m1 += (float)i * pair.x;
            m2 += (float)(i * i) * pair.x;
            v6 += pair.y * rg.x;
            v7 += pair.y * rg.y;
            last += pair.y * blue_slope_of[warp][from];
#if defined(WITH_DEPTHS)
            const float by_depth = pair.y * far_slope_of[warp][from];
            d0 += by_depth;
            d1 += (float)i * by_depth;
#endif
        }
        // w is w0 + i l_0 at the i-th pixel, dx + i away
        const float w0 = place.w * dx + shape.x * dy;
        const float v0 = 0.6931471806f * m0, v1 = 0.6931471806f * (w0 * m0 + place.w * m1), v2 = shape.y * dy * v0;
        const float v3 = dx * v1 + 0.6931471806f * (w0 * m1 + place.w * m2), v4 = dy * v1, v5 = dy * v2;
        // eight sums: lanes keep a half, then a quarter of them
        const bool half = line & 2, odd = line & 1;
        const float a0 = (half ? v4 : v0) + __shfl_xor_sync(0xffffffffu, half ? v0 : v4, 2);
        const float a1 = (half ? v5 : v1) + __shfl_xor_sync(0xffffffffu, half ? v1 : v5, 2);
        const float a2 = (half ? v6 : v2) + __shfl_xor_sync(0xffffffffu, half ? v2 : v6, 2);
        const float a3 = (half ? v7 : v3) + __shfl_xor_sync(0xffffffffu, half ? v3 : v7, 2);
        const float b0 = (odd ? a2 : a0) + __shfl_xor_sync(0xffffffffu, odd ? a0 : a2, 1);
        const float b1 = (odd ? a3 : a1) + __shfl_xor_sync(0xffffffffu, odd ? a1 : a3, 1);
        last += __shfl_xor_sync(0xffffffffu, last, 2);
        last += __shfl_xor_sync(0xffffffffu, last, 1);
#if defined(WITH_DEPTHS)
        float along = dx * d0 + d1, down = dy * d0;
        for (int reach = 2; reach > 0; reach >>= 1)
        {
            d0 += __shfl_xor_sync(0xffffffffu, d0, reach);
            along += __shfl_xor_sync(0xffffffffu, along, reach);
            down += __shfl_xor_sync(0xffffffffu, down, reach);
        }
#endif
        __syncwarp();
        // sums that lie beside each other are added together
        float* joined = reinterpret_cast<float*>(kept[warp]);
        joined[9 * (lane >> 2) + 2 * line] = b0;
        joined[9 * (lane >> 2) + 2 * line + 1] = b1;
        if (line == 0)
            joined[9 * (lane >> 2) + 8] = last;
#if defined(WITH_DEPTHS)
        if (line < 3)
            joined[9 * GROUP + 3 * (lane >> 2) + line] = line == 0 ? d0 : line == 1 ? along : down;
#endif
        __syncwarp();
        for (int i = lane; i < 9 * GROUP; i += 32)
        {
            const int number = __float_as_int(blues[warp][head + i / 9].y);
            if (number >= 0)
                atomicAdd(sum_of + 9 * (size_t)number + i % 9, joined[i]);
        }
#if defined(WITH_DEPTHS)
        if (lane < 3 * GROUP)
        {
            const int number = __float_as_int(blues[warp][head + lane / 3].y);
            if (number >= 0)
                atomicAdd(depths_of + 3 * (size_t)number + lane % 3, joined[9 * GROUP + lane]);
        }
#endif
        __syncwarp();
        head = head + GROUP < QUEUE ? head + GROUP : 0;
    }
}
#endif
