wp::vec_t<5, wp::float32> seen;
#if defined(__CUDA_ARCH__)
__shared__ float4 places[8][32];
__shared__ float2 shapes[8][32], reds[8][32], blues[8][32], leans[8][32];
#include "warp_members.h"
float T = inside ? 1.0f : 0.0f, red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f;
for (int base = begin; base < end; base += 32)
{
    if (__ballot_sync(0xffffffffu, T > stop) == 0u)
        break;
#include "warp_round.h"
    if (touched)
    {
        places[warp][slot] = a;
        shapes[warp][slot] = make_float2(b.x, b.y);
        reds[warp][slot] = make_float2(b.z, b.w);
        blues[warp][slot] = make_float2(c.x, c.y);
        leans[warp][slot] = make_float2(c.z, c.w);
    }
    __syncwarp();
    for (int k = 0; k < count; ++k)
    {
#include "warp_power.h"
        if (power >= -7.994353437f && T > stop)
        {
            const float2 rg = reds[warp][k];
            const float weight = alpha * T;
            red += weight * rg.x;
            green += weight * rg.y;
            blue += weight * blues[warp][k].x;
            if (with_depth)
            {
                const float2 lean = leans[warp][k];
                depth += weight * (blues[warp][k].y + lean.x * dx + lean.y * dy);
            }
            T -= weight;
        }
    }
    __syncwarp();
}
seen.c[0] = red;
seen.c[1] = green;
seen.c[2] = blue;
seen.c[3] = depth;
seen.c[4] = T;
#endif
return seen;
