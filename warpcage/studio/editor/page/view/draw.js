// Draws cages over the picture: what is behind matter faint and dashed, the selection, the check's faults.

import { project, projectAll } from "../geometry/camera.js";
import { hiddenPoints } from "../geometry/pick.js";
import { facesWithin, facing } from "../geometry/topology.js";
import { add, bounds, point, times } from "../geometry/vectors.js";

const PIECES = 12; // of an edge, each seen or hidden
const MAX_PIECES = 40000;
const TOLERANCE = 0.015; // share of the cage's size: the cage lies outside the object, hidden means behind matter
const MAX_RICH = 4000; // edges: cages with more are drawn plain, so that they follow the pointer
const LEVELS = 5; // of weights of proportional editing that colours show

const INK = {
  rim: "rgba(0, 0, 0, 0.5)",
  plain: "rgba(150, 165, 185, 0.9)",
  softRim: "rgba(0, 0, 0, 0.22)",
  line: "rgba(244, 247, 252, 0.95)",
  back: "rgba(240, 244, 250, 0.5)",
  faint: "rgba(240, 244, 250, 0.42)",
  other: "rgba(190, 205, 225, 0.5)",
  selected: "#ff9a1f",
  selectedFaint: "rgba(255, 154, 31, 0.55)",
  selectedFace: "rgba(255, 154, 31, 0.4)",
  active: "#ffffff",
  hover: "#ffe9a8",
  crossing: "rgba(255, 45, 70, 0.45)",
  leaking: "rgba(255, 120, 0, 0.7)",
  leakingFace: "rgba(255, 120, 0, 0.1)",
  mirror: "rgba(120, 220, 255, 0.75)",
};

/** Which vertices and pieces of edges of a cage lie behind the picture's matter. */
export function findHidden(cage, points, picture) {
  const { edges } = cage.topology;
  const pieces = Math.max(1, Math.min(PIECES, Math.floor(MAX_PIECES / Math.max(1, edges.length / 2))));
  const middles = new Float64Array((edges.length / 2) * pieces * 3);
  for (let e = 0; e < edges.length / 2; e += 1) {
    const [a, b] = [3 * edges[2 * e], 3 * edges[2 * e + 1]];
    for (let i = 0; i < pieces; i += 1) {
      const t = (i + 0.5) / pieces;
      for (let k = 0; k < 3; k += 1) middles[(e * pieces + i) * 3 + k] = points[a + k] * (1 - t) + points[b + k] * t;
    }
  }
  const [map, camera] = [picture?.map, picture?.camera];
  const tolerance = TOLERANCE * cage.size;
  return { pieces, edges: hiddenPoints(map, camera, middles, tolerance), vertices: hiddenPoints(map, camera, points, tolerance) };
}

/** Adds the runs of an edge's pieces that are hidden, or those that are seen, to a path. */
function traceEdge(path, camera, points, screen, a, b, flags, pieces, hidden) {
  if (screen[3 * a + 2] <= 0 || screen[3 * b + 2] <= 0) return;
  const place = (i) => {
    if (i === 0) return [screen[3 * a], screen[3 * a + 1]];
    if (i === pieces) return [screen[3 * b], screen[3 * b + 1]];
    const t = i / pieces;
    return project(camera, add(times(point(points, a), 1 - t), times(point(points, b), t)));
  };
  for (let i = 0; i < pieces; ) {
    let end = i + 1;
    while (end < pieces && flags[end] === flags[i]) end += 1;
    if (Boolean(flags[i]) === hidden) {
      const [from, to] = [place(i), place(end)];
      path.moveTo(from[0], from[1]);
      path.lineTo(to[0], to[1]);
    }
    i = end;
  }
}

/** Paths of a cage's edges: of its front and its back, behind matter, and of these those selected. */
function edgePaths(camera, cage, points, screen, hidden, front, isSelected) {
  const names = ["seen", "back", "behind", "chosen", "chosenBehind"];
  const paths = Object.fromEntries(names.map((name) => [name, new Path2D()]));
  const { edges } = cage.topology;
  for (let e = 0; e < edges.length / 2; e += 1) {
    const [a, b] = [edges[2 * e], edges[2 * e + 1]];
    const flags = hidden.edges.subarray(e * hidden.pieces, (e + 1) * hidden.pieces);
    const chosen = isSelected(a) && isSelected(b);
    const plain = front.edges[e] ? paths.seen : paths.back;
    traceEdge(chosen ? paths.chosen : plain, camera, points, screen, a, b, flags, hidden.pieces, false);
    traceEdge(chosen ? paths.chosenBehind : paths.behind, camera, points, screen, a, b, flags, hidden.pieces, true);
  }
  return paths;
}

