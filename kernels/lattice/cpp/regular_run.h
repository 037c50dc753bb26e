// Half a sweep over nodes of a list from `begin` on, as long as they follow each other in a row of the lattice and none is
// cut: eight at once. All values from the first to the last are worked out, and those of the other colour put back as
// they were, since nothing writes these meanwhile. Sums are in the order of link_sum.
int n = begin;
float worst = 0.0f;
#if !defined(__CUDA_ARCH__)
typedef float lanes __attribute__((ext_vector_type(16), aligned(4)));
typedef int masks __attribute__((ext_vector_type(16), aligned(4)));
const masks own[3] = {
    {-1, -1, -1, 0, 0, 0, -1, -1, -1, 0, 0, 0, -1, -1, -1, 0},
    {0, 0, -1, -1, -1, 0, 0, 0, -1, -1, -1, 0, 0, 0, -1, -1},
    {-1, 0, 0, 0, -1, -1, -1, 0, 0, 0, -1, -1, -1, 0, 0, 0},
};
auto read = [](const float* from) { return *reinterpret_cast<const lanes*>(from); };
const int* list = nodes.data;
const int row = 3 * shape.c[2], slab = row * shape.c[1];
const int last = values.shape[0] - shape.c[1] * shape.c[2] - 16; // what is read is there
while (n + 1 < end && list[n] <= last)
{
    const int node = list[n];
    const int* code = codes.data + node;
    int count = 0;
    if (n + 8 <= end && list[n + 7] == node + 14)
        count = (code[0] & code[2] & code[4] & code[6] & code[8] & code[10] & code[12] & code[14]) == -1 ? 8 : 0;
    if (count == 0)
        while (count < 8 && n + count < end && list[n + count] == node + 2 * count && code[2 * count] == -1)
            ++count;
    if (count < 2)
        break;
    float* at = reinterpret_cast<float*>(values.data + node);
    const float* load = first_loaded < 0 ? nullptr : reinterpret_cast<const float*>(loads.data + node - first_loaded);
    lanes found[3], most = 0.0f;
    for (int part = 0; part < 3; ++part, at += 16)
    {
        const lanes sum =
            read(at - slab) + read(at + slab) + read(at - row) + read(at + row) + read(at - 3) + read(at + 3);
        const lanes total = (load ? read(load + 16 * part) : (lanes)0.0f) + sum, before = read(at);
        const lanes taken = 6.0f * before; // alone, so that it is rounded
        const lanes after = leaves ? total - taken : total / 6.0f;
        found[part] = own[part] ? after : before;
        if (measures && count == 8)
            most = __builtin_elementwise_max(most, __builtin_elementwise_abs(found[part] - before));
    }
    at -= 48;
    if (count == 8)
    {
        for (int part = 0; part < 3; ++part)
            *reinterpret_cast<lanes*>(at + 16 * part) = found[part];
        if (measures)
            worst = __builtin_fmaxf(worst, __builtin_reduce_max(most));
    }
    else // behind them may be nodes of this colour, which another thread writes
        for (int k = 0; k < count; ++k)
            for (int channel = 6 * k; channel < 6 * k + 3; ++channel)
            {
                const float after = reinterpret_cast<const float*>(found)[channel];
                worst = measures ? __builtin_fmaxf(worst, __builtin_fabsf(after - at[channel])) : 0.0f;
                at[channel] = after;
            }
    n += count;
}
#endif
return {(float)(n - begin), worst};
