// Selecting: what is under the pointer, regions, steps by keys; and the actions of selection, view and transforms.

import { register, store } from "../core/store.js";
import { request } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { frameAll, lookFrom, namedDirections, orbit, pan, zoom } from "../geometry/camera.js";
import * as P from "../geometry/pick.js";
import * as topology from "../geometry/topology.js";
import { point } from "../geometry/vectors.js";
import { isBrush, resizeBrush } from "../tools/brush.js";
import * as C from "./cages.js";
import * as operation from "./operation.js";
import { inScene, isPlacing, sceneCorners, objects } from "./objects.js";
import { camera, getSize, getView, hiddenOf, requestDraw, screenOf, setView } from "./viewport.js";

/** Where the pointer is over the canvas (CSS pixels), or null. */
export const pointer = { at: null };

/** The cage that keys and regions act on: the active one, else the first that is seen. */
const cageNow = () => C.activeCage() ?? C.visibleCages()[0];

/** What of a cage may be picked: everything, or what is not hidden. */
function allowedOf(cage) {
  if (store.tools.through) return () => true;
  const { vertices } = hiddenOf(cage);
  return (i) => !vertices[i];
}

function elementOf(cage, x, y, reach) {
  const mode = C.pickMode();
  const screen = screenOf(cage);
  const allowed = allowedOf(cage);
  const { edges, faces, owner, polygons } = cage.topology;
  let vertices = null;
  let number = -1;
  if (mode === "vertex") {
    number = P.vertexAt(screen, x, y, reach, allowed);
    vertices = [number];
  } else if (mode === "edge") {
    number = P.edgeAt(screen, edges, x, y, reach, (e) => allowed(edges[2 * e]) || allowed(edges[2 * e + 1]));
    vertices = [edges[2 * number], edges[2 * number + 1]];
  } else {
    number = P.faceAt(screen, faces, x, y, (f) => polygons[owner[f]].some(allowed));
    if (number >= 0) number = owner[number];
    vertices = polygons[number] ?? [];
  }
  return number < 0 ? null : { cage, mode, number, vertices };
}

/** The vertex, edge or face under a pixel: of the active cage, else of another one; or null. */
export function elementAt(x, y, reach) {
  if (!store.tools.cage || isPlacing()) return null;
  const current = C.activeCage();
  const all = C.visibleCages();
  const others = all.filter((cage) => cage !== current);
  for (const cage of current?.visible ? [current, ...others] : others) {
    const element = elementOf(cage, x, y, reach);
    if (element) return element;
  }
  return null;
}

/** Selects what was clicked: alone, added or, where it is selected, taken away ("add"), taken away ("remove"). */
export function clicked(element, way) {
  const current = C.activeCage();
  if (!element) {
    if (way === "replace" && current) C.select(current.id, [], { active: -1 });
    return;
  }
  const isOther = element.cage !== current;
  const chosen = new Set(way === "replace" || isOther ? [] : C.selected());
  const isTaken = way === "remove" || (way === "add" && element.vertices.every((i) => chosen.has(i)));
  for (const i of element.vertices) {
    if (isTaken) chosen.delete(i);
    else chosen.add(i);
  }
  C.select(element.cage.id, chosen, { active: isTaken ? -1 : element.vertices[0] });
}

/** The selection that a rectangle, a lasso or a brush would make of the active cage. */
export function regionSelection({ shape, path, way }) {
  const cage = cageNow();
  if (!cage?.visible || !store.tools.cage) return null;
  const screen = screenOf(cage);
  const corners = [path[0], path[1], ...path.slice(-2)];
  const tests = { rectangle: (s) => P.inRectangle(s, ...corners), lasso: (s) => P.inLasso(s, path), brush: (s) => P.inBrush(s, path, store.tools.brush) };
  const inside = P.region(screen, tests[shape]);
  const found = P.verticesInRegion(C.pickMode(), cage.topology, screen, inside, allowedOf(cage));
  if (way === "replace") return { cage, vertices: found };
  const chosen = new Set(C.selected());
  for (const i of found) {
    if (way === "remove") chosen.delete(i);
    else chosen.add(i);
  }
  return { cage, vertices: chosen };
}

const hasCage = () => !isPlacing() && Boolean(cageNow()?.visible);
const hasSelection = () => hasCage() && C.selected().size > 0;

function choose(make) {
  return () => {
    const cage = cageNow();
    C.select(cage.id, make(cage, C.activeCage() === cage ? C.selected() : new Set()));
  };
}

const all = (cage) => new Set(Array.from({ length: cage.topology.count }, (_, i) => i));