/** The path of lines between points of the screen in front of the eye; `pairs`: flat, the numbers of their ends. */
export function linePath(screen, pairs) {
  const path = new Path2D();
  for (let e = 0; e < pairs.length; e += 2) {
    const [a, b] = [3 * pairs[e], 3 * pairs[e + 1]];
    if (screen[a + 2] <= 0 || screen[b + 2] <= 0) continue;
    path.moveTo(screen[a], screen[a + 1]);
    path.lineTo(screen[b], screen[b + 1]);
  }
  return path;
}

export function stroke(context, path, color, width, dash = []) {
  context.setLineDash(dash);
  context.strokeStyle = color;
  context.lineWidth = width;
  context.stroke(path);
  context.setLineDash([]);
}

export function drawDisc(context, x, y, radius, color, rim, width) {
  const disc = new Path2D();
  disc.arc(x, y, radius, 0, 2 * Math.PI);
  context.fillStyle = color;
  context.fill(disc);
  stroke(context, disc, rim, width);
}

function fillFaces(context, cage, screen, numbers, color, rim = null) {
  context.fillStyle = color;
  context.beginPath();
  for (const f of numbers) {
    const corners = cage.topology.polygons[f] ?? [];
    if (corners.length < 3 || corners.some((i) => screen[3 * i + 2] <= 0)) continue;
    corners.forEach((i, k) => context[k ? "lineTo" : "moveTo"](screen[3 * i], screen[3 * i + 1]));
    context.closePath();
  }
  context.fill();
  if (!rim) return;
  context.strokeStyle = rim;
  context.lineWidth = 4;
  context.lineJoin = "round";
  context.stroke();
}

function dots(context, screen, numbers, radius, color, rim) {
  context.beginPath();
  context.fillStyle = color;
  if (radius < 2) {
    for (const i of numbers) context.rect(screen[3 * i] - radius, screen[3 * i + 1] - radius, 2 * radius, 2 * radius);
    context.fill();
    return;
  }
  for (const i of numbers) {
    if (screen[3 * i + 2] <= 0) continue;
    context.moveTo(screen[3 * i] + radius, screen[3 * i + 1]);
    context.arc(screen[3 * i], screen[3 * i + 1], radius, 0, 2 * Math.PI);
  }
  context.fill();
  if (!rim) return;
  context.strokeStyle = rim;
  context.lineWidth = 1;
  context.stroke();
}

export const drawOther = (context, camera, cage, points) => stroke(context, linePath(projectAll(camera, points), cage.topology.edges), INK.other, 1);

function drawRich(context, paths) {
  stroke(context, paths.behind, INK.softRim, 2, [3, 4]);
  stroke(context, paths.behind, INK.faint, 1, [3, 4]);
  stroke(context, paths.chosenBehind, INK.selectedFaint, 1.4, [3, 4]);
  stroke(context, paths.back, INK.softRim, 2);
  stroke(context, paths.back, INK.back, 1);
  stroke(context, paths.seen, INK.rim, 2.6);
  stroke(context, paths.seen, INK.line, 1.3);
  stroke(context, paths.chosen, INK.rim, 3.6);
  stroke(context, paths.chosen, INK.selected, 2);
}

/** Without rims and dashes, which cost most, and without what is far from the eye. */
function drawPlain(context, paths) {
  stroke(context, paths.seen, INK.plain, 1);
  stroke(context, paths.chosenBehind, INK.selectedFaint, 1);
  stroke(context, paths.chosen, INK.selected, 1);
}

/** The cage that is worked on, with `look` = {screen, hidden, selected, active, mode, hover, check, weights}. */
export function drawCage(context, camera, cage, points, look) {
  const { screen, hidden, selected, mode, hover, check } = look;
  const isSelected = (i) => selected.has(i);
  if (check?.edit === cage.id) {
    fillFaces(context, cage, screen, check.leaking_faces ?? [], INK.leakingFace, INK.leaking); // what they cut stays in sight
    fillFaces(context, cage, screen, check.crossing_faces ?? [], INK.crossing);
  }
  if (mode === "face") fillFaces(context, cage, screen, facesWithin(cage.topology.polygons, selected), INK.selectedFace);
  const front = facing(cage.topology, points, camera.eye, cage.sense);
  const paths = edgePaths(camera, cage, points, screen, hidden, front, isSelected);
  if (cage.topology.edges.length / 2 > MAX_RICH) drawPlain(context, paths);
  else drawRich(context, paths);
  if (hover?.mode === "face") fillFaces(context, cage, screen, [hover.number], "rgba(255, 233, 168, 0.32)");
  if (hover?.mode === "edge") stroke(context, linePath(screen, hover.vertices), INK.hover, 3);
  const groups = { seen: [], back: [], behind: [], chosen: [], chosenBehind: [] };
  for (let i = 0; i < hidden.vertices.length; i += 1) {
    const [near, far] = selected.has(i) ? ["chosen", "chosenBehind"] : [front.vertices[i] ? "seen" : "back", "behind"];
    groups[hidden.vertices[i] ? far : near].push(i);
  }
  const isLarge = cage.topology.edges.length / 2 > MAX_RICH;
  const size = isLarge ? 0.5 : mode === "vertex" ? 1 : 0.7;
  const rim = isLarge ? null : INK.rim;
  if (isLarge) groups.behind = groups.back = [];
  dots(context, screen, groups.behind, 2.2 * size, INK.faint);
  dots(context, screen, groups.back, 2.8 * size, INK.back, rim && INK.softRim);
  dots(context, screen, groups.seen, 3.4 * size, INK.line, rim);
  dots(context, screen, groups.chosenBehind, 4 * size, INK.selectedFaint, rim);
  dots(context, screen, groups.chosen, 5 * size, INK.selected, rim);
  if (hover?.mode === "vertex") dots(context, screen, hover.vertices, 6, INK.hover, INK.rim);
  for (let level = 1; look.weights && level <= LEVELS; level += 1) {
    const share = (i) => Math.ceil(look.weights[i] * LEVELS) === level && !selected.has(i);
    const some = Array.from(hidden.vertices.keys()).filter(share);
    dots(context, screen, some, 4 * size, `rgba(255, 154, 31, ${level / LEVELS})`);
  }
  if (look.active >= 0) {
    dots(context, screen, [look.active], 4.5, INK.active, INK.rim);
    dots(context, screen, [look.active], 2.5, INK.selected);
  }
}

