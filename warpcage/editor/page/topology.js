// Edges, neighbours and parts of a cage. Faces are flat (a0, b0, c0, a1, ...), selections are sets of vertex numbers.

/** Edges (flat pairs, smaller number first), neighbours of each vertex and the part that each vertex belongs to. */
export function makeTopology(faces, count) {
  const neighbours = Array.from({ length: count }, () => []);
  const seen = new Set();
  const edges = [];
  for (let f = 0; f < faces.length; f += 3) {
    for (let k = 0; k < 3; k += 1) {
      const a = Math.min(faces[f + k], faces[f + ((k + 1) % 3)]);
      const b = Math.max(faces[f + k], faces[f + ((k + 1) % 3)]);
      const name = a * count + b;
      if (a === b || seen.has(name)) continue;
      seen.add(name);
      edges.push(a, b);
      neighbours[a].push(b);
      neighbours[b].push(a);
    }
  }
  const parts = new Int32Array(count).fill(-1);
  let part = 0;
  for (let start = 0; start < count; start += 1) {
    if (parts[start] >= 0) continue;
    parts[start] = part;
    for (const stack = [start]; stack.length; ) {
      for (const n of neighbours[stack.pop()]) {
        if (parts[n] >= 0) continue;
        parts[n] = part;
        stack.push(n);
      }
    }
    part += 1;
  }
  return { count, faces, edges: Int32Array.from(edges), neighbours, parts };
}

/** All vertices that hang together with any of these. */
export function linked(topology, selected) {
  const wanted = new Set([...selected].map((i) => topology.parts[i]));
  return new Set(Array.from({ length: topology.count }, (_, i) => i).filter((i) => wanted.has(topology.parts[i])));
}

/** The selection and its neighbours. */
export function grow(topology, selected) {
  const out = new Set(selected);
  for (const i of selected) for (const n of topology.neighbours[i]) out.add(n);
  return out;
}

/** The selection without its rim: vertices whose neighbours are all selected. */
export function shrink(topology, selected) {
  return new Set([...selected].filter((i) => topology.neighbours[i].every((n) => selected.has(n))));
}

/** All that is not selected. */
export function invert(topology, selected) {
  return new Set(Array.from({ length: topology.count }, (_, i) => i).filter((i) => !selected.has(i)));
}

/** Numbers of the faces with all three vertices selected. */
export function facesWithin(faces, selected) {
  const out = [];
  for (let f = 0; f < faces.length / 3; f += 1) {
    if (selected.has(faces[3 * f]) && selected.has(faces[3 * f + 1]) && selected.has(faces[3 * f + 2])) out.push(f);
  }
  return out;
}

/** The sum of the faces' normals times twice their area, over the faces that touch a selection. */
export function normalAround(faces, points, selected) {
  const normal = [0, 0, 0];
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [faces[f], faces[f + 1], faces[f + 2]];
    if (!selected.has(a) && !selected.has(b) && !selected.has(c)) continue;
    const u = [0, 1, 2].map((k) => points[3 * b + k] - points[3 * a + k]);
    const v = [0, 1, 2].map((k) => points[3 * c + k] - points[3 * a + k]);
    normal[0] += u[1] * v[2] - u[2] * v[1];
    normal[1] += u[2] * v[0] - u[0] * v[2];
    normal[2] += u[0] * v[1] - u[1] * v[0];
  }
  return normal;
}
