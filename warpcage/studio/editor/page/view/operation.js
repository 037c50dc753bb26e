// A move, rotation or scaling under way: begun by a key or by a handle, led by the pointer or by typed numbers.

import { store } from "../core/store.js";
import { project } from "../geometry/camera.js";
import { normalAround } from "../geometry/topology.js";
import * as T from "../geometry/transform.js";
import { AXIS_NAMES, add, dot, mean, subtract, times, unit } from "../geometry/vectors.js";
import * as drag from "./subject.js";
import { activeCage, activeVertex, places, selected } from "./subject.js";
import { isPlacing } from "./objects.js";

const LABELS = { move: "Move", rotate: "Rotate", scale: "Scale" };
const NAMES = AXIS_NAMES.map((name) => name.toUpperCase());
let operation = null;
let mirrors = { rest: null, axis: -1, mirror: null };

export const current = () => operation;

/** The axis across the plane of this page's symmetry (0, 1, 2), or -1. */
export const mirrorAxis = () => (isPlacing() ? -1 : AXIS_NAMES.indexOf(store.tools.symmetry));

/** The mirror of a cage by this page's symmetry, or null. */
function mirrorNow(cage) {
  const axis = mirrorAxis();
  if (axis < 0) return null;
  if (mirrors.rest !== cage.rest || mirrors.axis !== axis) {
    mirrors = { rest: cage.rest, axis, mirror: T.mirrorOf(cage.rest, axis) };
  }
  return mirrors.mirror;
}

/** The axes that tools use now at a selection: "world", "view" or "local". */
export function basisNow(axes, camera, cage, points, chosen) {
  if (cage.isObject) return axes === "local" ? cage.axes : T.basisOf(axes, camera, null);
  return T.basisOf(axes, camera, axes === "local" ? normalAround(cage.faces, points, chosen) : null);
}

/** Begins; `allowed`: the axes that may change, `way`: their orientation, `source`: "keys" or "pointer". Null: no selection. */
export function begin(kind, { camera, at, allowed = [true, true, true], way = store.tools.axes, source = "keys" }) {
  const cage = activeCage();
  if (operation || !cage?.visible || !selected().size) return null;
  const start = places(cage);
  const chosen = new Set(selected());
  const mirror = mirrorNow(cage);
  const side = mirror ? T.leadingSide(cage.rest, mirror, chosen, activeVertex()) : 0;
  const pivot = mean(start, [...chosen]);
  const [x, y] = project(camera, pivot);
  const from = at ?? [x + 60, y];
  operation = {
    ...{ kind, cage, start, chosen, pivot, mirror, side, source, camera, allowed, way },
    ...{ from, pointer: from, seen: at, angle: 0, time: performance.now(), dirty: false, weights: null },
    typed: null,
    text: "",
    offset: [0, 0, 0],
  };
  operation.typed = new T.Typed(fieldCount());
  drag.begin(cage, `${LABELS[kind]} ${cage.isObject ? cage.name : chosen.size === 1 ? "a vertex" : `${chosen.size} vertices`}`);
  weigh();
  return operation;
}

const fieldCount = () => (operation.kind === "move" ? operation.allowed.filter(Boolean).length : 1);

function weigh() {
  const { cage, start, chosen, mirror } = operation;
  const radius = store.tools.proportional && !cage.isObject ? store.tools.radius * cage.size : 0;
  const all = mirror ? T.withPartners(mirror, chosen) : chosen;
  operation.weights = T.weightsOf(start, all, radius, store.tools.falloff);
  operation.dirty = true;
}

store.on("tools", () => operation && weigh());

