// the exponent of a kept member at the pixel, and its opacity there
const float4 place = places[warp][k];
const float2 shape = shapes[warp][k];
const float dx = x - place.x, dy = y - place.y;
const float w = place.w * dx + shape.x * dy, s = shape.y * dy;
const float power = place.z - w * w - s * s;
float raised;
asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(raised) : "f"(power));
const float alpha = fminf(raised, 0.999f);
