// Vectors of three numbers, [x, y, z], and rotations. Points of a cage are flat: x0, y0, z0, x1, ...

export const AXES = { x: [1, 0, 0], y: [0, 1, 0], z: [0, 0, 1] };
export const AXIS_NAMES = Object.keys(AXES);

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const subtract = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const times = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1],
  a[2] * b[0] - a[0] * b[2],
  a[0] * b[1] - a[1] * b[0],
];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);

/** The unit vector of that direction; `otherwise` where there is none. */
export function unit(a, otherwise = [0, 0, 1]) {
  const size = length(a);
  return size > 1e-300 ? times(a, 1 / size) : [...otherwise];
}

/** A unit vector at right angles to a unit vector: what is left of `wish`, or of another axis. */
export function perpendicular(a, wish) {
  for (const candidate of [wish, AXES.x, AXES.y, AXES.z]) {
    const rest = subtract(candidate, times(a, dot(candidate, a)));
    if (length(rest) > 1e-3 * length(candidate)) return unit(rest);
  }
  return [...AXES.x];
}

/** Right-handed about a unit axis, radians. */
export function rotate(a, axis, angle) {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  const k = dot(a, axis) * (1 - c);
  const w = cross(axis, a);
  return [0, 1, 2].map((i) => a[i] * c + w[i] * s + axis[i] * k);
}

export const point = (points, i) => [points[3 * i], points[3 * i + 1], points[3 * i + 2]];

export function mean(points, numbers) {
  const sum = [0, 0, 0];
  for (const i of numbers) for (let k = 0; k < 3; k += 1) sum[k] += points[3 * i + k];
  return times(sum, 1 / Math.max(1, numbers.length));
}

export function bounds(points) {
  const lower = [Infinity, Infinity, Infinity];
  const upper = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; i += 1) {
    lower[i % 3] = Math.min(lower[i % 3], points[i]);
    upper[i % 3] = Math.max(upper[i % 3], points[i]);
  }
  return [lower, upper];
}

/** Where a ray meets a plane, or null where it runs along it or away from it. */
export function meetPlane(origin, direction, through, normal) {
  const slope = dot(direction, normal);
  if (Math.abs(slope) < 1e-9) return null;
  const t = dot(subtract(through, origin), normal) / slope;
  return t > 0 ? add(origin, times(direction, t)) : null;
}

/** How far along a line (unit axis) the place is that is closest to a ray (unit direction); null where they run alike. */
export function closestOnLine(origin, direction, through, axis) {
  const b = dot(axis, direction);
  const slope = 1 - b * b;
  if (slope < 1e-6) return null;
  const apart = subtract(through, origin);
  return (b * dot(direction, apart) - dot(axis, apart)) / slope;
}
