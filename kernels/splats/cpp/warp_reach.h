// whether the ellipse of a member, a and b of its three rows, touches the pixels of the warp
const float reach = a.z + 7.994353437f;
const float root = sqrtf(fmaxf(reach, 0.0f)), lean = b.x / b.y;
const float from = fmaxf(b.y * (low - a.y), -root), to = fminf(b.y * (high - a.y), root);
const float extreme = lean * root * rsqrtf(1.0f + lean * lean);
const float p = fminf(fmaxf(-extreme, from), to), q = fminf(fmaxf(extreme, from), to);
const float greatest = sqrtf(fmaxf(reach - p * p, 0.0f)) - lean * p;
const float least = sqrtf(fmaxf(reach - q * q, 0.0f)) + lean * q;
touched = from <= to && a.w * (left - 0.002f - a.x) <= greatest && a.w * (a.x - right) <= least;
