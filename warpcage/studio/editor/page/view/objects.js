// The objects of the scene as wholes: which one is active, its box, which drags move, rotate and scale, and clicks.

import { store } from "../core/store.js";
import { ask, emit, guard, isCongested, nextSequence, request, send, when } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { projectAll } from "../geometry/camera.js";
import { BOX_EDGES, axesOf, cornersOf, followed, placedAll, viewWithin } from "../geometry/place.js";
import { bounds, distance } from "../geometry/vectors.js";
import { linePath, stroke } from "./draw.js";

const INK = { active: "#ff9a1f", other: "rgba(190, 205, 225, 0.75)", rim: "rgba(0, 0, 0, 0.5)", label: "rgba(30, 38, 50, 0.75)" };
const IDENTITY = [
  [1, 0, 0, 0],
  [0, 1, 0, 0],
  [0, 0, 1, 0],
  [0, 0, 0, 1],
];

let dragged = null; // the object that is being moved: {object, start, before, matrix, label, unsent, time, broken}
let waiting = null; // what the server said of objects meanwhile

export const objects = () => store.sections.objects ?? [];

export const activeObject = () => objects().find(({ id }) => id === store.sections.selection?.object) ?? null;

/** Whether drags move objects as wholes. */
export const isPlacing = () => store.sections.settings?.mode === "place";

/** Where an object is, as this page has it now. */
export const matrixOf = (object) => (object && dragged?.object === object.id ? dragged.matrix : (object?.matrix ?? IDENTITY));

const isStill = (matrix) => String(matrix) === String(IDENTITY);

/** A view of the scene in the coordinates of the active object, in which its cages are. */
export function viewOfActive(view) {
  const matrix = matrixOf(activeObject());
  return isStill(matrix) ? view : viewWithin(matrix, view);
}

/** Flat points of the active object in the scene. */
export function inScene(points) {
  const matrix = matrixOf(activeObject());
  return isStill(matrix) ? points : placedAll(matrix, points);
}

/** What the scene waits for, as text, or null: a file that is read, the first picture of a new object. */
export function waitingFor() {
  const { doing, frame } = store.status;
  if (doing) return doing;
  return frame?.objects && objects().some(({ id }) => !frame.objects.includes(id)) ? "First picture" : null;
}

/** The corners of an object's box in the scene, flat. */
export const cornersIn = (object) => placedAll(matrixOf(object), cornersOf(object.bounds));

/** Corners of all objects that are shown, flat. */
export const sceneCorners = () => objects().filter(({ visible }) => visible).flatMap((object) => [...cornersIn(object)]);

const ALL = new Set([0, 1, 2, 3, 4, 5, 6, 7]);

/** The box of the active object as tools take cages: all of its corners are moved together; null where it is kept. */
export function handledBox() {
  const object = activeObject();
  if (!object?.visible || object.locked) return null;
  const places = cornersIn(object);
  const size = distance(...bounds(places)) || 1;
  const { id, name } = object;
  const matrix = matrixOf(object);
  return { id, name, visible: true, isObject: true, axes: axesOf(matrix), matrix, rest: places, posed: places, size, chosen: ALL };
}

// -- Dragging

export function begin(box, label) {
  dragged = { object: box.id, start: box.posed, before: box.matrix, matrix: box.matrix, label: label.slice(0, 100), unsent: false, time: 0 };
  start();
}

function start() {
  dragged.broken = !send({ do: "place.begin", object: dragged.object, label: dragged.label });
}

/** Takes where the corners of the box should be now; the place goes to the server with the next `flush`. */
export function update(points, time) {
  if (dragged) Object.assign(dragged, { matrix: followed(dragged.before, dragged.start, points), unsent: true, time });
}

/** Whether a place waits to be sent although there is a connection. */
export const isWaiting = () => Boolean(dragged?.unsent && !dragged.broken);

/** Sends the newest place, once per animation frame, unless older ones still wait in the socket. */
export function flush(force = false) {
  if (!isWaiting() || (isCongested() && !force)) return;
  const seq = nextSequence();
  send({ do: "place.set", object: dragged.object, matrix: dragged.matrix, seq });
  dragged.unsent = false;
  emit("sent", seq, dragged.time);
}

/** Ends: one step of undo, or none where it is cancelled. */
export function end(cancel = false) {
  if (!dragged) return;
  if (!cancel) flush(true);
  if (cancel) dragged.matrix = dragged.before;
  const done = dragged;
  const release = () => {
    if (dragged !== done) return; // another drag has begun
    dragged = null;
    if (waiting) store.set("objects", waiting);
    waiting = null;
  };
  if (dragged.broken) {
    if (!cancel) toast("Not connected to the editor: what was moved meanwhile is left out.", "warning");
    return release();
  }
  ask({ do: "place.end", cancel }).then(release, (error) => {
    release();
    if (!error.isLost) toast(error.message, "error");
  });
}

// While an object is dragged, what the server has of its place is older than what is seen here
guard("objects", (content) => {
  if (dragged) waiting = content;
  return dragged !== null;
});
when("lost", () => {
  if (dragged) dragged.broken = true;
});
when("hello", () => {
  waiting = null; // older than what has just come
  if (!dragged) return;
  start(); // the drag goes on
  dragged.unsent = true;
});

export function choose(id) {
  if (store.sections.selection?.object !== id) request({ do: "object.select", id });
}

/** Makes the object that a click meets the active one; the place is in shares of the picture. */
export async function chooseAt({ across, down, aspect }) {
  if (objects().length < 2) return;
  const found = await request({ do: "object.pick", across, down, aspect });
  if (typeof found?.object === "number") choose(found.object);
}

/** Whether a pixel lies in the box, on the screen, of the object that may be dragged. */
export function isOverBox(camera, x, y) {
  const box = handledBox();
  if (!box) return false;
  const [[left, top, near], [right, bottom]] = bounds(projectAll(camera, box.posed));
  return near > 0 && x >= left && x <= right && y >= top && y <= bottom;
}

// -- Drawing

function drawBox(context, camera, object, isActive) {
  const screen = projectAll(camera, cornersIn(object));
  const [path, dash] = [linePath(screen, BOX_EDGES), object.locked ? [4, 4] : []];
  stroke(context, path, INK.rim, isActive ? 3.4 : 2.4, dash);
  stroke(context, path, isActive ? INK.active : INK.other, isActive ? 1.8 : 1, dash);
  let top = -1;
  for (let i = 0; i < 8; i += 1) if (screen[3 * i + 2] > 0 && (top < 0 || screen[3 * i + 1] < screen[3 * top + 1])) top = i;
  if (top < 0) return;
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  const label = object.locked ? `${object.name} (locked)` : object.name;
  const [x, y] = [screen[3 * top], screen[3 * top + 1] - 14];
  const half = context.measureText(label).width / 2 + 6;
  context.fillStyle = isActive ? INK.active : INK.label;
  context.fillRect(x - half, y - 9, 2 * half, 18);
  context.fillStyle = isActive ? "#10141a" : "#ffffff";
  context.fillText(label, x, y);
}

export function drawBoxes(context, camera) {
  const active = activeObject();
  context.save();
  for (const object of objects()) if (object.visible && object !== active) drawBox(context, camera, object, false);
  if (active?.visible) drawBox(context, camera, active, true);
  context.restore();
}