/** Changes what clicks pick; the selection stays, but for edges and faces that are not whole. */
function pickBy(mode) {
  const cage = cageNow();
  const chosen = C.selected();
  let kept = chosen;
  if (mode !== "vertex" && C.activeCage() === cage) {
    const { edges, polygons } = cage.topology;
    const pairs = Array.from({ length: edges.length / 2 }, (_, e) => [edges[2 * e], edges[2 * e + 1]]);
    kept = new Set();
    for (const part of mode === "edge" ? pairs : polygons) {
      if (part.every((v) => chosen.has(v))) part.forEach((v) => kept.add(v));
    }
  }
  C.select(cage.id, kept, { mode });
}

/** The vertices that hang together with what is under the pointer. */
function linkedUnderPointer() {
  const element = pointer.at && elementAt(...pointer.at, 24);
  if (!element) {
    toast("L selects what is linked to the part of the cage under the pointer.", "info");
    return;
  }
  const { cage, vertices } = element;
  const before = cage === C.activeCage() ? C.selected() : new Set();
  C.select(cage.id, new Set([...before, ...topology.linked(cage.topology, new Set(vertices))]), { active: vertices[0] });
}

/** Goes from the active vertex to the next one in a direction on the screen, and selects it. */
function step(dx, dy, isAdded) {
  const cage = cageNow();
  const screen = screenOf(cage);
  const allowed = allowedOf(cage);
  const from = C.activeVertex();
  const [width, height] = getSize();
  let best = -1;
  let least = Infinity;
  const [x0, y0] = from < 0 ? [width / 2, height / 2] : [screen[3 * from], screen[3 * from + 1]];
  for (let i = 0; i < cage.topology.count; i += 1) {
    if (i === from || screen[3 * i + 2] <= 0 || !allowed(i)) continue;
    const [x, y] = [screen[3 * i] - x0, screen[3 * i + 1] - y0];
    const along = x * dx + y * dy;
    const cost = from < 0 ? Math.hypot(x, y) : along + 2.5 * Math.abs(x * dy - y * dx); // what lies ahead, not beside
    if (cost < least && (from < 0 || along > 0.5)) [best, least] = [i, cost];
  }
  if (best >= 0) C.select(cage.id, isAdded ? [...C.selected(), best] : [best], { active: best });
}

/** Goes to the vertex with the next number, or the one before. */
function count(way) {
  const cage = cageNow();
  const { count: most } = cage.topology;
  const next = (C.activeVertex() + way + most + (C.activeVertex() < 0 && way < 0 ? 1 : 0)) % most;
  C.select(cage.id, [next], { active: next });
}

/** Begins a move, rotation or scaling that the pointer leads without a pressed button, or typed numbers. */
function begin(kind) {
  const begun = operation.begin(kind, { camera: camera(), at: pointer.at });
  if (begun) requestDraw();
  else if (isPlacing()) toast("The active object is hidden or locked: show or unlock it in the group Objects.", "info");
  else toast("Select vertices of a visible cage first: click, drag a rectangle, or A for all.", "info");
}

const worldUp = () => store.sections.session?.field?.up ?? [0, 0, 1];

/** Looks from a named side; from the other one where the view is there already. */
export function lookBy(name) {
  setView(lookFrom(getView(), ...namedDirections(worldUp())[name]));
}

export function lookAlong(direction) {
  const named = Object.values(namedDirections(worldUp()));
  const same = named.find(([to]) => to.every((value, k) => Math.abs(value - direction[k]) < 1e-6));
  setView(lookFrom(getView(), direction, same?.[1] ?? worldUp()));
}

export const turnBy = (across, upward) => setView(orbit(getView(), across, upward, worldUp()));
export const panBy = (dx, dy) => setView(pan(getView(), dx, dy, getSize()[1]));

/** Brings the eye nearer or farther by a factor. */
export function zoomBy(factor) {
  const [lower, upper] = store.sections.session?.field?.bounds ?? [[0, 0, 0], [1, 1, 1]];
  setView(zoom(getView(), factor, 1e-3 * Math.hypot(...lower.map((value, k) => upper[k] - value))));
}

function frame(points) {
  const [width, height] = getSize();
  setView(frameAll(getView(), points, width / height));
}

function frameEverything() {
  const cages = C.visibleCages();
  if (objects().length > 1 || isPlacing()) return frame(sceneCorners());
  const points = cages.flatMap((cage) => [...inScene(C.places(cage))]);
  return frame(points.length ? points : (store.sections.session?.field?.bounds ?? []).flat());
}

function frameSelection() {
  const points = inScene(C.places(cageNow()));
  const places = [...C.selected()].flatMap((i) => point(points, i));
  if (places.length > 3) frame(places);
  else {
    const target = places; // one vertex
    const view = getView();
    const shift = target.map((value, k) => value - view.target[k]);
    setView({ ...view, target, eye: view.eye.map((value, k) => value + shift[k]) });
  }
}

