// the member of this round that a lane looks at, and whether its ellipse touches the pixels of the warp
const int number = coming;
const float4 a = next_a, b = next_b, c = next_c;
bool touched = false;
if (base + lane < end)
{
#include "warp_reach.h"
}
coming = after;
next_a = rows_of[3u * (unsigned)coming];
next_b = rows_of[3u * (unsigned)coming + 1];
next_c = rows_of[3u * (unsigned)coming + 2];
after = base + 64 + lane < end ? member[base + 64 + lane] : 0;
const unsigned which = __ballot_sync(0xffffffffu, touched);
const int count = __popc(which), slot = __popc(which & ((1u << lane) - 1u));
