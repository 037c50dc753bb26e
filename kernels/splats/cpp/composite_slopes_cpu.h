#if !defined(__CUDA_ARCH__)
{
#pragma clang fp contract(fast)
#include "tile_lanes.h"
lanes left[16][2], behind[16][2], slope[3][16][2];
const int of_view = tiles.columns * tiles.rows, picture = tile / of_view, own = tile % of_view;
const int x0 = (own % tiles.columns) * 16, y0 = (tiles.first_row + own / tiles.columns) * 16;
const int width = tiles.width - x0 < 16 ? tiles.width - x0 : 16;
const int height = tiles.height - y0 < 16 ? tiles.height - y0 : 16;
const float* colors = reinterpret_cast<const float*>(rgb.data);
const float* given = reinterpret_cast<const float*>(slopes.data);
#if defined(WITH_DEPTHS)
lanes solid[16][2], far[16][2];
const float* beside = reinterpret_cast<const float*>(others.data);
#endif
unsigned alive = 0xffffffffu;
for (int y = 0; y < 16; ++y)
    for (int x = 0; x < 16; ++x)
    {
        const int part = x >> 3, lane = x & 7;
        const bool there = x < width && y < height;
        const size_t at = 3 * (((size_t)picture * tiles.height + y0 + y) * tiles.width + x0 + x);
        float rest = 0.0f;
        for (int c = 0; c < 3; ++c)
        {
            const float g = there ? given[at + c] : 0.0f;
            slope[c][y][part][lane] = g;
            rest += there ? g * colors[at + c] : 0.0f;
        }
#if defined(WITH_DEPTHS)
        solid[y][part][lane] = there ? beside[at] : 0.0f;
        far[y][part][lane] = there ? beside[at + 1] : 0.0f;
        rest += there ? beside[at + 2] : 0.0f;
#endif
        behind[y][part][lane] = rest;
        left[y][part][lane] = there ? 1.0f : 0.0f;
    }
for (int e = begin; e < end; ++e)
{
#include "tile_alive.h"
#include "tile_member.h"
    lanes found[9];
    for (int i = 0; i < 9; ++i)
        found[i] = (lanes)0.0f;
#if defined(WITH_DEPTHS)
    lanes depths[3] = {(lanes)0.0f, (lanes)0.0f, (lanes)0.0f};
#endif
    for (; parts; parts &= parts - 1u)
    {
#include "tile_raised.h"
        const lanes weight = alpha * left[y][part];
        const lanes gx = slope[0][y][part], gy = slope[1][y][part], gz = slope[2][y][part];
        lanes lit = gx * p[6] + gy * p[7] + gz * p[8];
#if defined(WITH_DEPTHS)
        lit += solid[y][part] + far[y][part] * (p[9] + p[11] * dy + p[10] * dx);
        const lanes by_depth = weight * far[y][part];
        depths[0] += by_depth;
        depths[1] += by_depth * dx;
        depths[2] += by_depth * dy;
#endif
        behind[y][part] -= weight * lit;
        lanes q = alpha * (left[y][part] * lit - behind[y][part] / (1.0f - alpha));
        q = raised < 0.999f ? q : (lanes)0.0f;
        left[y][part] -= weight;
        const lanes qw = q * w;
        found[0] += q;
        found[1] += qw;
        found[2] += q * s;
        found[3] += qw * dx;
        found[4] += qw * dy;
        found[5] += q * (s * dy);
        found[6] += weight * gx;
        found[7] += weight * gy;
        found[8] += weight * gz;
    }
    // eight sums of lanes at once: four lanes of each, then two, then one
    lanes half[4], quarter[2];
    for (int i = 0; i < 4; ++i)
        half[i] = __builtin_shufflevector(found[i], found[i + 4], 0, 1, 2, 3, 8, 9, 10, 11) +
                  __builtin_shufflevector(found[i], found[i + 4], 4, 5, 6, 7, 12, 13, 14, 15);
    for (int i = 0; i < 2; ++i)
        quarter[i] = __builtin_shufflevector(half[i], half[i + 2], 0, 1, 8, 9, 4, 5, 12, 13) +
                     __builtin_shufflevector(half[i], half[i + 2], 2, 3, 10, 11, 6, 7, 14, 15);
    lanes sums = __builtin_shufflevector(quarter[0], quarter[1], 0, 8, 2, 10, 4, 12, 6, 14) +
                 __builtin_shufflevector(quarter[0], quarter[1], 1, 9, 3, 11, 5, 13, 7, 15);
    sums *= (lanes){0.6931471806f, 0.6931471806f, 0.6931471806f, 0.6931471806f, 0.6931471806f, 0.6931471806f, 1.0f, 1.0f};
    float* row = reinterpret_cast<float*>(entry_sums.data) + 9 * (size_t)sources.data[e];
    __builtin_memcpy(row, &sums, sizeof(sums));
    float last = 0.0f;
    for (int lane = 0; lane < 8; ++lane)
        last += found[8][lane];
    row[8] = last;
#if defined(WITH_DEPTHS)
    float* row_of_depths = reinterpret_cast<float*>(entry_depths.data) + 3 * (size_t)sources.data[e];
    for (int i = 0; i < 3; ++i)
    {
        float total = 0.0f;
        for (int lane = 0; lane < 8; ++lane)
            total += depths[i][lane];
        row_of_depths[i] = total;
    }
#endif
}
}
#endif
