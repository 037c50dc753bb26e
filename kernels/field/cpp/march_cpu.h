wp::mat_t<32, 6, wp::float32> seen;
#if !defined(__CUDA_ARCH__)
const bool turns = false;
float bases[32][40] = {};
#include "cpu_samples.h"
const float inverse_step = 1.0f / step;
const unsigned char* skip = grid.skip.data;
lanes t = 0.0f, end = -1.0f, k = 0.0f, transmittance = 1.0f, depth = 0.0f, pending = 0.0f;
lanes slope_x = 0.0f, slope_y = 0.0f, slope_z = 0.0f, inverse_x = 1.0f, inverse_y = 1.0f, inverse_z = 1.0f;
int ray_of[lane_count];
unsigned live = 0u;
int next = 0;
auto begin_ray = [&](int lane) {
    for (; next < 32; ++next)
    {
        const float begin = steps_to_sample(firsts.c[next]) * step;
        if (!(begin < ends.c[next]))
            continue;
        const float x = directions.data[next][0], y = directions.data[next][1], z = directions.data[next][2];
        const float rate_x = x * grid.inverse_voxel_size.c[0], rate_y = y * grid.inverse_voxel_size.c[1];
        const float rate_z = z * grid.inverse_voxel_size.c[2];
        slope_x[lane] = rate_x;
        slope_y[lane] = rate_y;
        slope_z[lane] = rate_z;
        inverse_x[lane] = reciprocal(rate_x);
        inverse_y[lane] = reciprocal(rate_y);
        inverse_z[lane] = reciprocal(rate_z);
        k[lane] = firsts.c[next];
        t[lane] = begin;
        end[lane] = ends.c[next];
        transmittance[lane] = 1.0f;
        depth[lane] = pending[lane] = 0.0f;
        float* values = bases[next] + 8;
#include "basis_of_direction.h"
        ray_of[lane] = next++;
        live |= 1u << lane;
        return;
    }
    end[lane] = -1.0f;
    t[lane] = 0.0f;
    live &= ~(1u << lane);
};
for (int ray = 0; ray < 32; ++ray)
{
    for (int n = 0; n < 6; ++n)
        seen.data[ray][n] = 0.0f;
    seen.data[ray][3] = 1.0f;
}
for (int lane = 0; lane < lane_count; ++lane)
    begin_ray(lane);
while (live)
{
    const unsigned ended = live & ~bits_of((t < end) & (transmittance > stop));
    if (ended)
    {
        for (unsigned left = ended; left; left &= left - 1u)
        {
            const int lane = __builtin_ctz(left);
            float* result = seen.data[ray_of[lane]];
            result[3] = transmittance[lane];
            result[4] = depth[lane];
            result[5] = pending[lane];
            begin_ray(lane);
        }
    }
    const lanes g_x = start.c[0] + t * slope_x, g_y = start.c[1] + t * slope_y, g_z = start.c[2] + t * slope_z;
    const ints i = cell_of(g_x, cells_x - 1), j = cell_of(g_y, cells_y - 1), l = cell_of(g_z, cells_z - 1);
    const lanes x = g_x - __builtin_convertvector(i, lanes), y = g_y - __builtin_convertvector(j, lanes);
    const lanes z = g_z - __builtin_convertvector(l, lanes);
    const ints at = (i * cells_y + j) * cells_z + l;
    ints empty;
    for (int lane = 0; lane < lane_count; ++lane)
        empty[lane] = skip[(unsigned)at[lane]];
    lanes sigma = 0.0f;
    const unsigned filled = live & bits_of(empty == 0);
    add_densities(filled, i, j, l, x, y, z, sigma);
    const ints found = sigma > 0.0f;
    if (bits_of(found))
    {
        const lanes kept = found ? exponential(-sigma * step) : (lanes)1.0f;
        const lanes weight = transmittance * (1.0f - kept);
        pending += weight;
        const ints shows = found & (pending > least);
        for (unsigned left = bits_of(shows); left; left &= left - 1u)
        {
            const int lane = __builtin_ctz(left);
            shown[shown_count++] = {ray_of[lane], i[lane], j[lane], l[lane], x[lane], y[lane], z[lane], pending[lane]};
        }
        pending = shows ? (lanes)0.0f : pending;
        depth += weight * t;
        transmittance *= kept;
    }
    const lanes reach = __builtin_convertvector(empty, lanes);
    const lanes leave = t + exit_of_cells(x, y, z, inverse_x, inverse_y, inverse_z, reach);
    const lanes after = first_sample(leave * inverse_step);
    k += 1.0f;
    k = ((empty > 0) & (after > k)) ? after : k;
    t = steps_to_sample(k) * step;
}
ask_for_colors();
add_colors();
for (int ray = 0; ray < 32; ++ray)
    for (int n = 0; n < 3; ++n)
        seen.data[ray][n] = colors[ray][n];
#endif
return seen;
