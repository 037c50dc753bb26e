// Places of objects: similarities as rows of a (4, 4) matrix, and what they do to points, views and boxes.

import { add, dot, mean, point, subtract, times } from "./vectors.js";

export const placed = (matrix, p) => [0, 1, 2].map((k) => dot(matrix[k], p) + matrix[k][3]);

/** How many times as large a place makes its object. */
export const scaleOf = (matrix) => Math.hypot(matrix[0][0], matrix[1][0], matrix[2][0]);

const columns = (matrix) => [0, 1, 2].map((k) => [matrix[0][k], matrix[1][k], matrix[2][k]]);

/** The unit axes of an object in the scene. */
export const axesOf = (matrix) => columns(matrix).map((column) => times(column, 1 / scaleOf(matrix)));

/** A view of the scene in the coordinates of an object. */
export function viewWithin(matrix, view) {
  const axes = axesOf(matrix);
  const turn = (a) => axes.map((axis) => dot(axis, a));
  const place = (p) => times(turn(subtract(p, [matrix[0][3], matrix[1][3], matrix[2][3]])), 1 / scaleOf(matrix));
  return { ...view, eye: place(view.eye), target: place(view.target), up: turn(view.up) };
}

/** Flat points of an object in the scene. */
export function placedAll(matrix, points) {
  const out = new Float64Array(points.length);
  for (let i = 0; i < points.length / 3; i += 1) out.set(placed(matrix, point(points, i)), 3 * i);
  return out;
}

/** The eight corners of a box, flat: bit k of a corner's number says whether it is the upper one along axis k. */
export function cornersOf([lower, upper]) {
  const least = 1e-3 * Math.hypot(...subtract(upper, lower)); // a flat box has sides all the same
  return Float64Array.from({ length: 24 }, (_, i) => {
    const k = i % 3;
    return Math.floor(i / 3) & (1 << k) ? Math.max(upper[k], lower[k] + least) : lower[k];
  });
}

/** The edges of a box by the numbers of their corners, flat pairs. */
export const BOX_EDGES = [0, 1, 2].flatMap((k) => [0, 1, 2, 3, 4, 5, 6, 7].filter((i) => !(i & (1 << k))).flatMap((i) => [i, i | (1 << k)]));

const determinant = ([a, b, c]) => a[0] * (b[1] * c[2] - b[2] * c[1]) - a[1] * (b[0] * c[2] - b[2] * c[0]) + a[2] * (b[0] * c[1] - b[1] * c[0]);

/**
 * The place that takes an object along as its corners went from `start` to `now`, both flat; `matrix` was its place.
 * What is not alike along all axes becomes a scaling that is.
 */
export function followed(matrix, start, now) {
  const edges = (points) => [1, 2, 4].map((i) => subtract(point(points, i), point(points, 0)));
  const [before, after] = [edges(start), edges(now)];
  let linear = [0, 1, 2].map((row) =>
    [0, 1, 2].map((k) => before.reduce((sum, edge, i) => sum + (after[i][row] * edge[k]) / dot(edge, edge), 0)),
  );
  const scale = Math.max(1e-3, Math.cbrt(Math.abs(determinant(linear))));
  const isAlike = columns([...linear]).every((column, k, all) => {
    const other = all[(k + 1) % 3];
    return Math.abs(Math.hypot(...column) - scale) < 1e-6 * scale && Math.abs(dot(column, other)) < 1e-6 * scale * scale;
  });
  if (!isAlike || determinant(linear) <= 0) linear = [0, 1, 2].map((i) => [0, 1, 2].map((k) => (i === k ? scale : 0)));
  const all = [0, 1, 2, 3, 4, 5, 6, 7];
  const [from, to] = [mean(start, all), mean(now, all)];
  const move = (p) => linear.map((row) => dot(row, p));
  const turned = columns(matrix).map(move);
  const position = add(to, move(subtract([matrix[0][3], matrix[1][3], matrix[2][3]], from)));
  return [...[0, 1, 2].map((row) => [turned[0][row], turned[1][row], turned[2][row], position[row]]), [0, 0, 0, 1]];
}
