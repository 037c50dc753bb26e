// The objects of the scene as wholes: which one is active, its box that the hand moves, turns and scales, and clicks.

import { store } from "../core/store.js";
import { ask, guard, isCongested, nextSequence, request, send, when } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { projectAll } from "../geometry/camera.js";
import { BOX_EDGES, axesOf, cornersOf, followed, placedAll, viewWithin } from "../geometry/place.js";
import { bounds, distance } from "../geometry/vectors.js";

const INK = { active: "#ff9a1f", other: "rgba(190, 205, 225, 0.75)", rim: "rgba(0, 0, 0, 0.5)", label: "rgba(30, 38, 50, 0.75)" };
const IDENTITY = [
  [1, 0, 0, 0],
  [0, 1, 0, 0],
  [0, 0, 1, 0],
  [0, 0, 0, 1],
];

let hand = null; // the object that is being moved: {object, start, before, matrix, label, unsent, time, broken}
let waiting = null; // what the server said of objects meanwhile
let latest = null; // for latencies: called with (seq, time of the pointer event)

/** Calls latest(seq, time) with each place that was sent and the time of the pointer event that made it. */
export const whenSent = (listener) => (latest = listener);

export const objects = () => store.sections.objects ?? [];

/** The object that edits, cages and the hand act on, or null before there is one. */
export const activeObject = () => objects().find(({ id }) => id === store.sections.selection?.object) ?? null;

/** Whether the hand moves objects as wholes. */
export const isPlacing = () => store.sections.settings?.mode === "place";

/** Where an object is, as the hand has it. */
export const matrixOf = (object) => (object && hand?.object === object.id ? hand.matrix : (object?.matrix ?? IDENTITY));

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

/** What the scene waits for, in words, or null: a file that is read, the first picture of a new object. */
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

// -- The hand

/** Begins to move the active object. */
export function begin(box, label) {
  hand = { object: box.id, start: box.posed, before: box.matrix, matrix: box.matrix, label: label.slice(0, 100), unsent: false, time: 0 };
  start();
}

/** Tells the server that the hand moves an object. */
function start() {
  hand.broken = !send({ do: "place.begin", object: hand.object, label: hand.label });
}

/** Takes where the corners of the box should be now; the place goes to the server with the next `flush`. */
export function update(points, time) {
  if (hand) Object.assign(hand, { matrix: followed(hand.before, hand.start, points), unsent: true, time });
}

/** Whether a place waits to be sent although there is a connection. */
export const isWaiting = () => Boolean(hand?.unsent && !hand.broken);

/** Sends the newest place, once per animation frame, unless older ones still wait in the socket. */
export function flush(force = false) {
  if (!isWaiting() || (isCongested() && !force)) return;
  const seq = nextSequence();
  send({ do: "place.set", object: hand.object, matrix: hand.matrix, seq });
  hand.unsent = false;
  latest?.(seq, hand.time);
}

/** Ends: one step of undo, or none where it is cancelled. */
export function end(cancel = false) {
  if (!hand) return;
  if (!cancel) flush(true);
  if (cancel) hand.matrix = hand.before;
  const done = hand;
  const release = () => {
    if (hand !== done) return; // the hand moves on already
    hand = null;
    if (waiting) store.set("objects", waiting);
    waiting = null;
  };
  if (hand.broken) {
    if (!cancel) toast("Not connected to the editor: what was moved meanwhile is left out.", "warning");
    return release();
  }
  ask({ do: "place.end", cancel }).then(release, (error) => {
    release();
    if (!error.isLost) toast(error.message, "error");
  });
}

// While the hand moves an object, what the server says of its place is older than what is seen here
guard("objects", (content) => {
  if (hand) waiting = content;
  return hand !== null;
});
when("lost", () => {
  if (hand) hand.broken = true;
});
when("hello", () => {
  waiting = null; // older than what has just come
  if (!hand) return;
  start(); // the hand goes on
  hand.unsent = true;
});

/** Makes an object the active one. */
export function choose(id) {
  if (store.sections.selection?.object !== id) request({ do: "object.select", id });
}

/** Makes the object that a click meets the active one; the place is in shares of the picture. */
export async function chooseAt({ across, down, aspect }) {
  if (objects().length < 2) return;
  const found = await request({ do: "object.pick", across, down, aspect });
  if (typeof found?.object === "number") choose(found.object);
}

/** Whether a pixel lies in the box, on the screen, of the object that the hand may move. */
export function isOverBox(camera, x, y) {
  const box = handledBox();
  if (!box) return false;
  const [[left, top, near], [right, bottom]] = bounds(projectAll(camera, box.posed));
  return near > 0 && x >= left && x <= right && y >= top && y <= bottom;
}

// -- Drawing

function drawBox(context, camera, object, isActive) {
  const screen = projectAll(camera, cornersIn(object));
  context.beginPath();
  for (const [a, b] of BOX_EDGES) {
    if (screen[3 * a + 2] <= 0 || screen[3 * b + 2] <= 0) continue;
    context.moveTo(screen[3 * a], screen[3 * a + 1]);
    context.lineTo(screen[3 * b], screen[3 * b + 1]);
  }
  context.setLineDash(object.locked ? [4, 4] : []);
  for (const [color, width] of [[INK.rim, isActive ? 3.4 : 2.4], [isActive ? INK.active : INK.other, isActive ? 1.8 : 1]]) {
    context.strokeStyle = color;
    context.lineWidth = width;
    context.stroke();
  }
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

/** Draws the boxes and names of all objects that are shown, the active one last. */
export function drawBoxes(context, camera) {
  const active = activeObject();
  context.save();
  for (const object of objects()) if (object.visible && object !== active) drawBox(context, camera, object, false);
  if (active?.visible) drawBox(context, camera, active, true);
  context.restore();
}
