// What marches on a CPU share: rays side by side, densities of a cell, and colors that wait for their memory.
//
// A step of one ray waits for the one before, and where it leads is not foreseen; sixteen rays go on together without
// branches, and a lane whose ray has ended takes the next ray of the tile. Densities of a cell come from one line of the
// cache. A color reads eight rows of some hundred bytes, which few caches hold: a sample asks for them, the march goes
// on, and they are added up when the queue is full. The colors of a ray are added in the order of its samples.
//
// Takes `sample_place`, `grid`, `table`, MatterCells `cells`, `turns`, which says whether each sample has a direction `along`, and
// `bases`: of each ray that does not turn, the basis between zeros, from its eighth number on.

typedef float two __attribute__((ext_vector_type(2)));
typedef float four __attribute__((ext_vector_type(4), aligned(4)));
typedef float eight __attribute__((ext_vector_type(8), aligned(4)));
const int lane_count = 16;
typedef float lanes __attribute__((ext_vector_type(lane_count), aligned(4)));
typedef int ints __attribute__((ext_vector_type(lane_count), aligned(4)));
ints lane_bits;
for (int lane = 0; lane < lane_count; ++lane)
    lane_bits[lane] = 1 << lane;
auto bits_of = [&](ints mask) { return (unsigned)__builtin_reduce_or(mask & lane_bits); };
auto reciprocal = [](float rate) { return __builtin_fabsf(rate) > 1.0e-12f ? 1.0f / rate : 1.0e30f; };
// as in field/grid
auto steps_to_sample = [](auto k) { return k + sample_place; };
auto first_sample = [](lanes steps) { return __builtin_elementwise_ceil(steps - sample_place); };
auto lower_of = [](lanes a, lanes b) { return a < b ? a : b; };
auto higher_of = [](lanes a, lanes b) { return a > b ? a : b; };
auto cell_of = [](lanes place, int top) {
    ints cell = __builtin_convertvector(place, ints);
    cell = cell < 0 ? (ints)0 : cell;
    return cell > top ? (ints)top : cell;
};
// of x <= 0, to 2 units in the last place (Cephes: 2^n times a polynomial of what is left)
auto exponential = [&](lanes x) {
    #pragma clang fp contract(fast)
    x = higher_of(x, (lanes)-87.0f);
    const lanes n = __builtin_elementwise_floor(x * 1.44269504f + 0.5f);
    const lanes r = x - n * 0.693359375f + n * 2.12194440e-4f;
    lanes sum = r * 1.9875691500e-4f + 1.3981999507e-3f;
    sum = sum * r + 8.3334519073e-3f;
    sum = sum * r + 4.1665795894e-2f;
    sum = sum * r + 1.6666665459e-1f;
    sum = sum * r + 5.0000001201e-1f;
    sum = sum * (r * r) + r + 1.0f;
    return (lanes)((ints)sum + (__builtin_convertvector(n, ints) << 23));
};
// as field/grid.exit_of_cell
auto exit_of_cells = [&](lanes x, lanes y, lanes z, lanes inverse_x, lanes inverse_y, lanes inverse_z, lanes reach) {
    const lanes back = 1.0f - reach;
    const lanes way_x = ((inverse_x > 0.0f ? reach : back) - x) * inverse_x;
    const lanes way_y = ((inverse_y > 0.0f ? reach : back) - y) * inverse_y;
    const lanes way_z = ((inverse_z > 0.0f ? reach : back) - z) * inverse_z;
    return lower_of(lower_of(way_x, way_y), way_z);
};

// densities of a cell that holds matter, and what they are at a place in it, 0 to 1
const int cells_x = grid.skip.shape[0], cells_y = grid.skip.shape[1], cells_z = grid.skip.shape[2];
auto cell_densities = [&](int i, int j, int k) {
    const int at = (i * cells_y + j) * cells.blocks.shape[1] + (k >> 5);
    const unsigned* entry = reinterpret_cast<const unsigned*>(cells.blocks.data) + 2 * (size_t)(unsigned)at;
    const unsigned record = entry[1] + (unsigned)__builtin_popcount(entry[0] & ((1u << (k & 31)) - 1u));
    return cells.densities.data + 8 * (size_t)record;
};
auto blended_density = [](const float* corners, float x, float y, float z) {
    const four near = *reinterpret_cast<const four*>(corners), far = *reinterpret_cast<const four*>(corners + 4);
    const four along_z = near + z * (far - near);
    const two along_y = along_z.xz + y * (along_z.yw - along_z.xz);
    return along_y.x + x * (along_y.y - along_y.x);
};

// samples at a place in a cell whose colors wait to be added to `colors` of 32 rays
const int queue_length = 24;
struct Waiting
{
    const float* rows[8];
    float shares[8];
    float along[3];
    float weight;
    int ray;
};
Waiting queue[queue_length];
int queued = 0;
four colors[32] = {};
const float none[32] = {}; // the row of a node without one
const int width = grid.sh.shape[1];
const float* numbers = grid.sh.data;
const int* order = table.columns.order.data;

