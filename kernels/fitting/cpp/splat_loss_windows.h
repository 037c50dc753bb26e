wp::vec_t<16, wp::float32> found;
#if defined(__CUDA_ARCH__)
// 26x26 pixels of the block's 16x16 windows. A row of pixels has 79 numbers and a column of sums 34, so that the lanes
// of a warp, which sum a row each and then two rows of windows, read from different banks.
__shared__ float differences[26 * 79], truths[26 * 79], sums[5][16 * 34];
const int thread = threadIdx.x, warp = thread >> 5, lane = thread & 31, row = thread >> 4, column = thread & 15;
float share = 1.0f;
if (weights.shape[0] > 0)
{
    for (int i = thread; i < 26 * 26; i += 256)
    {
        const int r = i / 26, c = i % 26;
        const bool inside = top + r < height && left + c < width;
        truths[r * 27 + c] = inside ? weights.data[(top + r) * width + left + c] : 0.0f;
    }
    __syncthreads();
    if (lane < 26)
    {
        for (int side = 0; side < 2; ++side)
        {
            float least = truths[lane * 27 + 2 * warp + side];
            for (int k = 1; k < 11; ++k)
                least = fminf(least, truths[lane * 27 + 2 * warp + side + k]);
            sums[0][(2 * warp + side) * 34 + lane] = least;
        }
    }
    __syncthreads();
    share = sums[0][column * 34 + row];
    for (int k = 1; k < 11; ++k)
        share = fminf(share, sums[0][column * 34 + row + k]);
}
const float* x = reinterpret_cast<const float*>(drawn.data);
const float* y = reinterpret_cast<const float*>(truth.data);
for (int i = thread; i < 26 * 78; i += 256)
{
    const int r = i / 78, c = i % 78;
    const bool inside = top + r < height && 3 * left + c < 3 * width;
    const size_t at = 3 * ((size_t)(top + r) * width + left) + c;
    const float seen = inside ? y[at] : middle;
    differences[r * 79 + c] = inside ? x[at] - seen : 0.0f;
    truths[r * 79 + c] = seen - middle;
}
__syncthreads();
#pragma unroll
for (int color = 0; color < 3; ++color)
{
    if (lane < 26)
    {
        float one[5] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f}, other[5] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
#pragma unroll
        for (int k = 0; k < 12; ++k)
        {
            const int at = lane * 79 + 3 * (2 * warp + k) + color;
            const float d = differences[at], v = truths[at];
            const float values[5] = {d, v, d * d, d * v, v * v};
#pragma unroll
            for (int s = 0; s < 5; ++s)
            {
                if (k < 11)
                    one[s] += taps.c[k] * values[s];
                if (k > 0)
                    other[s] += taps.c[k - 1] * values[s];
            }
        }
#pragma unroll
        for (int s = 0; s < 5; ++s)
        {
            sums[s][2 * warp * 34 + lane] = one[s];
            sums[s][(2 * warp + 1) * 34 + lane] = other[s];
        }
    }
    __syncthreads();
#pragma unroll
    for (int s = 0; s < 5; ++s)
    {
        float total = 0.0f;
#pragma unroll
        for (int k = 0; k < 11; ++k)
            total += taps.c[k] * sums[s][column * 34 + row + k];
        found.c[3 * s + color] = total;
    }
    __syncthreads();
}
found.c[15] = share;
#endif
return found;
