// The canvas: the server's picture, the cages over it, the gizmo; drawn when something has changed, at display rate.

import { STARTED_ANEW, store } from "../core/store.js";
import { ask, nextSequence, send, when } from "../core/connection.js";
import { makeCamera, pixelAt, project, projectAll } from "../geometry/camera.js";
import { surfacePoint } from "../geometry/pick.js";
import { mean, point } from "../geometry/vectors.js";
import * as C from "./cages.js";
import * as D from "./draw.js";
import { drawCompass, drawGizmo, drawGuides, makeCompass, makeGizmo } from "./gizmo.js";
import { drawGrid } from "./grid.js";
import * as operation from "./operation.js";
import * as subject from "./subject.js";
import * as objects from "./objects.js";
import { scaleOf } from "../geometry/place.js";

const MAX_LATENCIES = 1000;
const MAX_SIDE = 4096; // of a picture, pixels
const CALM = 250; // ms between changes of the status' figures
const FIRST_PICTURE = ["The first picture is being made …", "The first time on a computer this takes up to a minute."];
const REST = 180; // ms after the last step of the view until it counts as resting

let canvas = null;
let context = null;
let width = 1; // CSS pixels
let height = 1;
let ratio = 1;
let scheduled = false;
let picture = null; // {header, bitmap, map, camera}: the newest one
let unshown = false; // whether the newest picture was not drawn yet
let view = null; // as this page has it now
let viewHeld = false; // the server's view is not taken while a drag moves this one
let unsentView = false;
let restTimer = 0;
let calmUntil = 0;
let drawnWait = null; // what the scene waited for when it was drawn last
const pending = new Map(); // number of a pose message -> time of its pointer event
const shownTimes = []; // of the last pictures
const hiddenCache = new Map(); // edit -> {points, picture, result}

/** What the pointer and its gestures ask to be drawn. */
export const overlay = { hover: null, handle: null, ball: null, region: null, preview: null, brush: null };

/** What tools of their own files draw over the cages: functions of (context, camera). */
export const drawings = [];

export const viewport = {
  latencies: [], // ms from a pointer's event to the picture of its pose, the last 1000
  latenciesOrNewer: [], // the same for poses that a newer one overtook: to the picture of that one
  project(edit, vertex) {
    const cage = C.cages.get(edit);
    return project(camera(), point(C.places(cage), vertex)).slice(0, 2);
  },
  overlay,
  get canvas() {
    return canvas;
  },
  get view() {
    return view;
  },
  get picture() {
    return picture?.header ?? null;
  },
  get operation() {
    return operation.current();
  },
  hidden: (edit) => [...hiddenOf(C.cages.get(edit)).vertices],
  handles: () => gizmo().map(({ name, line, area, disc, ring }) => ({ name, line, area, disc, ring })),
};

/** The view that is drawn: this page's, or the film's while it plays. */
function viewNow() {
  const isPlaying = store.sections.playback?.playing && !viewHeld;
  return (isPlaying && picture?.header.view) || view || FALLBACK;
}

/** The camera of the scene, in which objects stand. */
export const sceneCamera = () => makeCamera(viewNow(), width, height);

/** The camera that what is edited is drawn with: cages in the coordinates of their object, boxes in those of the scene. */
export const camera = () => (objects.isPlacing() ? sceneCamera() : makeCamera(objects.viewOfActive(viewNow()), width, height));
const FALLBACK = { eye: [3, 3, 3], target: [0, 0, 0], up: [0, 0, 1], fov: 45 };

export const getView = () => view ?? FALLBACK;
export const getSize = () => [width, height];

export function requestDraw() {
  if (scheduled || !canvas) return;
  scheduled = true;
  requestAnimationFrame(onFrame);
}

/** Shows another view at once and sends it, once per animation frame; it counts as resting a moment later. */
export function setView(next) {
  view = next;
  viewHeld = true;
  unsentView = true;
  clearTimeout(restTimer);
  restTimer = setTimeout(restView, REST);
  requestDraw();
}

function sendView(moving) {
  unsentView = false;
  return { do: "view", ...view, seq: nextSequence(), moving };
}

function restView() {
  if (!store.status.connected) return; // sent after the next hello
  const mine = view;
  ask(sendView(false))
    .catch(() => undefined)
    .then(() => {
      if (view === mine) viewHeld = false;
    });
}

function onFrame() {
  operation.advance();
  if (unsentView && store.status.connected) send(sendView(true));
  scheduled = false;
  draw();
  if (subject.isWaiting()) requestDraw();
}