/** Takes where the pointer is now; `slow`: a tenth of its way counts, `flip`: steps are the other way about. */
export function follow(at, { slow = false, flip = false, time = performance.now() } = {}) {
  const { seen, pointer, kind, camera, pivot } = operation;
  if (!seen) {
    operation.seen = at; // begun by a key with the pointer elsewhere: it leads from where it comes in
    return;
  }
  const share = slow ? 0.1 : 1;
  const next = [pointer[0] + (at[0] - seen[0]) * share, pointer[1] + (at[1] - seen[1]) * share];
  if (kind === "rotate") operation.angle += T.angleOf(camera, pivot, seen, at, turningAxis()) * share;
  Object.assign(operation, { pointer: next, seen: at, flip, time, dirty: true });
}

/** The three axes that the operation under way goes by. */
export const axesNow = () => {
  const { way, camera, cage, start, chosen } = operation;
  return basisNow(way, camera, cage, start, chosen);
};

const isFree = () => operation.allowed.every(Boolean);

/** What a rotation turns about: the view's axis, the one axis allowed, or the normal of a plane. */
function turningAxis() {
  const { allowed, camera } = operation;
  if (isFree()) return times(camera.forward, -1);
  const single = allowed.filter(Boolean).length === 1 ? allowed.indexOf(true) : allowed.indexOf(false);
  return axesNow()[single];
}

/** A length or an amount in four digits. */
export const shown = (value) => (Math.abs(value) < 5e-5 ? "0" : value.toPrecision(4).replace(/(\.\d*?)0+$/, "$1").replace(/\.$/, ""));

function apply() {
  const { kind, cage, start, weights, pivot, mirror, side } = operation;
  const result = { move: moved, rotate: turned, scale: grown }[kind](start, weights, pivot);
  drag.update(mirror ? T.mirrored(cage.rest, start, result, mirror, side) : result, operation.time);
}

const isStepped = () => store.tools.snap !== Boolean(operation.flip) && !operation.typed.any;

function moved(start, weights, pivot) {
  const { camera, from, pointer, allowed, typed, cage } = operation;
  const basis = axesNow();
  const wanted = T.offsetOf(camera, pivot, from, pointer, basis, allowed);
  const step = isStepped() ? store.tools.step * cage.size : 0;
  let field = 0;
  let offset = [0, 0, 0];
  const parts = [];
  basis.forEach((axis, k) => {
    if (!allowed[k]) return;
    const free = typed.any ? 0 : T.snapped(dot(wanted, axis), step);
    const value = typed.value(field, free);
    parts.push(`${NAMES[k]} ${shown(value)}${typed.any && typed.at === field ? "▏" : ""}`);
    offset = add(offset, times(axis, value));
    field += 1;
  });
  operation.text = parts.join("   ");
  operation.offset = offset;
  return T.moved(start, weights, offset);
}

function turned(start, weights, pivot) {
  const { angle, typed } = operation;
  const degrees = typed.value(0, T.snapped((angle * 180) / Math.PI, isStepped() ? 100 * store.tools.step : 0));
  operation.text = `${shown(degrees)}°${typed.any ? "▏" : ""}`;
  return T.rotated(start, weights, pivot, unit(turningAxis()), (degrees * Math.PI) / 180);
}

function grown(start, weights, pivot) {
  const { camera, from, pointer, allowed, typed } = operation;
  const factor = typed.value(0, T.snapped(T.factorOf(camera, pivot, from, pointer), isStepped() ? store.tools.step : 0));
  operation.text = `× ${shown(factor)}${typed.any ? "▏" : ""}`;
  return T.scaled(start, weights, pivot, axesNow(), allowed.map((may) => (may ? factor : 1)));
}

/** Works out the newest places and sends them; once per animation frame. */
export function advance() {
  if (operation?.dirty) {
    operation.dirty = false;
    apply();
  }
  drag.flush();
}

/** Ends; the places stay, or go back. */
export function finish(cancel = false) {
  if (!operation) return;
  if (!cancel && operation.dirty) apply();
  operation = null;
  drag.end(cancel);
}

