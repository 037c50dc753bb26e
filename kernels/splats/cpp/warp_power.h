// the exponent of a kept member at the pixel
const float4 a = rows[warp][k][0], b = rows[warp][k][1];
const float dx = x - a.x, dy = y - a.y;
const float w = a.w * dx + b.x * dy, s = b.y * dy;
const float power = a.z - w * w - s * s;
