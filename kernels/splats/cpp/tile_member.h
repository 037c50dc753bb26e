// a member, and the rows of the tile that its ellipse reaches
const float* p = reinterpret_cast<const float*>(view.data) + 12 * (size_t)members.data[e];
const float u = p[0] - (float)x0, v = p[1] - (float)y0, strength = p[2], l0 = p[3], l1 = p[4], l2 = p[5];
const float reach = strength - least, wide = 1.0f / l0;
const float high = sqrtf(reach) / l2 + 0.002f;
const float from = ceilf(v - high - 0.5f), to = floorf(v + high - 0.5f);
const int first_row = from > 0.0f ? (from > 16.0f ? 16 : (int)from) : 0;
const int last_row = to < (float)(height - 1) ? (to < 0.0f ? -1 : (int)to) : height - 1;
