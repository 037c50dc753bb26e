// a member, and the parts that its ellipse reaches of those that still see something
const float* p = reinterpret_cast<const float*>(view.data) + 12 * (size_t)members.data[e];
const float u = p[0] - (float)x0, v = p[1] - (float)y0, strength = p[2], l0 = p[3], l1 = p[4], l2 = p[5];
const float reach = strength - least, wide = 1.0f / l0, high = sqrtf(reach) / l2 + 0.002f;
unsigned parts = 0u;
for (int top = 0; top < 16; top += 8)
{
    const lanes down = steps + ((float)top - v), across = l2 * down, room = reach - across * across;
    const lanes half = __builtin_elementwise_sqrt(room > 0.0f ? room : (lanes)0.0f) * wide + 0.002f;
    const lanes middle = u - l1 * wide * down;
    const bits rows = (down >= -high) & (down <= high);
    parts |= lane_bits(rows & (middle + half >= 0.5f) & (middle - half <= 7.5f)) << top;
    parts |= lane_bits(rows & (middle + half >= 8.5f) & (middle - half <= 15.5f)) << (16 + top);
}
parts &= alive;
