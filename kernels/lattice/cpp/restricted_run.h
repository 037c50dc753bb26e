// take_load for the nodes of a list from `begin` to `end`, those before `black` red.
int n = begin;
#if !defined(__CUDA_ARCH__)
typedef float four __attribute__((ext_vector_type(4), aligned(4)));
const int ny = shape.c[1], nz = shape.c[2], row = fine_shape.c[2], slab = row * fine_shape.c[1];
int row_begin = 0, row_end = 0;
const wp::vec3* fine_row = nullptr;
for (; n < end; ++n)
{
    const int node = nodes.data[n];
    if (node < row_begin || node >= row_end)
    {
        const int at = (node - first_node) / nz;
        row_begin = first_node + at * nz;
        row_end = row_begin + nz;
        fine_row = values.data + first_fine + 2 * (at / ny * slab + at % ny * row);
    }
    const wp::vec3* center = fine_row + 2 * (node - row_begin);
    auto fine = [&](int step) { return *reinterpret_cast<const four*>(center + step); };
    four total = 4.0f * fine(0);
    for (int s = -1; s < 2; s += 2)
        for (int t = -1; t < 2; t += 2)
        {
            total += fine(s * slab + t * row);
            total += fine(s * slab + t);
            total += fine(s * row + t);
        }
    total = total / 8.0f;
    loads.data[node - first_loaded] = wp::vec3(total.x, total.y, total.z);
    if (n < black)
    {
        const int code = codes.data[node];
        const four value = total / (code < 0 ? 6.0f : diagonals.data[code]);
        values.data[node] = wp::vec3(value.x, value.y, value.z);
    }
}
#endif
return n - begin;
