// The ground of the scene as a grid with rulers: the plane beneath the field, across what is up, lines at round numbers.

import { namedDirections, project } from "../geometry/camera.js";
import { hiddenPoints } from "../geometry/pick.js";
import { AXES, add, dot, times } from "../geometry/vectors.js";
import { COLORS } from "./gizmo.js";

const PIECES = 24; // of a line, each seen or hidden
const CELLS = 8; // about so many across the field
const ROOM = 1.3; // the grid's side by the field's
const INK = "rgba(128, 138, 152, 0.6)";

/** The least of 1, 2, 5, 10, 20 ... times a power of ten that is not below a length. */
export function roundStep(wanted) {
  const power = 10 ** Math.floor(Math.log10(wanted));
  return power * [1, 2, 5, 10].find((one) => one * power >= wanted * (1 - 1e-9));
}

/** The plane beneath a box, across what is up: its right-handed axes, the last one up, and its height along that one. */
export function groundPlane([lower, upper], up) {
  const { front, right, top } = namedDirections(up);
  const axes = [right[0], times(front[0], -1), top[0]];
  return { axes, level: extentOf([lower, upper], top[0])[0] };
}

/** The least and the largest place of a box along a direction. */
export function extentOf([lower, upper], way) {
  const places = [0, 1, 2, 3, 4, 5, 6, 7].map((i) => dot([0, 1, 2].map((k) => ((i >> k) & 1 ? upper : lower)[k]), way));
  return [Math.min(...places), Math.max(...places)];
}

/** The lines of the ground below a box: [{value, ends: [p, q], axis}]; axis: that of the world above or below which it lies, or -1. */
export function groundLines(bounds, up) {
  const { axes, level: height } = groundPlane(bounds, up);
  const level = times(axes[2], height);
  // numbers rise along the world's axes
  const ways = axes.slice(0, 2).map((way) => (Math.max(...way) < -Math.min(...way) ? times(way, -1) : way));
  const sides = ways.map((way) => extentOf(bounds, way));
  const size = Math.max(...sides.map(([a, b]) => b - a)) * ROOM;
  const step = roundStep(size / CELLS);
  const [first, second] = sides.map(([a, b]) => [Math.floor(((a + b - size) / 2) / step), Math.ceil(((a + b + size) / 2) / step)]);
  const lines = [];
  for (const [i, [own, other]] of [[first, second], [second, first]].entries()) {
    const [along, across] = [ways[1 - i], ways[i]];
    const axis = Object.values(AXES).findIndex((one) => Math.abs(dot(one, along)) > 1 - 1e-6);
    for (let n = own[0]; n <= own[1]; n += 1) {
      const place = (m) => add(level, add(times(across, n * step), times(along, m * step)));
      lines.push({ value: n * step, ends: [place(other[0]), place(other[1])], axis: n === 0 ? axis : -1 });
    }
  }
  return lines;
}

/** Draws the grid where matter does not hide it, and how far from the origin its lines are. */
export function drawGrid(context, camera, field, picture) {
  const [lower, upper] = field.bounds;
  const tolerance = 0.01 * Math.hypot(...lower.map((value, k) => upper[k] - value));
  context.font = "11px system-ui, sans-serif";
  context.textAlign = "center";
  for (const { value, ends, axis } of groundLines(field.bounds, field.up)) {
    const at = (t) => add(times(ends[0], 1 - t), times(ends[1], t));
    const middles = Array.from({ length: PIECES }, (_, i) => at((i + 0.5) / PIECES));
    const hidden = hiddenPoints(picture?.map, picture?.camera, middles.flat(), tolerance);
    context.beginPath();
    middles.forEach((_, i) => {
      const [from, to] = [project(camera, at(i / PIECES)), project(camera, at((i + 1) / PIECES))];
      if (hidden[i] || from[2] <= 0 || to[2] <= 0) return;
      context.moveTo(from[0], from[1]);
      context.lineTo(to[0], to[1]);
    });
    context.strokeStyle = axis < 0 ? INK : COLORS[axis];
    context.lineWidth = axis < 0 ? 1 : 1.6;
    context.stroke();
    // at the end that is nearer to the eye, where nothing of the scene lies before it
    const [x, y, z] = project(camera, at(project(camera, ends[0])[2] < project(camera, ends[1])[2] ? -0.03 : 1.03));
    context.fillStyle = axis < 0 ? "rgb(128, 138, 152)" : COLORS[axis];
    if (z > 0) context.fillText(String(Number(value.toPrecision(6))), x, y + 4);
  }
  context.textAlign = "start";
}
