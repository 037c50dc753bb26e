// the harmonics of a warp's rows, read as runs of memory and turned over in shared memory, on CUDA; all lanes, at most
// 128 threads a block
__shared__ float staged[4][32 * 27];
const int lane = threadIdx.x & 31;
const int stride = width | 1; // odd, so that lanes read from different banks
float* rows = staged[(threadIdx.x >> 5) & 3];
__syncwarp();
#pragma unroll 9
for (int part = 0; part < width; ++part)
{
    const int entry = part * 32 + lane;
    const int owner = entry / width;
    const int number = entry - owner * width;
    const int source = __shfl_sync(0xffffffffu, row, owner);
    const size_t at = (size_t)source * width + number;
    rows[owner * stride + number] = halves.data ? wp::half_to_float(halves.data[at]) : sh.data[at];
}
__syncwarp();
