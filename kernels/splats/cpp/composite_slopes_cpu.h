#if !defined(__CUDA_ARCH__)
typedef float lanes __attribute__((ext_vector_type(8)));
typedef int bits __attribute__((ext_vector_type(8)));
const lanes steps = {0.5f, 1.5f, 2.5f, 3.5f, 4.5f, 5.5f, 6.5f, 7.5f};
const float least = -7.994353437f;
lanes left[16][2], behind[16][2], slope[3][16][2];
const int x0 = (tile % tiles.columns) * 16, y0 = (tiles.first_row + tile / tiles.columns) * 16;
const int width = tiles.width - x0 < 16 ? tiles.width - x0 : 16;
const int height = tiles.height - y0 < 16 ? tiles.height - y0 : 16;
const float* colors = reinterpret_cast<const float*>(rgb.data);
const float* given = reinterpret_cast<const float*>(slopes.data);
for (int y = 0; y < 16; ++y)
    for (int x = 0; x < 16; ++x)
    {
        const int part = x >> 3, lane = x & 7;
        const bool there = x < width && y < height;
        const size_t at = 3 * ((size_t)(y0 + y) * tiles.width + x0 + x);
        float rest = 0.0f;
        for (int c = 0; c < 3; ++c)
        {
            const float g = there ? given[at + c] : 0.0f;
            slope[c][y][part][lane] = g;
            rest += there ? g * colors[at + c] : 0.0f;
        }
        behind[y][part][lane] = rest;
        left[y][part][lane] = there ? 1.0f : 0.0f;
    }
for (int e = begin; e < end; ++e)
{
#include "tile_member.h"
    const int first_row = from > 0.0f ? (from > 16.0f ? 16 : (int)from) : 0;
    const int last_row = to < (float)(height - 1) ? (to < 0.0f ? -1 : (int)to) : height - 1;
    const float wide = 1.0f / l0;
    lanes found[9];
    for (int i = 0; i < 9; ++i)
        found[i] = (lanes)0.0f;
    for (int y = first_row; y <= last_row; ++y)
    {
#include "tile_row.h"
        for (int part = first_part; part <= last_part; ++part)
        {
#include "tile_raised.h"
            const bits free = drawn & (raised < 0.999f);
            lanes alpha = raised < 0.999f ? raised : (lanes)0.999f;
            alpha = (lanes)((bits)alpha & drawn);
            const lanes weight = alpha * left[y][part];
            const lanes gx = slope[0][y][part], gy = slope[1][y][part], gz = slope[2][y][part];
            const lanes lit = gx * p[6] + gy * p[7] + gz * p[8];
            behind[y][part] -= weight * lit;
            lanes q = 0.6931471806f * alpha * (left[y][part] * lit - behind[y][part] / (1.0f - alpha));
            q = (lanes)((bits)q & free);
            left[y][part] -= weight;
            const lanes qw = q * w, qs = q * s;
            found[0] += q;
            found[1] += qw;
            found[2] += qs;
            found[3] += qw * dx;
            found[4] += qw * dy;
            found[5] += qs * dy;
            found[6] += weight * gx;
            found[7] += weight * gy;
            found[8] += weight * gz;
        }
    }
    float* row = reinterpret_cast<float*>(entry_sums.data) + 9 * (size_t)sources.data[e];
    for (int i = 0; i < 9; ++i)
    {
        float total = 0.0f;
        for (int lane = 0; lane < 8; ++lane)
            total += found[i][lane];
        row[i] = total;
    }
}
#endif
