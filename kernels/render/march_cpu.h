wp::mat_t<32, 10, wp::float32> seen = before;
#if !defined(__CUDA_ARCH__)
const bool turns = true;
float bases[1][40] = {};
#include "../field/cpp/cpu_samples.h"
bool any = false;
for (int ray = 0; ray < 32; ++ray)
    any |= steps_to_sample(rays.data[ray][8]) * options.step < rays.data[ray][7];
if (!any)
    return seen;

// the map of "Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1, along a ray through a cell, from pointers
// to four pairs of nodes along the last axis
// position and distance are c[0] + u c[1] + u^2 c[2] + u^3 c[3], u from where the cell was met
struct Cubic
{
    four c[4];
};
auto along_ray = [](const four* a, const four* b, const four* c, const four* d, four f, four rate) {
    const four* pairs[4] = {a, b, c, d};
    four linear[4][2];
    for (int n = 0; n < 4; ++n)
    {
        const four up = pairs[n][1] - pairs[n][0];
        linear[n][0] = pairs[n][0] + f.z * up;
        linear[n][1] = rate.z * up;
    }
    four square[2][3];
    for (int n = 0; n < 2; ++n)
    {
        const four up = linear[2 * n + 1][0] - linear[2 * n][0], more = linear[2 * n + 1][1] - linear[2 * n][1];
        square[n][0] = linear[2 * n][0] + f.y * up;
        square[n][1] = linear[2 * n][1] + f.y * more + rate.y * up;
        square[n][2] = rate.y * more;
    }
    const four up = square[1][0] - square[0][0], more = square[1][1] - square[0][1];
    const four most = square[1][2] - square[0][2];
    Cubic result;
    result.c[0] = square[0][0] + f.x * up;
    result.c[1] = square[0][1] + f.x * more + rate.x * up;
    result.c[2] = square[0][2] + f.x * most + rate.x * more;
    result.c[3] = rate.x * most;
    return result;
};

// as edits/structs has it
auto rest_distance = [&](float x, float y, float z) {
    const auto& rest = edit.rest;
    const int my = rest.distance.shape[1], mz = rest.distance.shape[2];
    const float g_x = (x - rest.lower.c[0]) * rest.inverse_spacing;
    const float g_y = (y - rest.lower.c[1]) * rest.inverse_spacing;
    const float g_z = (z - rest.lower.c[2]) * rest.inverse_spacing;
    if (!(g_x >= 0.0f && g_y >= 0.0f && g_z >= 0.0f && g_x < (float)(rest.distance.shape[0] - 1)
            && g_y < (float)(my - 1) && g_z < (float)(mz - 1)))
        return 4.0f * rest.spacing;
    const int i = (int)g_x, j = (int)g_y, k = (int)g_z;
    const float fx = g_x - (float)i, fy = g_y - (float)j, fz = g_z - (float)k;
    const float* at = rest.distance.data + ((size_t)(unsigned)(i * my + j) * (unsigned)mz + k);
    const float a = at[0] + fz * (at[1] - at[0]);
    const float b = at[mz] + fz * (at[mz + 1] - at[mz]);
    at += (size_t)my * mz;
    const float c = at[0] + fz * (at[1] - at[0]);
    const float d = at[mz] + fz * (at[mz + 1] - at[mz]);
    const float low = a + fy * (b - a), high = c + fy * (d - c);
    return low + fx * (high - low);
};
const float step = options.step, stop = options.stop, inverse_spacing = edit.inverse_spacing;
const float spacing = 1.0f / inverse_spacing, box_x = grid.voxel_size.c[0], box_y = grid.voxel_size.c[1];
const float box_z = grid.voxel_size.c[2], thinnest = wp::min(wp::min(box_x, box_y), box_z);
const int nz = edit.node_counts.c[2], nyz = edit.node_counts.c[1] * nz;
const four* nodes = reinterpret_cast<const four*>(edit.nodes.data);
const unsigned char* look = edit.look.data;
const unsigned char* skip = grid.skip.data;
const bool maps = edit.removes == 0, clears_source = edit.keeps_source == 0;

