"""The map of an edit as the march of a CPU reads it: C++ of deform/render_cpu.

The map of "Deforming Radiance Fields with Cages" (ECCV 2022), section 4.1, is trilinear in a cell of its lattice: along
a ray it is a cubic there.
Needs: deform/edits, deform/flat_edits, deform/march.
"""

from .edits import CELL_FOLDED, CELL_INSIDE, CELL_OUTSIDE, CELL_STAYS, CELL_STEEP, CUT_LENGTH
from .flat_edits import LOOK_SKIP
from .march import FAINT, FOLD_MIN_WEIGHT, MAX_SUB_SAMPLES

#: The constants of deform/edits, deform/flat_edits and deform/march, by their names.
CONSTANTS = "\n".join(
    f"    const {kind} {name} = {value}{'f' if kind == 'float' else ''};"
    for kind, name, value in (
        ("int", "cell_inside", CELL_INSIDE),
        ("int", "cell_outside", CELL_OUTSIDE),
        ("int", "cell_stays", CELL_STAYS),
        ("int", "cell_folded", CELL_FOLDED),
        ("int", "cell_steep", CELL_STEEP),
        ("int", "look_skip", LOOK_SKIP),
        ("int", "most_parts", MAX_SUB_SAMPLES),
        ("float", "cut_length", float(CUT_LENGTH)),
        ("float", "faint", float(FAINT)),
        ("float", "fold_weight", float(FOLD_MIN_WEIGHT)),
    )
)


#: `along_ray`: the map along a ray through a cell, from pointers to four pairs of nodes along the last axis.
ALONG_RAY = """
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
"""

#: `rest_distance(x, y, z)` as deform/flat_edits has it.
REST_DISTANCE = """
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
"""
