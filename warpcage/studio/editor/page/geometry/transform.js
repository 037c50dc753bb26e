// Moves, rotations and scalings of a cage's vertices: their amounts from the pointer's way or from typed numbers, and what
// they make of the vertices: proportional, in mirror image.

import { pixelAt, project, rayThrough } from "./camera.js";
import { AXES, add, bounds, closestOnLine, cross, distance, dot, meetPlane } from "./vectors.js";
import { perpendicular, point, rotate, subtract, times, unit } from "./vectors.js";

const MIN_SLANT = 0.05; // an axis or plane that the view meets more flatly is moved by its share of the free way

/** How much of a transform a vertex takes at a share t (0 to 1) of the radius. */
export const falloffs = {
  smooth: (t) => (1 - t) ** 2 * (1 + 2 * t),
  sphere: (t) => Math.sqrt(Math.max(0, 1 - t * t)),
  linear: (t) => 1 - t,
  sharp: (t) => (1 - t) ** 2,
  constant: () => 1,
};

/** Weight of each vertex by its distance to the nearest selected one; radius 0 or none: the selection alone. */
export function weightsOf(points, selected, radius = 0, falloff = "smooth") {
  const weights = new Float64Array(points.length / 3);
  const numbers = [...selected];
  if (radius > 0 && numbers.length) {
    const group = Float64Array.from(numbers.flatMap((j) => point(points, j)));
    for (let i = 0; i < weights.length; i += 1) {
      const [px, py, pz] = [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
      let least = Infinity;
      for (let j = 0; j < group.length; j += 3) {
        const [x, y, z] = [px - group[j], py - group[j + 1], pz - group[j + 2]];
        least = Math.min(least, x * x + y * y + z * z);
      }
      const t = Math.sqrt(least) / radius;
      weights[i] = t < 1 ? falloffs[falloff](t) : 0;
    }
  }
  for (const i of numbers) weights[i] = 1;
  return weights;
}

/** Flat points with change(point, weight) where the weight is not zero. */
function changed(points, weights, change) {
  const out = Float64Array.from(points);
  for (let i = 0; i < weights.length; i += 1) {
    if (weights[i] !== 0) out.set(change(point(points, i), weights[i]), 3 * i);
  }
  return out;
}

/** Points moved by weight times an offset. */
export const moved = (points, weights, offset) => changed(points, weights, (p, w) => add(p, times(offset, w)));

/** Points rotated about a pivot and a unit axis by weight times an angle (radians). */
export const rotated = (points, weights, pivot, axis, angle) =>
  changed(points, weights, (p, w) => add(pivot, rotate(subtract(p, pivot), axis, w * angle)));

/** Points scaled about a pivot along the three unit axes of a basis, by 1 + weight (factor - 1). */
export function scaled(points, weights, pivot, basis, factors) {
  return changed(points, weights, (p, w) => {
    const away = subtract(p, pivot);
    return basis.reduce((q, axis, k) => add(q, times(axis, w * (factors[k] - 1) * dot(away, axis))), p);
  });
}

/** The plane of symmetry of a rest cage along an axis (0, 1, 2) and each vertex's partner in it (itself on it, -1: none). */
export function mirrorOf(rest, axis, tolerance = 1e-3) {
  const [lower, upper] = bounds(rest);
  const plane = (lower[axis] + upper[axis]) / 2;
  const near = tolerance * Math.hypot(...subtract(upper, lower));
  const partners = new Int32Array(rest.length / 3).fill(-1);
  const other = (axis + 1) % 3; // partners have the same place along another axis: look among those alone
  const order = Array.from(partners.keys()).sort((i, j) => rest[3 * i + other] - rest[3 * j + other]);
  let first = 0;
  for (const i of order) {
    const wanted = point(rest, i);
    if (Math.abs(wanted[axis] - plane) <= near) {
      partners[i] = i;
      continue;
    }
    wanted[axis] = 2 * plane - wanted[axis];
    while (rest[3 * order[first] + other] < wanted[other] - near) first += 1;
    let least = near;
    for (let n = first; n < order.length && rest[3 * order[n] + other] <= wanted[other] + near; n += 1) {
      const j = order[n];
      const away = distance(point(rest, j), wanted);
      if (away <= least && j !== i) [partners[i], least] = [j, away];
    }
  }
  for (let i = 0; i < partners.length; i += 1) {
    const j = partners[i];
    if (j >= 0 && j !== i && partners[j] !== i) partners[i] = -1; // partners agree, or there are none
  }
  return { axis, plane, partners };
}

/** Which side leads: that of the active vertex, else that of most selected ones; 1 where all lie on the plane. */
export function leadingSide(rest, mirror, selected, active = -1) {
  const side = (i) => (mirror.partners[i] === i ? 0 : Math.sign(rest[3 * i + mirror.axis] - mirror.plane));
  if (active >= 0 && side(active) !== 0) return side(active);
  let sum = 0;
  for (const i of selected) sum += side(i);
  return sum < 0 ? -1 : 1;
}

export function withPartners(mirror, selected) {
  const out = new Set(selected);
  for (const i of selected) if (mirror.partners[i] >= 0) out.add(mirror.partners[i]);
  return out;
}

/** A transform's result made symmetric: partners of the leading side follow it in mirror image, the plane's stay on it. */
export function mirrored(rest, start, result, mirror, side) {
  const { axis, plane, partners } = mirror;
  const out = Float64Array.from(result);
  for (let i = 0; i < partners.length; i += 1) {
    const j = partners[i];
    if (j === i) out[3 * i + axis] = start[3 * i + axis];
    const leads = j >= 0 && j !== i && (rest[3 * i + axis] - plane) * side > 0;
    for (let k = 0; leads && k < 3; k += 1) {
      const step = result[3 * i + k] - start[3 * i + k];
      out[3 * j + k] = start[3 * j + k] + (k === axis ? -step : step);
    }
  }
  return out;
}

export const snapped = (value, step) => (step > 0 ? Math.round(value / step) * step : value);

/** Three unit axes: of the world, of the view's camera, or of the selection (z along its normal). */
export function basisOf(axes, camera, normal) {
  if (axes === "view" && camera) return [camera.right, camera.up, times(camera.forward, -1)];
  if (axes === "local" && normal && Math.hypot(...normal) > 0) {
    const z = unit(normal);
    const x = perpendicular(z, Math.abs(z[2]) < 0.9 ? cross([0, 0, 1], z) : [1, 0, 0]);
    return [x, cross(z, x), z];
  }
  return Object.values(AXES);
}

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
    const isFlat = 1 - dot(axis, toPivot) ** 2 < MIN_SLANT ** 2;
    return times(axis, isFlat || a === null || b === null ? dot(free, axis) : b - a);
  }
  const normal = unit(cross(axes[0], axes[1]));
  const [a, b] = rays.map((ray) => meetPlane(camera.eye, ray, pivot, normal));
  if (Math.abs(dot(normal, toPivot)) < MIN_SLANT || !a || !b) {
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

/** Numbers as they are typed while a transform runs: up to `count` fields, Tab for the next one. */
export class Typed {
  constructor(count) {
    this.fields = Array(count).fill("");
    this.at = 0;
  }

  get any() {
    return this.fields.some((field) => field !== "");
  }

  /** Takes a key; returns whether it belonged to a number. */
  take(key) {
    const field = this.fields[this.at];
    if (/^[0-9]$/.test(key)) this.fields[this.at] = field + key;
    else if (key === "." || key === ",") this.fields[this.at] = field.includes(".") ? field : `${field}.`;
    else if (key === "-") this.fields[this.at] = field.startsWith("-") ? field.slice(1) : `-${field}`;
    else if (key === "Backspace" && this.any) this.fields[this.at] = field.slice(0, -1);
    else if (key === "Tab" && this.fields.length > 1) this.at = (this.at + 1) % this.fields.length;
    else return false;
    return true;
  }

  /** The number of a field; `otherwise` where nothing was typed. */
  value(i, otherwise) {
    const number = Number(this.fields[i]);
    return this.fields[i] === "" || !Number.isFinite(number) ? otherwise : number;
  }
}
