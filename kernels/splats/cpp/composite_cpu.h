#if !defined(__CUDA_ARCH__)
{
#pragma clang fp contract(fast)
#include "tile_lanes.h"
lanes left[16][2], red[16][2], green[16][2], blue[16][2], far[16][2];
const int of_view = tiles.columns * tiles.rows, picture = tile / of_view, own = tile % of_view;
const int x0 = (own % tiles.columns) * 16, y0 = (tiles.first_row + own / tiles.columns) * 16;
const int width = tiles.width - x0 < 16 ? tiles.width - x0 : 16;
const int height = tiles.height - y0 < 16 ? tiles.height - y0 : 16;
const bool with_depth = depth.shape[0] > 0;
unsigned alive = 0xffffffffu;
for (int y = 0; y < 16; ++y)
    for (int part = 0; part < 2; ++part)
    {
        const lanes x = steps + (float)(8 * part);
        const bits there = (x < (float)width) & (bits)(y < height ? -1 : 0);
        left[y][part] = (lanes)(there & (bits)((lanes)1.0f));
        red[y][part] = green[y][part] = blue[y][part] = far[y][part] = (lanes)0.0f;
    }
for (int e = begin; e < end && alive; ++e)
{
#include "tile_alive.h"
#include "tile_member.h"
    for (; parts; parts &= parts - 1u)
    {
#include "tile_raised.h"
        const lanes weight = alpha * left[y][part];
        red[y][part] += weight * p[6];
        green[y][part] += weight * p[7];
        blue[y][part] += weight * p[8];
        if (with_depth)
            far[y][part] += weight * (p[9] + p[11] * dy + p[10] * dx);
        left[y][part] -= weight;
    }
}
float* colors = reinterpret_cast<float*>(rgb.data);
for (int y = 0; y < height; ++y)
    for (int x = 0; x < width; ++x)
    {
        const int part = x >> 3, lane = x & 7;
        const size_t at = ((size_t)picture * tiles.height + y0 + y) * tiles.width + x0 + x;
        const float rest = left[y][part][lane], opacity = 1.0f - rest;
        colors[3 * at] = red[y][part][lane] + rest * background.c[0];
        colors[3 * at + 1] = green[y][part][lane] + rest * background.c[1];
        colors[3 * at + 2] = blue[y][part][lane] + rest * background.c[2];
        alpha.data[at] = opacity;
        if (with_depth)
            depth.data[at] = opacity > 1.0e-3f ? far[y][part][lane] / opacity : INFINITY;
    }
}
#endif