function constrain(k, isPlane) {
  const wanted = [0, 1, 2].map((i) => (i === k) !== isPlane);
  const isSame = wanted.every((may, i) => may === operation.allowed[i]) && !isFree();
  const first = store.tools.axes;
  const second = first === "local" ? "world" : "local";
  if (!isSame) Object.assign(operation, { allowed: wanted, way: first });
  else if (operation.way === first) operation.way = second;
  else Object.assign(operation, { allowed: [true, true, true], way: first });
  resetAngle();
}

/** Counts the pointer's turn anew, about the axis that is wanted now. */
function resetAngle() {
  const { camera, pivot, from, pointer, typed } = operation;
  operation.angle = operation.kind === "rotate" ? T.angleOf(camera, pivot, from, pointer, turningAxis()) : 0;
  const first = typed.fields[0];
  operation.typed = new T.Typed(fieldCount());
  operation.typed.fields[0] = first;
  operation.dirty = true;
}

/** Makes the radius of proportional editing larger or smaller by a factor. */
export function widen(factor) {
  store.setTool("radius", Math.max(0.005, Math.min(5, store.tools.radius * factor)));
}

/** Moves the pointer that leads the operation by some pixels (a rotation: degrees), as arrow keys do. */
function nudge([x, y], far) {
  const { pointer, camera, pivot } = operation;
  operation.pointer = [pointer[0] + x * far, pointer[1] + y * far];
  const sense = dot(turningAxis(), subtract(camera.eye, pivot)) < 0 ? 1 : -1;
  operation.angle += (sense * (x + y) * far * Math.PI) / 180;
  Object.assign(operation, { dirty: true, time: performance.now() });
}

const KINDS = { G: "move", R: "rotate", S: "scale" };
const NUDGES = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** Takes a key while an operation runs: all keys belong to it but those of the system. */
export function takeKey(event) {
  const { key } = event;
  const letter = key.length === 1 ? key.toUpperCase() : key;
  if (["Shift", "Control", "Alt", "Meta"].includes(key)) return;
  event.preventDefault();
  event.stopPropagation();
  operation.time = event.timeStamp;
  if (key === "Enter" || key === " ") finish();
  else if (key === "Escape") finish(true);
  else if (event.ctrlKey || event.metaKey || event.altKey) return;
  else if (NAMES.includes(letter)) constrain(NAMES.indexOf(letter), event.shiftKey);
  else if (letter === "O") store.setTool("proportional", !store.tools.proportional);
  else if (key === "PageUp") widen(1.1);
  else if (key === "PageDown") widen(1 / 1.1);
  else if (KINDS[letter] && KINDS[letter] !== operation.kind) {
    operation.kind = KINDS[letter];
    Object.assign(operation, { allowed: [true, true, true], way: store.tools.axes });
    resetAngle();
  } else if (NUDGES[key]) {
    nudge(NUDGES[key], event.shiftKey ? 1 : 10);
  } else if (operation.typed.take(key)) operation.dirty = true;
}

/** A line that says what runs, its amounts, and the keys that work now. */
export function describe() {
  const { kind, allowed, way, text } = operation;
  const names = NAMES.filter((_, k) => allowed[k]).join("");
  const along = isFree() ? "" : ` ${way} ${names}`;
  if (operation.cage.isObject) return [`${LABELS[kind]} ${operation.cage.name}${along}   ${text}`, "X Y Z: axis, with Shift: plane  ·  numbers  ·  Enter  ·  Esc"];
  const near = store.tools.proportional ? `  ·  wheel: radius ${shown(store.tools.radius)}` : "  ·  O: proportional";
  const alone = operation.mirror ? [...operation.chosen].filter((i) => operation.mirror.partners[i] < 0).length : 0;
  const without = alone ? ` (${alone} without a partner)` : "";
  const mirror = operation.mirror ? `  ·  mirrored in ${store.tools.symmetry.toUpperCase()}${without}` : "";
  return [`${LABELS[kind]}${along}   ${text}`, `X Y Z: axis, with Shift: plane${near}${mirror}  ·  numbers  ·  Enter  ·  Esc`];
}
