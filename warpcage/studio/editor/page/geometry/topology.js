// Edges, neighbors and parts of a cage. Polygons are lists of corners, faces the triangles that they are cut into, flat
// (a0, b0, c0, a1, ...); selections are sets of vertex numbers.

import { add, cross, dot, point, subtract } from "./vectors.js";

/** Polygons without what stands behind their last corner, -1. */
export const wholePolygons = (polygons) => polygons.map((corners) => corners.filter((i) => i >= 0));

/** Triangles of polygons, the polygon of each, edges of polygons (flat pairs, smaller number first), three edges of each
 * triangle (-1: it is inside of a polygon), neighbors and part of each vertex. */
export function makeTopology(polygons, count) {
  const cut = (corners) => corners.slice(2).flatMap((c, k) => [corners[0], corners[k + 1], c]);
  const faces = Int32Array.from(polygons.flatMap(cut));
  const owner = Int32Array.from(polygons.flatMap((corners, number) => corners.slice(2).map(() => number)));
  const neighbors = Array.from({ length: count }, () => []);
  const seen = new Map(); // edge by its two vertices -> its number
  const edges = [];
  const faceEdges = new Int32Array(faces.length).fill(-1);
  for (let f = 0; f < faces.length; f += 3) {
    const [isFirst, isLast] = [owner[f / 3 - 1] !== owner[f / 3], owner[f / 3 + 1] !== owner[f / 3]];
    for (let k = 0; k < 3; k += 1) {
      const a = Math.min(faces[f + k], faces[f + ((k + 1) % 3)]);
      const b = Math.max(faces[f + k], faces[f + ((k + 1) % 3)]);
      const name = a * count + b;
      if (a === b || (k === 0 && !isFirst) || (k === 2 && !isLast)) continue;
      faceEdges[f + k] = seen.get(name) ?? edges.length / 2;
      if (seen.has(name)) continue;
      seen.set(name, edges.length / 2);
      edges.push(a, b);
      neighbors[a].push(b);
      neighbors[b].push(a);
    }
  }
  const parts = new Int32Array(count).fill(-1);
  let part = 0;
  for (let start = 0; start < count; start += 1) {
    if (parts[start] >= 0) continue;
    parts[start] = part;
    for (const stack = [start]; stack.length; ) {
      for (const n of neighbors[stack.pop()]) {
        if (parts[n] >= 0) continue;
        parts[n] = part;
        stack.push(n);
      }
    }
    part += 1;
  }
  return { count, polygons, faces, owner, edges: Int32Array.from(edges), faceEdges, neighbors, parts };
}

/** All vertices that hang together with any of these. */
export function linked(topology, selected) {
  const wanted = new Set([...selected].map((i) => topology.parts[i]));
  return new Set(Array.from({ length: topology.count }, (_, i) => i).filter((i) => wanted.has(topology.parts[i])));
}

export function grow(topology, selected) {
  const out = new Set(selected);
  for (const i of selected) for (const n of topology.neighbors[i]) out.add(n);
  return out;
}

/** The selection without its rim: vertices whose neighbors are all selected. */
export function shrink(topology, selected) {
  return new Set([...selected].filter((i) => topology.neighbors[i].every((n) => selected.has(n))));
}

export function invert(topology, selected) {
  return new Set(Array.from({ length: topology.count }, (_, i) => i).filter((i) => !selected.has(i)));
}

/** Numbers of the polygons with all vertices selected. */
export function facesWithin(polygons, selected) {
  return [...polygons.keys()].filter((number) => polygons[number].every((i) => selected.has(i)));
}

/** Six times the volume that the faces enclose: positive where they look outwards. */
export function signedVolume(faces, points) {
  let sum = 0;
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => point(points, faces[f + k]));
    sum += dot(a, cross(b, c));
  }
  return sum;
}

/** Which edges and vertices touch a face that looks at the eye: {edges, vertices}, 1 or 0 each. */
export function facing(topology, points, eye, sense) {
  const { faces, faceEdges } = topology;
  const edges = new Uint8Array(topology.edges.length / 2);
  const vertices = new Uint8Array(topology.count);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => subtract(point(points, faces[f + k]), eye));
    if (dot(a, cross(b, c)) * sense > 0) continue;
    for (let k = 0; k < 3; k += 1) {
      if (faceEdges[f + k] >= 0) edges[faceEdges[f + k]] = 1;
      vertices[faces[f + k]] = 1;
    }
  }
  return { edges, vertices };
}

/** The sum of the faces' normals times twice their area, over the faces that touch a selection. */
export function normalAround(faces, points, selected) {
  let normal = [0, 0, 0];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [faces[f], faces[f + 1], faces[f + 2]];
    if (!selected.has(a) && !selected.has(b) && !selected.has(c)) continue;
    const start = point(points, a);
    normal = add(normal, cross(subtract(point(points, b), start), subtract(point(points, c), start)));
  }
  return normal;
}
