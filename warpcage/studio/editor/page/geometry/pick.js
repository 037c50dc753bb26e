// What is under the pointer, in a rectangle or in a lasso, and what is hidden. Screen points are flat: x, y, distance.

import { projectAll, rayThrough } from "./camera.js";
import { add, times } from "./vectors.js";

const everything = () => true;

/** The vertex nearest to a pixel within a radius (pixels), the nearer to the eye of two alike; -1 where there is none. */
export function vertexAt(screen, x, y, radius, allowed = everything) {
  let best = -1;
  let least = Infinity;
  for (let i = 0; i < screen.length / 3; i += 1) {
    const away = Math.hypot(screen[3 * i] - x, screen[3 * i + 1] - y);
    if (screen[3 * i + 2] <= 0 || away > radius || !allowed(i)) continue;
    // Two handles over each other: a pixel of doubt is worth less than being in front
    const cost = Math.round(away / 2) + screen[3 * i + 2] * 1e-6;
    if (cost < least) [best, least] = [i, cost];
  }
  return best;
}

/** Distance of a pixel from the line between two pixels, and how far along it (0 to 1) the nearest place is. */
export function toSegment(x, y, x0, y0, x1, y1) {
  const [dx, dy] = [x1 - x0, y1 - y0];
  const t = Math.max(0, Math.min(1, ((x - x0) * dx + (y - y0) * dy) / Math.max(dx * dx + dy * dy, 1e-12)));
  return [Math.hypot(x - x0 - t * dx, y - y0 - t * dy), t];
}

export function edgeAt(screen, edges, x, y, radius, allowed = everything) {
  let best = -1;
  let least = Infinity;
  for (let e = 0; e < edges.length / 2; e += 1) {
    const [a, b] = [3 * edges[2 * e], 3 * edges[2 * e + 1]];
    if (screen[a + 2] <= 0 || screen[b + 2] <= 0) continue;
    const [away, t] = toSegment(x, y, screen[a], screen[a + 1], screen[b], screen[b + 1]);
    if (away > radius || !allowed(e)) continue;
    const cost = Math.round(away / 2) + (screen[a + 2] * (1 - t) + screen[b + 2] * t) * 1e-6;
    if (cost < least) [best, least] = [e, cost];
  }
  return best;
}

export function faceAt(screen, faces, x, y, allowed = everything) {
  let best = -1;
  let least = Infinity;
  for (let f = 0; f < faces.length / 3; f += 1) {
    const [a, b, c] = [0, 1, 2].map((k) => 3 * faces[3 * f + k]);
    if (screen[a + 2] <= 0 || screen[b + 2] <= 0 || screen[c + 2] <= 0) continue;
    const area = (i, j) => (screen[i] - x) * (screen[j + 1] - y) - (screen[j] - x) * (screen[i + 1] - y);
    const [u, v, w] = [area(b, c), area(c, a), area(a, b)];
    if (!((u >= 0 && v >= 0 && w >= 0) || (u <= 0 && v <= 0 && w <= 0)) || u + v + w === 0 || !allowed(f)) continue;
    const near = (u * screen[a + 2] + v * screen[b + 2] + w * screen[c + 2]) / (u + v + w);
    if (near < least) [best, least] = [f, near];
  }
  return best;
}

/** Whether each screen point lies in a rectangle given by two corners. */
export function inRectangle(screen, x0, y0, x1, y1) {
  const [left, right, top, bottom] = [Math.min(x0, x1), Math.max(x0, x1), Math.min(y0, y1), Math.max(y0, y1)];
  return Array.from({ length: screen.length / 3 }, (_, i) => {
    const [x, y, z] = [screen[3 * i], screen[3 * i + 1], screen[3 * i + 2]];
    return z > 0 && x >= left && x <= right && y >= top && y <= bottom;
  });
}

/** Whether a pixel lies in a polygon (flat x, y), by the even-odd rule. */
export function isInside(polygon, x, y) {
  let inside = false;
  const n = polygon.length / 2;
  for (let i = 0, j = n - 1; i < n; j = i, i += 1) {
    const [xi, yi, xj, yj] = [polygon[2 * i], polygon[2 * i + 1], polygon[2 * j], polygon[2 * j + 1]];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) inside = !inside;
  }
  return inside;
}