export const screenOf = (cage) => projectAll(camera(), C.places(cage));

/** The place of the matter that the last picture shows at a pixel of the canvas, or null. */
export function surfaceAt([x, y]) {
  const { map, camera: seen } = picture ?? {};
  return map ? surfacePoint(map, seen, (x / width) * map.width, (y / height) * map.height) : null;
}

/** Which vertices and pieces of edges of a cage the last picture hides. */
export function hiddenOf(cage) {
  const points = C.places(cage);
  const kept = hiddenCache.get(cage.id);
  if (kept?.points === points && kept.picture === picture && kept.faces === cage.faces) return kept.result;
  const result = D.findHidden(cage, points, pictureOfActive());
  hiddenCache.set(cage.id, { points, picture, faces: cage.faces, result });
  return result;
}

/** The picture's distances in the coordinates of the active object. */
function pictureOfActive() {
  if (!picture?.map) return picture;
  const scale = scaleOf(objects.matrixOf(objects.activeObject()));
  const { width: w, height: h, near, far } = picture.map;
  const map = { ...picture.map, near: near / scale, far: far / scale };
  return { map, camera: makeCamera(objects.viewOfActive(picture.header.view), w, h) };
}

/** Where the gizmo stands: the middle of the selection, or of an object's box; null without one. */
function pivotNow() {
  const cage = subject.activeCage();
  if (!cage?.visible || !subject.selected().size) return null;
  return mean(subject.places(cage), [...subject.selected()]);
}

/** The handles of the present tool at the selection. */
export function gizmo() {
  const isPlacing = objects.isPlacing();
  const pivot = (store.tools.cage || isPlacing) && !operation.current() && pivotNow();
  if (!pivot) return [];
  const cage = subject.activeCage();
  const basis = operation.basisNow(store.tools.axes, camera(), cage, subject.places(cage), subject.selected());
  const { tool } = store.tools;
  return makeGizmo(isPlacing && tool === "select" ? "move" : tool, camera(), pivot, basis);
}

export const compass = () => makeCompass(sceneCamera(), width);

/** Where the picture belongs; one of an older view goes and grows with its target, until the next one comes. */
function pictureBox(now) {
  const { bitmap, header } = picture;
  const wide = (height * bitmap.width) / bitmap.height;
  const old = makeCamera(header.view, wide, height);
  const [x, y, far] = project(old, header.view.target);
  const [nowX, nowY, nowFar] = project(now, header.view.target);
  const scale = (now.focal / nowFar) * (far / old.focal);
  if (!(nowFar > 0 && scale > 0.02 && scale < 50)) return [(width - wide) / 2, 0, wide, height];
  return [nowX - x * scale, nowY - y * scale, wide * scale, height * scale];
}

function draw() {
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  const scene = sceneCamera();
  const now = camera();
  if (picture?.bitmap) context.drawImage(picture.bitmap, ...pictureBox(scene));
  const field = store.sections.session?.field;
  if (store.tools.grid && field) drawGrid(context, scene, field, picture);
  if (objects.isPlacing()) {
    objects.drawBoxes(context, scene);
    drawGizmo(context, gizmo(), overlay.handle);
  } else if (store.tools.cage) drawCages(now);
  for (const drawing of drawings) drawing(context, now);
  drawCompass(context, compass(), overlay.ball);
  if (overlay.region) D.drawRegion(context, overlay.region.shape, overlay.region.path, store.tools.brush);
  const running = operation.current();
  if (running) drawOperation(now, running);
  else if (store.status.refused) D.drawHint(context, [STARTED_ANEW], height);
  else if (!store.status.connected) D.drawHint(context, ["No connection to the server; trying again …"], height);
  else if (!picture) D.drawHint(context, FIRST_PICTURE, height);
  else if ((drawnWait = objects.waitingFor())) D.drawHint(context, [`${drawnWait} …`], height);
  if (unshown) onShown();
}

function drawCages(now) {
  const current = C.activeCage();
  for (const cage of C.visibleCages()) if (cage !== current) D.drawOther(context, now, cage, C.places(cage));
  if (!current?.visible) return;
  const axis = operation.mirrorAxis();
  if (axis >= 0) D.drawMirror(context, now, current, axis);
  D.drawCage(context, now, current, C.places(current), {
    screen: screenOf(current),
    hidden: hiddenOf(current),
    selected: overlay.preview ?? C.selected(),
    active: C.activeVertex(),
    mode: C.pickMode(),
    hover: overlay.hover?.cage === current ? overlay.hover : null,
    check: store.sections.check,
    weights: operation.current()?.weights,
  });
  drawGizmo(context, gizmo(), overlay.handle);
}

