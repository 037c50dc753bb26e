// The things of the scene as wholes: which one is active, its box that the hand moves, turns and scales, and clicks.

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

let hand = null; // the thing that is being moved: {thing, start, before, matrix, label, unsent, time, broken}
let waiting = null; // what the server said of things meanwhile
let latest = null; // for latencies: called with (seq, time of the pointer event)

/** Calls latest(seq, time) with each place that was sent and the time of the pointer event that made it. */
export const whenSent = (listener) => (latest = listener);

export const things = () => store.sections.things ?? [];

/** The thing that edits, cages and the hand act on, or null before there is one. */
export const activeThing = () => things().find(({ id }) => id === store.sections.selection?.thing) ?? null;

/** Whether the hand moves things as wholes. */
export const isPlacing = () => store.sections.settings?.mode === "place";

/** Where a thing is, as the hand has it. */
export const matrixOf = (thing) => (thing && hand?.thing === thing.id ? hand.matrix : (thing?.matrix ?? IDENTITY));

const isStill = (matrix) => String(matrix) === String(IDENTITY);

/** A view of the scene in the coordinates of the active thing, in which its cages are. */
export function viewOfActive(view) {
  const matrix = matrixOf(activeThing());
  return isStill(matrix) ? view : viewWithin(matrix, view);
}

/** Flat points of the active thing in the scene. */
export function inScene(points) {
  const matrix = matrixOf(activeThing());
  return isStill(matrix) ? points : placedAll(matrix, points);
}

/** What the scene waits for, in words, or null: a file that is read, the first picture of a new thing. */
export function waitingFor() {
  const { doing, frame } = store.status;
  if (doing) return doing;
  return frame?.things && things().some(({ id }) => !frame.things.includes(id)) ? "First picture" : null;
}

/** The corners of a thing's box in the scene, flat. */
export const cornersIn = (thing) => placedAll(matrixOf(thing), cornersOf(thing.bounds));

/** Corners of all things that are shown, flat. */
export const sceneCorners = () => things().filter(({ visible }) => visible).flatMap((thing) => [...cornersIn(thing)]);

const ALL = new Set([0, 1, 2, 3, 4, 5, 6, 7]);

/** The box of the active thing as tools take cages: all of its corners are moved together; null where it is kept. */
export function handledBox() {
  const thing = activeThing();
  if (!thing?.visible || thing.locked) return null;
  const places = cornersIn(thing);
  const size = distance(...bounds(places)) || 1;
  const { id, name } = thing;
  const matrix = matrixOf(thing);
  return { id, name, visible: true, isThing: true, axes: axesOf(matrix), matrix, rest: places, posed: places, size, chosen: ALL };
}

// -- The hand

/** Begins to move the active thing. */
export function begin(box, label) {
  hand = { thing: box.id, start: box.posed, before: box.matrix, matrix: box.matrix, label: label.slice(0, 100), unsent: false, time: 0 };
  start();
}

/** Tells the server that the hand moves a thing. */
function start() {
  hand.broken = !send({ do: "place.begin", thing: hand.thing, label: hand.label });
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
  send({ do: "place.set", thing: hand.thing, matrix: hand.matrix, seq });
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
    if (waiting) store.set("things", waiting);
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

// While the hand moves a thing, what the server says of its place is older than what is seen here
guard("things", (content) => {
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

/** Makes a thing the active one. */
export function choose(id) {
  if (store.sections.selection?.thing !== id) request({ do: "thing.select", id });
}

/** Makes the thing that a click meets the active one; the place is in shares of the picture. */
export async function chooseAt({ across, down, aspect }) {
  if (things().length < 2) return;
  const found = await request({ do: "thing.pick", across, down, aspect });
  if (typeof found?.thing === "number") choose(found.thing);
}

/** Whether a pixel lies in the box, on the screen, of the thing that the hand may move. */
export function isOverBox(camera, x, y) {
  const box = handledBox();
  if (!box) return false;
  const [[left, top, near], [right, bottom]] = bounds(projectAll(camera, box.posed));
  return near > 0 && x >= left && x <= right && y >= top && y <= bottom;
}

// -- Drawing

function drawBox(context, camera, thing, isActive) {
  const screen = projectAll(camera, cornersIn(thing));
  context.beginPath();
  for (const [a, b] of BOX_EDGES) {
    if (screen[3 * a + 2] <= 0 || screen[3 * b + 2] <= 0) continue;
    context.moveTo(screen[3 * a], screen[3 * a + 1]);
    context.lineTo(screen[3 * b], screen[3 * b + 1]);
  }
  context.setLineDash(thing.locked ? [4, 4] : []);
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
  const label = thing.locked ? `${thing.name} (locked)` : thing.name;
  const [x, y] = [screen[3 * top], screen[3 * top + 1] - 14];
  const half = context.measureText(label).width / 2 + 6;
  context.fillStyle = isActive ? INK.active : INK.label;
  context.fillRect(x - half, y - 9, 2 * half, 18);
  context.fillStyle = isActive ? "#10141a" : "#ffffff";
  context.fillText(label, x, y);
}

/** Draws the boxes and names of all things that are shown, the active one last. */
export function drawBoxes(context, camera) {
  const active = activeThing();
  context.save();
  for (const thing of things()) if (thing.visible && thing !== active) drawBox(context, camera, thing, false);
  if (active?.visible) drawBox(context, camera, active, true);
  context.restore();
}
