// the parts of a row, eight pixels each, that the ellipse reaches and that still see something
const float dy = (float)y + 0.5f - v, s = l2 * dy;
const float half = sqrtf(wp::max(reach - s * s, 0.0f)) * wide + 0.002f, middle = u - l1 * dy * wide;
if (middle + half < 0.5f || middle - half > 15.5f)
    continue;
const unsigned parts = (middle - half > 7.5f ? 2u : 3u) & (middle + half < 8.5f ? 1u : 3u) & alive >> 2 * y;
const float kept = strength - s * s, shift = l1 * dy;