/** Whether each screen point lies in a lasso (flat x, y of its path). */
export function inLasso(screen, polygon) {
  return Array.from({ length: screen.length / 3 }, (_, i) => {
    return screen[3 * i + 2] > 0 && isInside(polygon, screen[3 * i], screen[3 * i + 1]);
  });
}

/** Whether each screen point lies within a radius (pixels) of a path (flat x, y). */
export function inBrush(screen, path, radius) {
  const ends = path.length > 2 ? path : [...path, ...path];
  return Array.from({ length: screen.length / 3 }, (_, i) => {
    const [x, y, z] = [screen[3 * i], screen[3 * i + 1], screen[3 * i + 2]];
    for (let k = 0; z > 0 && k + 3 < ends.length; k += 2) {
      if (toSegment(x, y, ends[k], ends[k + 1], ends[k + 2], ends[k + 3])[0] <= radius) return true;
    }
    return false;
  });
}

/** The vertices that a region takes: those inside; of edges with both ends inside; of faces whose middle is inside. */
export function verticesInRegion(mode, topology, screen, inside, allowed = everything) {
  const taken = (i) => inside[i] && allowed(i);
  const out = new Set();
  if (mode === "vertex") inside.forEach((_, i) => taken(i) && out.add(i));
  const { edges, polygons } = topology;
  for (let e = 0; mode === "edge" && e < edges.length; e += 2) {
    if (taken(edges[e]) && taken(edges[e + 1])) out.add(edges[e]).add(edges[e + 1]);
  }
  for (const corners of mode === "face" ? polygons : []) {
    if (inside.ofMiddle(corners) && corners.some(allowed)) corners.forEach((i) => out.add(i));
  }
  return out;
}

/** A test of vertices with a test of faces' middles: `test` answers for flat screen points. */
export function region(screen, test) {
  const inside = test(screen);
  inside.ofMiddle = (corners) => {
    const middle = [0, 0, Infinity];
    for (const i of corners) {
      for (let k = 0; k < 2; k += 1) middle[k] += screen[3 * i + k] / corners.length;
      middle[2] = Math.min(middle[2], screen[3 * i + 2]);
    }
    return test(Float64Array.from(middle))[0];
  };
  return inside;
}

/** The distance along the ray that a depth map {width, height, near, far, data} has at a pixel; Infinity: nothing. */
export function depthAt(map, x, y) {
  const [i, j] = [Math.floor(x), Math.floor(y)];
  if (i < 0 || j < 0 || i >= map.width || j >= map.height) return Infinity;
  const value = map.data[j * map.width + i];
  return value === 0 ? Infinity : map.near * (map.far / map.near) ** ((value - 1) / 65534);
}

const SAME = 0.02; // share of a distance by which neighbors of one surface may differ

/** The place of the matter at a pixel of a depth map, by the camera of its size; null where there is nothing. */
export function surfacePoint(map, camera, x, y) {
  const here = depthAt(map, x, y);
  if (here === Infinity) return null;
  // Between the middles of four pixels of one surface; at its rims the pixel's own
  const [i, j] = [Math.floor(x - 0.5), Math.floor(y - 0.5)];
  const [s, t] = [x - 0.5 - i, y - 0.5 - j];
  const around = [[0, 0], [1, 0], [0, 1], [1, 1]].map(([a, b]) => depthAt(map, i + a, j + b));
  const isOne = around.every((depth) => Math.abs(depth - here) < SAME * here);
  const [a, b, c, d] = around;
  const depth = isOne ? (a * (1 - s) + b * s) * (1 - t) + (c * (1 - s) + d * s) * t : here;
  return add(camera.eye, times(rayThrough(camera, x, y), depth));
}

/** Whether each of the flat points lies behind matter, by a depth map and its camera (of its size), with a tolerance. */
export function hiddenPoints(map, camera, points, tolerance) {
  const out = new Uint8Array(points.length / 3);
  if (!map) return out;
  const screen = projectAll(camera, points);
  const [x, y, z] = camera.eye;
  for (let i = 0; i < points.length; i += 3) {
    if (screen[i + 2] <= 0) continue;
    const away = Math.hypot(points[i] - x, points[i + 1] - y, points[i + 2] - z);
    if (away > depthAt(map, screen[i], screen[i + 1]) + tolerance) out[i / 3] = 1;
  }
  return out;
}