/** The rectangle where the plane of symmetry cuts the box of the rest cage. */
export function drawMirror(context, camera, cage, axis) {
  const [lower, upper] = bounds(cage.rest);
  const middle = (lower[axis] + upper[axis]) / 2;
  const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
  const path = new Path2D();
  const corners = [[lower, lower], [upper, lower], [upper, upper], [lower, upper]].map(([a, b]) => {
    const p = [middle, middle, middle];
    [p[u], p[v]] = [a[u], b[v]];
    return project(camera, p);
  });
  if (corners.some(([, , z]) => z <= 0)) return;
  corners.forEach(([x, y], i) => path[i ? "lineTo" : "moveTo"](x, y));
  path.closePath();
  stroke(context, path, INK.rim, 2.5);
  stroke(context, path, INK.mirror, 1.4, [8, 4]);
}

/** The rectangle, lasso or stroke of a brush that is being drawn (flat x, y of its path). */
export function drawRegion(context, shape, path, radius = 0) {
  const outline = new Path2D();
  if (shape === "brush") {
    for (let i = 0; i < path.length; i += 2) outline[i ? "lineTo" : "moveTo"](path[i], path[i + 1]);
    outline.lineTo(...path.slice(-2)); // a dab is seen too
    Object.assign(context, { lineCap: "round", lineJoin: "round" });
    stroke(context, outline, "rgba(255, 154, 31, 0.28)", 2 * radius);
    Object.assign(context, { lineCap: "butt", lineJoin: "miter" });
    return;
  }
  if (shape === "lasso") {
    for (let i = 0; i < path.length; i += 2) outline[i ? "lineTo" : "moveTo"](path[i], path[i + 1]);
    outline.closePath();
  } else {
    const [x0, y0] = path;
    const [x1, y1] = path.slice(-2);
    outline.rect(Math.min(x0, x1), Math.min(y0, y1), Math.abs(x1 - x0), Math.abs(y1 - y0));
  }
  context.fillStyle = "rgba(255, 255, 255, 0.08)";
  context.fill(outline);
  stroke(context, outline, "rgba(0, 0, 0, 0.6)", 2.5);
  stroke(context, outline, "#ffffff", 1, [5, 4]);
}

/** The circle within which proportional editing moves what is not selected. */
export function drawCircle(context, x, y, radius) {
  const path = new Path2D();
  path.arc(x, y, radius, 0, 2 * Math.PI);
  stroke(context, path, "rgba(0, 0, 0, 0.5)", 3);
  stroke(context, path, "rgba(255, 255, 255, 0.85)", 1.2);
}

/** Lines of text in the picture's lower left corner; the first one large. */
export function drawHint(context, lines, height) {
  context.save();
  const fonts = lines.map((_, i) => (i ? "12px system-ui, sans-serif" : "600 14px system-ui, sans-serif"));
  const wide = Math.max(...lines.map((line, i) => ((context.font = fonts[i]), context.measureText(line).width)));
  const top = height - 14 - 20 * lines.length - 12;
  context.fillStyle = "rgba(16, 20, 26, 0.78)";
  context.beginPath();
  context.roundRect(12, top, wide + 24, 20 * lines.length + 14, 8);
  context.fill();
  context.textBaseline = "middle";
  lines.forEach((line, i) => {
    context.font = fonts[i];
    context.fillStyle = i ? "#c4ccd8" : "#ffffff";
    context.fillText(line, 24, top + 17 + 20 * i);
  });
  context.restore();
}