// of the rays that the lanes follow
lanes end = -1.0f, rate_x = 0.0f, rate_y = 0.0f, rate_z = 0.0f;
lanes inverse_x = 1.0f, inverse_y = 1.0f, inverse_z = 1.0f;
lanes box_near = 1.0f, box_far = 0.0f, span_near = 1.0f, span_far = 0.0f;
// where they are: sub-sample j of `count` of sample k, 0 where that is not known, so one
lanes t = 0.0f, k = 0.0f, count = 0.0f, j = 0.0f;
lanes transmittance = 1.0f, cleared = 1.0f, depth = 0.0f, pending = 0.0f;
lanes reveal = 0.0f, fold = 0.0f, outside = 0.0f;
// the lattice cell where they were last, the table of its sides, and the map along the ray from `met` on
ints cell = -1, entry = 0;
lanes met = 0.0f;
float map[16][lane_count] = {};
int ray_of[lane_count];
unsigned live = 0u;
int next = 0;
auto begin_ray = [&](int lane) {
    for (; next < 32; ++next)
    {
        const float* ray = rays.data[next];
        const float begin = steps_to_sample(ray[8]) * step;
        if (!(begin < ray[7]))
            continue;
        rate_x[lane] = ray[0];
        rate_y[lane] = ray[1];
        rate_z[lane] = ray[2];
        inverse_x[lane] = reciprocal(ray[0]);
        inverse_y[lane] = reciprocal(ray[1]);
        inverse_z[lane] = reciprocal(ray[2]);
        box_near[lane] = ray[3];
        box_far[lane] = ray[4];
        span_near[lane] = ray[5];
        span_far[lane] = ray[6];
        end[lane] = ray[7];
        k[lane] = ray[8];
        t[lane] = begin;
        const float* state = before.data[next];
        transmittance[lane] = state[3];
        depth[lane] = state[4];
        cleared[lane] = state[5];
        reveal[lane] = state[6];
        fold[lane] = state[7];
        outside[lane] = state[8];
        pending[lane] = state[9];
        count[lane] = j[lane] = 0.0f;
        cell[lane] = -1;
        entry[lane] = 0;
        ray_of[lane] = next++;
        live |= 1u << lane;
        return;
    }
    end[lane] = -1.0f;
    t[lane] = 0.0f;
    live &= ~(1u << lane);
};
for (int ray = 0; ray < 32; ++ray)
    for (int n = 0; n < 3; ++n)
        colors[ray][n] = before.data[ray][n];
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
            result[5] = cleared[lane];
            result[6] = reveal[lane];
            result[7] = fold[lane];
            result[8] = outside[lane];
            result[9] = pending[lane];
            begin_ray(lane);
        }
        continue;
    }
    // the next sample; from 2^24 on the next one that float32 has, so that a march through a cage far away ends
    const lanes k_after = k + higher_of(6.0e-8f * k, (lanes)1.0f);
    // the place on the lattice
    const lanes place_x = start.c[0] + t * rate_x, place_y = start.c[1] + t * rate_y;
    const lanes place_z = start.c[2] + t * rate_z;
    const ints in_box = (t >= box_near) & (t < box_far);
    const ints a = cell_of(place_x, edit.node_counts.c[0] - 2), b = cell_of(place_y, edit.node_counts.c[1] - 2);
    const ints c = cell_of(place_z, nz - 2), at = a * nyz + b * nz + c;
    const lanes f_x = place_x - __builtin_convertvector(a, lanes);
    const lanes f_y = place_y - __builtin_convertvector(b, lanes);
    const lanes f_z = place_z - __builtin_convertvector(c, lanes);
    ints flags;
    for (int lane = 0; lane < lane_count; ++lane)
        flags[lane] = look[(unsigned)at[lane]];
    flags = in_box ? flags : (ints)0;
    const ints far_off = flags >= look_skip;
    const lanes cell_exit = exit_of_cells(f_x, f_y, f_z, inverse_x, inverse_y, inverse_z,
        far_off ? __builtin_convertvector(flags - look_skip, lanes) : (lanes)1.0f);
    lanes leave = far_off ? higher_of(lower_of(t + cell_exit, box_far), t + 0.5f * step) : t;
    if (2 * __builtin_popcount(live & bits_of(far_off)) >= __builtin_popcount(live))
    {
        // most lanes only jump: the others wait
        k = far_off ? higher_of(k_after, first_sample(leave / step)) : k;
        count = far_off ? (lanes)0.0f : count;
        j = far_off ? (lanes)0.0f : j;
        t = far_off ? steps_to_sample(k) * step : t;
        continue;
    }

    // the map
    const ints asked = in_box & ~far_off & ((flags & cell_outside) == 0) & (maps ? -1 : 0);
    for (unsigned left = live & bits_of(asked & (at != cell)); left; left &= left - 1u)
    {
        const int lane = __builtin_ctz(left);
        const four* from = nodes + (unsigned)at[lane];
        const four f = {f_x[lane], f_y[lane], f_z[lane], 0.0f};
        const four rate = {rate_x[lane], rate_y[lane], rate_z[lane], 0.0f};
        const Cubic found = along_ray(from, from + nz, from + nyz, from + nyz + nz, f, rate);
        for (int n = 0; n < 4; ++n)
            for (int axis = 0; axis < 4; ++axis)
                map[4 * n + axis][lane] = found.c[n][axis];
        met[lane] = t[lane];
        cell[lane] = at[lane];
        entry[lane] = edit.has_sides ? edit.side_index.data[(unsigned)at[lane]] : 0;
    }
    const lanes u = t - met;
    lanes node[4], turn[3];
    for (int axis = 0; axis < 4; ++axis)
    {
        #pragma clang fp contract(fast)
        const lanes c0 = *reinterpret_cast<const lanes*>(map[axis]);
        const lanes c1 = *reinterpret_cast<const lanes*>(map[4 + axis]);
        const lanes c2 = *reinterpret_cast<const lanes*>(map[8 + axis]);
        const lanes c3 = *reinterpret_cast<const lanes*>(map[12 + axis]);
        node[axis] = c0 + u * (c1 + u * (c2 + u * c3));
        if (axis < 3)
            turn[axis] = c1 + u * (2.0f * c2 + (3.0f * u) * c3);
    }
    const ints mapped = asked & (((flags & cell_inside) != 0) | (node[3] <= edit.tolerance));
    for (unsigned left = live & bits_of(mapped & (entry != 0)); left; left &= left - 1u)
    {
        // at a narrow gap of the cage: the side that the place is on
        const int lane = __builtin_ctz(left);
        const four f = {f_x[lane], f_y[lane], f_z[lane], 0.0f};
        const four rate = {rate_x[lane], rate_y[lane], rate_z[lane], 0.0f};
        float lowest = 1.0e30f;
        for (int axis = 0; axis < 3; ++axis)
            node[axis][lane] = turn[axis][lane] = 0.0f;
        for (int n = 0; n < entry[lane] % 8; ++n)
        {
            const four* from = reinterpret_cast<const four*>(edit.sides.data) + 8 * (size_t)(entry[lane] / 8 + n);
            const Cubic side = along_ray(from, from + 2, from + 4, from + 6, f, rate);
            if (side.c[0].w < lowest)
            {
                lowest = side.c[0].w;
                for (int axis = 0; axis < 3; ++axis)
                {
                    node[axis][lane] = side.c[0][axis];
                    turn[axis][lane] = side.c[1][axis];
                }
            }
        }
    }
    const lanes position_x = mapped ? node[0] : edit.lower.c[0] + spacing * place_x;
    const lanes position_y = mapped ? node[1] : edit.lower.c[1] + spacing * place_y;
    const lanes position_z = mapped ? node[2] : edit.lower.c[2] + spacing * place_z;

    // the voxels there
    const lanes g_x = (position_x - grid.lower.c[0]) * grid.inverse_voxel_size.c[0];
    const lanes g_y = (position_y - grid.lower.c[1]) * grid.inverse_voxel_size.c[1];
    const lanes g_z = (position_z - grid.lower.c[2]) * grid.inverse_voxel_size.c[2];
    const ints among = ~far_off & (g_x >= 0.0f) & (g_y >= 0.0f) & (g_z >= 0.0f) & (g_x < (float)cells_x)
        & (g_y < (float)cells_y) & (g_z < (float)cells_z);
    const ints i = __builtin_convertvector(among ? g_x : (lanes)0.0f, ints);
    const ints m = __builtin_convertvector(among ? g_y : (lanes)0.0f, ints);
    const ints l = __builtin_convertvector(among ? g_z : (lanes)0.0f, ints);
    const lanes x = g_x - __builtin_convertvector(i, lanes), y = g_y - __builtin_convertvector(m, lanes);
    const lanes z = g_z - __builtin_convertvector(l, lanes);
    const ints voxel = (i * cells_y + m) * cells_z + l;
    ints empty;
    for (int lane = 0; lane < lane_count; ++lane)
        empty[lane] = skip[(unsigned)voxel[lane]];
    empty = among ? empty : (ints)1;

    // rays beside the lattice
    const ints off_box = ~in_box;
    if (live & bits_of(off_box))
    {
        const lanes away =
            exit_of_cells(x, y, z, inverse_x * (inverse_spacing * box_x), inverse_y * (inverse_spacing * box_y),
                inverse_z * (inverse_spacing * box_z), __builtin_convertvector(empty, lanes));
        const ints before = t < span_near, beside = before | ~(t < span_far);
        // at the grid's faces rounding may put a place beside the grid, where no cell is known
        lanes to = empty > 0 ? t + (among ? away : (lanes)step) : t;
        to = beside ? (before ? span_near : higher_of(box_far, span_far)) : to;
        to = ((t < box_near) & (box_near < box_far)) ? lower_of(to, box_near) : to;
        leave = off_box ? to : leave;
    }
    const ints jumps = leave > t;
    const lanes after_leave = higher_of(k_after, first_sample(leave / step));

    // what is cleared, and what leaves the rest cage; room: on the ray, in which no sample does
    const ints clears = ~jumps & ~mapped & (empty == 0) & (clears_source ? -1 : 0);
    lanes room = 1.0e30f;
    for (unsigned left = live & bits_of(clears | (mapped & ((flags & cell_stays) == 0))); left; left &= left - 1u)
    {
        const int lane = __builtin_ctz(left);
        room[lane] = 0.5f * (edit.slack - rest_distance(position_x[lane], position_y[lane], position_z[lane]));
    }
    const ints leaves = mapped & (room < 0.0f);
    lanes sigma = 0.0f;
    const unsigned filled = live & bits_of(~jumps & (empty == 0) & ~leaves);
    add_densities(filled, i, m, l, x, y, z, sigma);
    const ints asks_length = ~jumps & mapped & (count == 0.0f) & ((flags & cell_steep) != 0);
    const lanes slope_x = mapped ? turn[0] : spacing * rate_x, slope_y = mapped ? turn[1] : spacing * rate_y;
    const lanes slope_z = mapped ? turn[2] : spacing * rate_z;
    const lanes stretch = __builtin_elementwise_sqrt(slope_x * slope_x + slope_y * slope_y + slope_z * slope_z);
    const ints again = asks_length & (stretch > cut_length);
    const lanes fitting = higher_of(__builtin_elementwise_ceil(stretch - 1.0e-3f), (lanes)1.0f);
    const lanes wanted = lower_of(fitting, (lanes)(float)most_parts);
    count = asks_length ? (again ? wanted : (lanes)1.0f) : count;
    const lanes parts = higher_of(count, (lanes)1.0f);

    const ints acts = ~jumps & ~again, found = acts & (sigma > 0.0f);
    outside += (acts & leaves) ? (lanes)1.0f : (lanes)0.0f;
    if (live & bits_of(found))
    {
        lanes optical = sigma * step / parts;
        if (options.arc_opacity == 1)
            optical = mapped ? optical * stretch : optical;
        const lanes kept = exponential(-optical);
        const ints hidden = found & clears & (room >= 0.5f * edit.slack), drawn = found & ~hidden;
        const ints reveals = hidden & (cleared > faint);
        reveal += reveals ? transmittance * cleared * (1.0f - kept) : (lanes)0.0f;
        cleared *= reveals ? kept : (lanes)1.0f;
        const lanes weight = drawn ? transmittance * (1.0f - kept) : (lanes)0.0f;
        pending += weight;
        const ints shows = drawn & (pending > least);
        for (unsigned left = live & bits_of(shows); left; left &= left - 1u)
        {
            const int lane = __builtin_ctz(left);
            Shown& each = shown[shown_count++];
            each.ray = ray_of[lane];
            each.i = i[lane];
            each.j = m[lane];
            each.k = l[lane];
            each.x = x[lane];
            each.y = y[lane];
            each.z = z[lane];
            each.weight = pending[lane];
            const bool still = !(stretch[lane] > 1.0e-6f);
            const float scale = still ? spacing : 1.0f / stretch[lane];
            each.along[0] = scale * (still ? rate_x[lane] : slope_x[lane]);
            each.along[1] = scale * (still ? rate_y[lane] : slope_y[lane]);
            each.along[2] = scale * (still ? rate_z[lane] : slope_z[lane]);
        }
        pending = shows ? (lanes)0.0f : pending;
        depth += weight * t;
        transmittance *= drawn ? kept : (lanes)1.0f;
        fold += (drawn & mapped & ((flags & cell_folded) != 0) & (weight > fold_weight)) ? weight : (lanes)0.0f;
    }

    // the next sample
    const lanes hollow = __builtin_convertvector(empty - 1, lanes) * (thinnest / cut_length);
    const ints runs = ~leaves & ~found & (empty > 1) & ((flags & (cell_inside | cell_steep)) == cell_inside);
    const lanes clear = lower_of(lower_of(cell_exit, hollow), room);
    const lanes beyond = first_sample((t + clear) / step);
    const lanes follows = (runs & (beyond > k_after)) ? beyond : k_after;
    const lanes next_part = j + 1.0f;
    const ints done = jumps | (acts & (next_part >= parts));
    k = jumps ? after_leave : ((acts & (next_part >= parts)) ? follows : k);
    count = done ? (lanes)0.0f : count;
    j = done ? (lanes)0.0f : (acts ? next_part : j);
    t = (steps_to_sample(k) + (steps_to_sample(j) / higher_of(count, (lanes)1.0f) - sample_place)) * step;
}
ask_for_colors();
add_colors();
for (int ray = 0; ray < 32; ++ray)
    for (int n = 0; n < 3; ++n)
        seen.data[ray][n] = colors[ray][n];
#endif
return seen;
