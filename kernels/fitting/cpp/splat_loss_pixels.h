wp::vec_t<9, wp::float32> found;
#if defined(__CUDA_ARCH__)
// 26x26 windows over the block's 16x16 pixels, in rows and columns as those of splat_loss_windows.h
__shared__ float held[26 * 235], sums[3][16 * 34];
const int thread = threadIdx.x, warp = thread >> 5, lane = thread & 31, row = thread >> 4, column = thread & 15;
const float* window = reinterpret_cast<const float*>(windows.data);
for (int i = thread; i < 26 * 234; i += 256)
{
    const int r = i / 234, c = i % 234, from = left - 10 + c / 9;
    const bool inside = top - 10 + r >= 0 && top - 10 + r < rows && from >= 0 && from < columns;
    held[r * 235 + c] = inside ? window[9 * ((size_t)(top - 10 + r) * columns + from) + c % 9] : 0.0f;
}
__syncthreads();
#pragma unroll
for (int color = 0; color < 3; ++color)
{
    if (lane < 26)
    {
        float one[3] = {0.0f, 0.0f, 0.0f}, other[3] = {0.0f, 0.0f, 0.0f};
#pragma unroll
        for (int k = 0; k < 12; ++k)
        {
#pragma unroll
            for (int s = 0; s < 3; ++s)
            {
                const float value = held[lane * 235 + 9 * (2 * warp + k) + 3 * s + color];
                if (k < 11)
                    one[s] += taps.c[k] * value;
                if (k > 0)
                    other[s] += taps.c[k - 1] * value;
            }
        }
#pragma unroll
        for (int s = 0; s < 3; ++s)
        {
            sums[s][2 * warp * 34 + lane] = one[s];
            sums[s][(2 * warp + 1) * 34 + lane] = other[s];
        }
    }
    __syncthreads();
#pragma unroll
    for (int s = 0; s < 3; ++s)
    {
        float total = 0.0f;
#pragma unroll
        for (int k = 0; k < 11; ++k)
            total += taps.c[k] * sums[s][column * 34 + row + k];
        found.c[3 * s + color] = total;
    }
    __syncthreads();
}
#endif
return found;