function drawOperation(now, running) {
  const pivot = pivotNow() ?? running.pivot;
  if (!running.allowed.every(Boolean)) drawGuides(context, now, running.pivot, operation.axesNow(), running.allowed);
  if (store.tools.proportional && !running.cage.isObject) {
    const [x, y] = project(now, pivot);
    D.drawCircle(context, x, y, (store.tools.radius * running.cage.size) / pixelAt(now, pivot));
  }
  D.drawHint(context, operation.describe(), height);
}

/** Marks the newest picture as shown: flow control, latencies, figures. */
function onShown() {
  unshown = false;
  const { header } = picture;
  send({ do: "seen", frame: header.frame });
  const time = performance.now();
  const applied = header.applied?.[store.status.client] ?? 0;
  let last = null;
  for (const [seq, begun] of pending) {
    if (seq > applied) continue;
    pending.delete(seq);
    last = time - begun;
    (seq === applied ? viewport.latencies : viewport.latenciesOrNewer).push(last);
  }
  for (const kept of [viewport.latencies, viewport.latenciesOrNewer]) {
    if (kept.length > MAX_LATENCIES) kept.splice(0, kept.length - MAX_LATENCIES);
  }
  shownTimes.push(time);
  while (shownTimes[0] < time - 1000) shownTimes.shift();
  store.status.frame = header;
  if (last !== null) store.status.latency = last;
  store.status.fps = shownTimes.length;
  if (time < calmUntil) return;
  calmUntil = time + CALM;
  store.setStatus({});
  setTimeout(() => store.setStatus({}), CALM); // so that the last picture's figures are shown too
}

function resize() {
  const box = canvas.getBoundingClientRect();
  ratio = window.devicePixelRatio || 1;
  width = Math.max(1, box.width);
  height = Math.max(1, box.height);
  const [w, h] = [Math.max(1, Math.round(width * ratio)), Math.max(1, Math.round(height * ratio))];
  if (canvas.width !== w || canvas.height !== h) {
    canvas.width = w;
    canvas.height = h;
    sendSize();
  }
  requestDraw();
}

/** The page's colour in the dark theme, as "#rrggbb": a field's white or black is hard on the eyes there. Else null. */
function groundNow() {
  const parts = getComputedStyle(document.body).backgroundColor.match(/\d+/g).slice(0, 3).map(Number);
  return Math.max(...parts) < 128 ? `#${parts.map((part) => part.toString(16).padStart(2, "0")).join("")}` : null;
}

/** Sends how large the picture should be, and what is behind the scene in it. */
export function sendSize() {
  const shrink = Math.min(1, MAX_SIDE / Math.max(canvas.width, canvas.height));
  const [w, h] = [canvas.width, canvas.height].map((side) => Math.round(side * shrink));
  send({ do: "size", width: w, height: h, ground: groundNow() });
}

/** Watches for a change of the device's pixel ratio, which causes no resize event. */
function watchRatio() {
  const query = matchMedia(`(resolution: ${window.devicePixelRatio}dppx)`);
  query.addEventListener("change", () => (resize(), watchRatio()), { once: true });
}

export function start(element) {
  canvas = element;
  context = canvas.getContext("2d");
  new ResizeObserver(resize).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", sendSize);
  watchRatio();
  resize();
}

when("sent", (seq, time) => pending.set(seq, time));
C.whenChanged(requestDraw);
for (const name of ["tools", "playback", "settings", "session", "objects"]) store.on(name, requestDraw);
store.on("status", () => (store.status.connected && drawnWait === objects.waitingFor()) || requestDraw());

store.on("view", (content) => {
  if (!viewHeld) view = content;
  requestDraw();
});

when("hello", () => {
  pending.clear();
  sendSize();
  if (viewHeld) restView();
  requestDraw();
});

when("frame", ({ header, bitmap, depth }) => {
  picture?.bitmap?.close();
  const { near, far, width: w, height: h } = header.depth ?? {};
  const map = depth && header.depth ? { width: w, height: h, near, far, data: depth } : null;
  picture = { header, bitmap, map, camera: map && makeCamera(header.view, w, h) };
  unshown = true;
  requestDraw();
});