function registerSelect(name, label, keys, run, enabled = hasCage, repeat = false) {
  register(`select.${name}`, { label, keys, group: "Select", run, enabled, repeat });
}

registerSelect("all", "All", ["A"], choose(all));
registerSelect("none", "None", ["Alt+A"], choose(() => new Set()));
registerSelect("invert", "Invert", ["Ctrl+I"], choose((cage, chosen) => topology.invert(cage.topology, chosen)));
registerSelect("linked.pointer", "Linked, under the pointer", ["L"], linkedUnderPointer);
registerSelect("linked", "Linked", ["Ctrl+L"], choose((cage, chosen) => topology.linked(cage.topology, chosen)));
registerSelect("grow", "Grow", ["Ctrl++", "Ctrl+="], choose((cage, chosen) => topology.grow(cage.topology, chosen)), hasSelection, true);
registerSelect("shrink", "Shrink", ["Ctrl+-"], choose((cage, chosen) => topology.shrink(cage.topology, chosen)), hasSelection, true);
registerSelect("vertices", "Select vertices", ["1"], () => pickBy("vertex"));
registerSelect("edges", "Select edges", ["2"], () => pickBy("edge"));
registerSelect("faces", "Select faces", ["3"], () => pickBy("face"));
const canCount = () => isBrush() || hasCage();
registerSelect("next", "Next vertex by number; with the brush: a larger brush", ["]"], () => (isBrush() ? resizeBrush(1.2) : count(1)), canCount, true);
registerSelect("previous", "Previous vertex by number; with the brush: a smaller brush", ["["], () => (isBrush() ? resizeBrush(1 / 1.2) : count(-1)), canCount, true);
for (const [name, dx, dy] of [["Left", -1, 0], ["Right", 1, 0], ["Up", 0, -1], ["Down", 0, 1]]) {
  const side = name.toLowerCase();
  const there = { up: "above", down: "below" }[side] ?? `to the ${side}`;
  registerSelect(`step.${side}`, `Vertex ${there}`, [`Ctrl+Arrow${name}`], () => step(dx, dy, false), hasCage, true);
  registerSelect(`add.${side}`, `Add the vertex ${there}`, [`Ctrl+Shift+Arrow${name}`], () => step(dx, dy, true), hasCage, true);
  const view = { group: "View", repeat: true };
  const angle = Math.PI / 36;
  register(`view.turn.${side}`, { ...view, label: `Orbit ${side}`, keys: [`Arrow${name}`], run: () => turnBy(dx * angle, dy * -angle) });
  register(`view.pan.${side}`, { ...view, label: `Pan ${side}`, keys: [`Shift+Arrow${name}`], run: () => panBy(dx * 30, dy * 30) });
}
register("view.nearer", { label: "Zoom in", keys: ["+", "="], group: "View", repeat: true, run: () => zoomBy(1 / 1.15) });
register("view.farther", { label: "Zoom out", keys: ["-"], group: "View", repeat: true, run: () => zoomBy(1.15) });
register("view.all", { label: "Frame all", keys: ["Home"], group: "View", run: frameEverything });
register("view.selection", { label: "Frame the selection", keys: ["F", "."], group: "View", run: frameSelection, enabled: hasSelection });
["front", "right", "top", "back", "left", "bottom"].forEach((name, i) => {
  const keys = [`Ctrl+${i + 1}`, `Shift+${i + 1}`]; // some browsers keep Ctrl+1 for themselves
  const label = `${name[0].toUpperCase()}${name.slice(1)} view`;
  register(`view.${name}`, { label, keys, group: "View", run: () => lookBy(name) });
});

for (const [kind, key, label] of [["move", "G", "Move"], ["rotate", "R", "Rotate"], ["scale", "S", "Scale"]]) {
  register(`transform.${kind}`, { label: `${label} the selection`, keys: [key], group: "Transform", run: () => begin(kind) });
}

const reset = (vertices) => request({ do: "pose.reset", edit: C.activeCage().id, vertices });
register("pose.reset", {
  label: "Bring the selection back to rest",
  keys: ["Alt+G"],
  group: "Transform",
  enabled: () => hasSelection() && C.placesName() === "posed",
  run: () => reset([...C.selected()]),
});
register("pose.reset.all", {
  label: "Bring all vertices back to rest",
  keys: ["Alt+Shift+G"],
  group: "Transform",
  enabled: () => Boolean(C.activeCage()) && C.placesName() === "posed",
  run: () => reset(null),
});
