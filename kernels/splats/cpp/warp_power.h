// the exponent of a kept member at the pixel, and its opacity there
const float4 a = places[warp][k];
const float2 b = shapes[warp][k];
const float dx = x - a.x, dy = y - a.y;
const float w = a.w * dx + b.x * dy, s = b.y * dy;
const float power = a.z - w * w - s * s;
float raised;
asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(raised) : "f"(power));
const float alpha = fminf(raised, 0.999f);
