// From the pointer's way over the picture to an offset, an angle or a factor.

import { pixelAt, project, rayThrough } from "./camera.js";
import { add, closestOnLine, cross, dot, meetPlane, subtract, times, unit } from "./vectors.js";

const LEAST_SLANT = 0.05; // an axis or plane that the view meets more flatly is moved by its share of the free way

/** The offset in the view plane through a pivot of a way from one pixel to another. */
export function freeOffset(camera, pivot, from, to) {
  const size = pixelAt(camera, pivot);
  return add(times(camera.right, (to[0] - from[0]) * size), times(camera.up, (from[1] - to[1]) * size));
}

/** The offset along some of three unit axes (true where allowed), so that what is under the pointer stays under it. */
export function offsetOf(camera, pivot, from, to, basis, allowed) {
  const free = freeOffset(camera, pivot, from, to);
  const axes = basis.filter((_, k) => allowed[k]);
  if (axes.length === 3) return free;
  const rays = [from, to].map(([x, y]) => rayThrough(camera, x, y));
  const toPivot = unit(subtract(pivot, camera.eye));
  if (axes.length === 1) {
    const [axis] = axes;
    const [a, b] = rays.map((ray) => closestOnLine(camera.eye, ray, pivot, axis));
    const isFlat = 1 - dot(axis, toPivot) ** 2 < LEAST_SLANT ** 2;
    return times(axis, isFlat || a === null || b === null ? dot(free, axis) : b - a);
  }
  const normal = unit(cross(axes[0], axes[1]));
  const [a, b] = rays.map((ray) => meetPlane(camera.eye, ray, pivot, normal));
  if (Math.abs(dot(normal, toPivot)) < LEAST_SLANT || !a || !b) {
    return add(times(axes[0], dot(free, axes[0])), times(axes[1], dot(free, axes[1])));
  }
  return subtract(b, a);
}

/** The angle (radians, right-handed about an axis) by which a way from pixel to pixel turns about a pivot. */
export function angleOf(camera, pivot, from, to, axis) {
  const [x, y] = project(camera, pivot);
  const turn = Math.atan2(to[1] - y, to[0] - x) - Math.atan2(from[1] - y, from[0] - x);
  const wrapped = turn - 2 * Math.PI * Math.round(turn / (2 * Math.PI));
  return dot(axis, subtract(camera.eye, pivot)) >= 0 ? -wrapped : wrapped; // y points down in a picture
}

/** The factor of a way away from a pivot: 1 where it begins, 0 at the pivot, negative beyond it. */
export function factorOf(camera, pivot, from, to) {
  const [x, y] = project(camera, pivot);
  const [ax, ay] = [from[0] - x, from[1] - y];
  const square = ax * ax + ay * ay;
  if (square < 100) return 1 + (to[0] - from[0]) / 100; // begun on the pivot itself: 100 pixels double it
  return (ax * (to[0] - x) + ay * (to[1] - y)) / square;
}
