// the next part: two to the power of the exponent there, and the alpha where it is drawn
const int bit = __builtin_ctz(parts), y = bit & 15, part = bit >> 4;
const float dy = (float)y + 0.5f - v, s = l2 * dy;
const lanes dx = steps + ((float)(8 * part) - u);
const lanes w = l0 * dx + l1 * dy;
const lanes power = (strength - s * s) - w * w;
const bits drawn = (power >= least) & (left[y][part] > stop);
// 2^power by its whole part, and a polynomial of the rest in [0, 1)
const lanes held = power >= least ? power : (lanes)0.0f;
const bits down = __builtin_convertvector(held - 1.0f, bits);
const lanes f = held - __builtin_convertvector(down, lanes);
lanes e2 = f * 1.87757513e-3f + 8.98934449e-3f;
e2 = e2 * f + 5.58263136e-2f;
e2 = e2 * f + 2.40153619e-1f;
e2 = e2 * f + 6.93153073e-1f;
e2 = e2 * f + 9.99999925e-1f;
const lanes raised = (lanes)((bits)e2 + (down << 23));
lanes alpha = raised < 0.999f ? raised : (lanes)0.999f;
alpha = (lanes)((bits)alpha & drawn);