auto wait_for_color = [&](int ray, int i, int j, int k, float x, float y, float z, float weight) -> Waiting& {
    const auto& columns = table.columns;
#include "cell_place.h"
    Waiting& sample = queue[queued++];
    sample.weight = weight;
    sample.ray = ray;
    for (int column = 0; column < 4; ++column)
    {
        const int at = begin + ((column >> 1) * columns.node_counts.c[1] + (column & 1)) * block_width;
        const unsigned* entry = reinterpret_cast<const unsigned*>(columns.blocks.data) + 2 * (size_t)(unsigned)at;
        const unsigned bits = entry[0] >> place;
        const int row = (int)entry[1] + __builtin_popcount(entry[0] & low);
        const float share = ((column & 2) ? x : 1.0f - x) * ((column & 1) ? y : 1.0f - y);
        const float* from[2] = {none, none};
        if (order)
        {
            if (bits & 1u)
                from[0] = numbers + (size_t)order[row] * width;
            if (bits & 2u)
                from[1] = numbers + (size_t)order[row + (int)(bits & 1u)] * width;
        }
        else
        {
            const float* here = numbers + (size_t)row * width;
            from[0] = (bits & 1u) ? here : none;
            from[1] = (bits & 2u) ? here + ((bits & 1u) ? width : 0) : none;
        }
        for (int side = 0; side < 2; ++side)
        {
            const char* row_begin = reinterpret_cast<const char*>(from[side]);
            __builtin_prefetch(row_begin);
            __builtin_prefetch(row_begin + 64);
            sample.rows[2 * column + side] = from[side];
            sample.shares[2 * column + side] = share * (side ? z : 1.0f - z);
        }
    }
    return sample;
};

auto add_colors = [&]() {
    for (int n = 0; n < queued; ++n)
    {
        const Waiting& sample = queue[n];
        eight sum[4];
        for (int part = 0; part < 4; ++part)
            sum[part] = 0.0f;
        for (int c = 0; c < 8; ++c)
        {
            #pragma clang fp contract(fast)
            const float share = sample.shares[c];
            const float* row = sample.rows[c];
            sum[0] += share * *reinterpret_cast<const eight*>(row);
            sum[1] += share * *reinterpret_cast<const eight*>(row + 8);
            sum[2] += share * *reinterpret_cast<const eight*>(row + 16);
            sum[3] += share * *reinterpret_cast<const eight*>(row + (width == 27 ? 19 : 16));
        }
        float* padded = bases[turns ? 0 : sample.ray];
        if (turns)
        {
            const float x = sample.along[0], y = sample.along[1], z = sample.along[2];
            float* values = padded + 8;
#include "basis_of_direction.h"
        }
        // three sums of eight lanes: the zeros leave out what belongs to another one
        const eight basis = *reinterpret_cast<const eight*>(padded + 8);
        const eight above = *reinterpret_cast<const eight*>(padded + 16);
        eight a = sum[0] * basis + sum[1] * above, b, c;
        if (width == 27)
        {
            const eight first_blue = {0.0f, 0.0f, padded[8], 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
            b = sum[1] * *reinterpret_cast<const eight*>(padded + 7)
                + sum[2] * *reinterpret_cast<const eight*>(padded + 15);
            c = sum[2] * first_blue + sum[3] * *reinterpret_cast<const eight*>(padded + 9);
        }
        else
        {
            b = c = 0.0f;
            b.lo = sum[2].lo * basis.lo;
            c.lo = sum[2].hi * basis.lo;
        }
        const four p = a.lo + a.hi, q = b.lo + b.hi, r = c.lo + c.hi;
        const four halves = {p.x + p.z, p.y + p.w, q.x + q.z, q.y + q.w};
        four seen = {halves.x + halves.y, halves.z + halves.w, (r.x + r.z) + (r.y + r.w), 0.0f};
        if (width == 24) // luminance and two differences
        {
            const float grey = seen.x - 0.5f * seen.z;
            seen = (four){grey + seen.y, seen.x + seen.z, grey - seen.y, 0.0f};
        }
        seen += 0.5f;
        colors[sample.ray] += sample.weight * (seen > 0.0f ? seen : (four)0.0f);
    }
    queued = 0;
};

// samples whose colors are asked for while the densities of the next ones are on the way
struct Shown
{
    int ray, i, j, k;
    float x, y, z, weight, along[3];
};
Shown shown[lane_count];
int shown_count = 0;
auto ask_for_colors = [&]() {
    for (int n = 0; n < shown_count; ++n)
    {
        const Shown& each = shown[n];
        if (queued == queue_length)
            add_colors();
        Waiting& sample = wait_for_color(each.ray, each.i, each.j, each.k, each.x, each.y, each.z, each.weight);
        for (int axis = 0; turns && axis < 3; ++axis)
            sample.along[axis] = each.along[axis];
    }
    shown_count = 0;
};

// `sigma` of the lanes in `filled`, at the places x, y, z of the cells i, j, k; colors of the samples before are asked
// for while these densities are on the way
auto add_densities = [&](unsigned filled, ints i, ints j, ints k, lanes x, lanes y, lanes z, lanes& sigma) {
    const float* records[lane_count];
    for (unsigned left = filled; left; left &= left - 1u)
    {
        const int lane = __builtin_ctz(left);
        records[lane] = cell_densities(i[lane], j[lane], k[lane]);
        __builtin_prefetch(records[lane]);
    }
    ask_for_colors();
    for (unsigned left = filled; left; left &= left - 1u)
    {
        const int lane = __builtin_ctz(left);
        sigma[lane] = blended_density(records[lane], x[lane], y[lane], z[lane]);
    }
};
