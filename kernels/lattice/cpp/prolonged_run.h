// prolong_correction for the nodes of a list from `begin` to `end`, black ones of a level: what follows a node in memory
// is red, and nothing writes that meanwhile.
int n = begin;
float worst = 0.0f;
#if !defined(__CUDA_ARCH__)
typedef float four __attribute__((ext_vector_type(4), aligned(4)));
const int ny = shape.c[1], nz = shape.c[2], cy = coarse_shape.c[1], cz = coarse_shape.c[2];
four most = 0.0f;
int row_begin = 0, row_end = 0, di = 0, dj = 0, odd = 0;
const wp::vec3* coarse_row = nullptr;
for (; n < end; ++n)
{
    const int node = nodes.data[n];
    if (node < row_begin || node >= row_end)
    {
        const int row = (node - first_node) / nz, i = row / ny, j = row % ny;
        row_begin = first_node + row * nz;
        row_end = row_begin + nz;
        di = (i % 2) * cy * cz;
        dj = (j % 2) * cz;
        odd = i % 2 + j % 2;
        coarse_row = values.data + first_coarse + (i / 2 * cy + j / 2) * cz;
    }
    const int k = node - row_begin, dk = k % 2;
    auto coarse = [&](int step) { return *reinterpret_cast<const four*>(coarse_row + k / 2 + step); };
    four total = coarse(0) + coarse(di + dj + dk);
    if (odd + dk == 3)
    {
        total += coarse(di) + coarse(dj) + coarse(dk);
        total += coarse(dj + dk) + coarse(di + dk) + coarse(di + dj);
        total = 0.25f * total;
    }
    four correction = 0.5f * total;
    correction.w = 0.0f;
    most = __builtin_elementwise_max(most, __builtin_elementwise_abs(correction));
    four& value = *reinterpret_cast<four*>(values.data + node);
    value += correction;
}
worst = __builtin_reduce_max(most);
#endif
return {(float)(n - begin), worst};
