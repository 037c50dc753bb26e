// Members of a tile for a warp with 8x4 pixels, 32 a round: the rows of the next round, and the numbers of the one after
// it, are under way while those of this one are drawn.
const int warp = (threadIdx.x >> 5) & 7, lane = threadIdx.x & 31;
const float4* rows_of = reinterpret_cast<const float4*>(view.data);
const int* member = reinterpret_cast<const int*>(members.data);
const float left = x - (float)(lane & 7), top = y - (float)(lane >> 3);
const float low = top - 0.002f, high = top + 3.002f, right = left + 7.002f;
int coming = begin + lane < end ? member[begin + lane] : 0;
int after = begin + 32 + lane < end ? member[begin + 32 + lane] : 0;
float4 next_a = rows_of[3u * (unsigned)coming], next_b = rows_of[3u * (unsigned)coming + 1];
float4 next_c = rows_of[3u * (unsigned)coming + 2];
