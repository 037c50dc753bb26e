// The pointer over the canvas: mouse, pen and fingers. One gesture at a time.

import { keep, kept, store } from "../core/store.js";
import { button, el, segments, setText } from "../core/controls.js";
import * as C from "./cages.js";
import { ballAt, handleAt } from "./gizmo.js";
import * as operation from "./operation.js";
import * as S from "./selecting.js";
import { isBrush } from "../tools/brush.js";
import * as objects from "./objects.js";
import { camera, compass, gizmo, overlay, requestDraw, surfaceAt } from "./viewport.js";

const MOUSE = { reach: 11, slack: 4 }; // pixels: how near counts as on it, how far counts as a drag
const FINGER = { reach: 24, slack: 8 };
const TURN = 0.008; // radians per pixel
const HINTED = "warpcage.hinted"; // whether this browser's user knows how to turn the view

const MAX_PLACES = 24; // of a stroke that an object is looked for by

let canvas = null;
let toolCursor = null; // of the tool that is on, where the pointer is
let gesture = null; // {kind: "press" | "turn" | "pan" | "zoom" | "region" | "tool" | "transform" | "pinch", ...}
const fingers = new Map(); // pointer id -> [x, y]
let wanted = null; // takes the place of the next press, or null where Escape ends the waiting

/** Tools of their own files by their names in the store: {click(at, way), begin?(at, reach), drag?(at, details), end?(isKept),
 *  hover?(at, reach) that gives a cursor}. One that has no `drag` turns the view by drags. */
export const pointerTools = new Map();
const toolNow = () => pointerTools.get(store.tools.tool) ?? null;
const isPainting = () => isBrush() && !toolNow();

/** The next place that is clicked, or with the brush the places of its next stroke that show matter: shares of the
 *  picture across and down, and its aspect; null after Escape. */
export function nextPlace() {
  wanted?.(null);
  return new Promise((resolve) => {
    const leave = (event) => event.key === "Escape" && wanted?.(null);
    addEventListener("keydown", leave, true);
    canvas.classList.add("choosing");
    wanted = (place) => {
      wanted = null;
      removeEventListener("keydown", leave, true);
      canvas.classList.remove("choosing");
      resolve(place);
    };
  });
}

/** Says how the mouse turns the view, until it has done so in this browser, or the hint is closed. */
function showHint() {
  const text = "Orbit: drag with the right button, or with Alt held. Wheel: zoom. The left button selects.";
  const close = button({ id: "turn-hint-close", label: "Close this hint", icon: "close", kind: "flat", onClick: hideHint });
  document.getElementById("notes")?.prepend(el("p", { id: "turn-hint", class: "hint" }, el("span", {}, text), close));
}

function hideHint() {
  document.getElementById("turn-hint")?.remove();
  keep(HINTED, "yes");
}

const FINGER_HINTS = {
  orbit: "A drag orbits, a tap selects. Two fingers pan and zoom.",
  select: "A drag selects, or moves what is selected. Two fingers pan and zoom.",
};

/** What a finger does by a drag: a switch that shows where the screen is touched. */
function startFinger() {
  const mode = segments({
    id: "finger",
    label: "What a finger does by a drag",
    options: [
      ["orbit", "Orbit", "A drag of one finger orbits the view"],
      ["select", "Select", "A drag of one finger selects"],
    ],
    value: store.tools.finger,
    onChange: (value) => store.setTool("finger", value),
  });
  const hint = el("span", { class: "note", id: "finger-hint", role: "status" });
  const root = el("div", { id: "finger-mode", class: "hint" }, mode.root, hint);
  document.getElementById("notes")?.append(root);
  const coarse = matchMedia("(pointer: coarse)");
  let isTouched = false;
  const show = () => {
    root.hidden = !(isTouched || coarse.matches) || objects.isPlacing() || isPainting() || Boolean(toolNow());
    mode.set(store.tools.finger);
    setText(hint, FINGER_HINTS[store.tools.finger]);
    if (isTouched || coarse.matches) document.getElementById("turn-hint")?.remove(); // it is about the mouse
  };
  const onTouch = (event) => {
    if (event.pointerType !== "touch") return;
    isTouched = true;
    removeEventListener("pointerdown", onTouch, true);
    show();
  };
  addEventListener("pointerdown", onTouch, true);
  coarse.addEventListener("change", show);
  store.follow(["tools", "settings"], show);
}

const placeOf = (event) => {
  const box = canvas.getBoundingClientRect();
  return [event.clientX - box.left, event.clientY - box.top];
};
/** A place as shares of the picture across and down, and the picture's aspect. */
export function sharesOf([x, y]) {
  const { width, height } = canvas.getBoundingClientRect();
  return { across: x / width, down: y / height, aspect: width / height };
}
const wayOf = (event) => (event.shiftKey ? "add" : event.ctrlKey || event.metaKey ? "remove" : "replace");
const tolerances = (event) => (event.pointerType === "touch" ? FINGER : MOUSE);
const details = (event) => ({ slow: event.shiftKey, flip: event.ctrlKey || event.metaKey, time: event.timeStamp });

function onDown(event) {
  canvas.focus({ preventScroll: true });
  const at = placeOf(event);
  S.pointer.at = at;
  try {
    canvas.setPointerCapture(event.pointerId);
  } catch {
    // a pointer that is gone already
  }
  if (event.pointerType === "touch") {
    fingers.set(event.pointerId, at);
    if (fingers.size === 2) return beginPinch();
    if (fingers.size > 2) return;
  }
  if (gesture) return;
  event.preventDefault();
  if (wanted && event.button === 0 && !event.altKey) {
    if (isPainting()) return beginStroke(event, at, "wanted");
    return wanted(placesOf([...at]));
  }
  if (operation.current()) {
    if (event.button === 0) operation.finish();
    else if (event.button === 2) operation.finish(true);
    requestDraw();
    return;
  }
  if ([1, 2].includes(event.button) || (event.button === 0 && event.altKey && !isPainting())) {
    const kind = event.shiftKey ? "pan" : event.ctrlKey || event.metaKey ? "zoom" : "turn";
    gesture = { kind, at, id: event.pointerId };
  } else if (event.button === 0) press(event, at);
  showCursor();
}

function press(event, at) {
  const { reach } = tolerances(event);
  const ball = ballAt(compass(), ...at);
  if (ball) {
    S.lookAlong(ball.direction);
    return;
  }
  const handle = handleAt(gizmo(), ...at, reach);
  if (handle) {
    beginTransform(event, at, handle);
    return;
  }
  const tool = toolNow();
  if (tool) {
    gesture = { kind: "tool", tool, at, from: at, id: event.pointerId, way: wayOf(event) };
    tool.begin?.(at, reach);
    return;
  }
  if (isPainting()) return beginStroke(event, at, event.altKey || wayOf(event) === "remove" ? "remove" : "add");
  const element = S.elementAt(...at, reach);
  gesture = { kind: "press", at, id: event.pointerId, element, way: wayOf(event), path: [...at] };
}

/** A stroke of the brush; `way`: "add", "remove", or "wanted" where `nextPlace` waits for its places. */
function beginStroke(event, at, way) {
  gesture = { kind: "region", shape: "brush", at, id: event.pointerId, way, path: [...at] };
  extendRegion(at);
  requestDraw();
}

/** Places of a path as `nextPlace` gives them. */
function placesOf(path) {
  const { width, height } = canvas.getBoundingClientRect();
  const shares = [];
  for (let i = 0; i < path.length; i += 2) shares.push([path[i] / width, path[i + 1] / height]);
  if (shares.length === 1) return { across: shares[0][0], down: shares[0][1], aspect: width / height };
  const seen = shares.filter(([across, down]) => surfaceAt([across * width, down * height]));
  const by = Math.max(1, Math.ceil(seen.length / MAX_PLACES));
  return { places: (seen.length ? seen : shares).filter((_, i) => i % by === 0), aspect: width / height };
}

/** What a drag of a tool of its own file does. */
function dragTool(event, at) {
  const { tool, from } = gesture;
  const [dx, dy] = [at[0] - from[0], at[1] - from[1]];
  gesture.isDrag ||= Math.hypot(dx, dy) > tolerances(event).slack;
  if (gesture.isDrag && tool.drag) tool.drag(at, details(event));
  else if (gesture.isDrag) gesture = { ...gesture, kind: "turn", at };
}

function beginTransform(event, at, handle) {
  const begun = operation.begin(handle.kind, { camera: camera(), at, allowed: handle.allowed, source: "pointer" });
  if (begun) gesture = { kind: "transform", id: event.pointerId };
  overlay.hover = null;
  requestDraw();
}

/** What a press becomes once the pointer has moved: a move of the selection, a turn of the view, or a region. */
function decide(event, at) {
  const { element, way } = gesture;
  if (objects.isPlacing()) {
    if (objects.isOverBox(camera(), ...gesture.at)) {
      beginTransform(event, gesture.at, { kind: "move", allowed: [true, true, true] });
      if (gesture.kind === "transform") operation.follow(at, details(event));
    } else gesture = { ...gesture, kind: "turn", at };
    return;
  }
  const isSelected = element && element.cage === C.activeCage() && element.vertices.every((i) => C.selected().has(i));
  // An unselected face is ground to draw a rectangle on; beneath a finger, what is not selected is ground to turn on
  const isThin = element?.mode === "vertex" && event.pointerType !== "touch";
  if (element && way !== "remove" && (isSelected || (isThin && way === "replace"))) {
    if (!isSelected) S.clicked(element, "replace");
    beginTransform(event, gesture.at, { kind: "move", allowed: [true, true, true] });
    if (gesture.kind === "transform") operation.follow(at, details(event));
    return;
  }
  if (event.pointerType === "touch" && store.tools.finger === "orbit") {
    gesture = { ...gesture, kind: "turn", at };
    return;
  }
  gesture.kind = "region";
  gesture.shape = store.tools.pick;
}

function onMove(event) {
  const at = placeOf(event);
  if (fingers.has(event.pointerId)) fingers.set(event.pointerId, at);
  S.pointer.at = at;
  if (gesture?.kind === "pinch") return movePinch();
  if (gesture && event.pointerId !== gesture.id) return;
  if (!gesture) {
    if (operation.current()) {
      operation.follow(at, details(event));
      requestDraw();
    } else if (event.pointerType !== "touch") hover(at, tolerances(event).reach);
    showBrush(event, at);
    return;
  }
  const [dx, dy] = [at[0] - gesture.at?.[0], at[1] - gesture.at?.[1]];
  if (gesture.kind === "press" && Math.hypot(dx, dy) > tolerances(event).slack) decide(event, at);
  if (gesture.kind === "turn") S.turnBy(dx * TURN, dy * TURN);
  else if (gesture.kind === "pan") S.panBy(dx, dy);
  else if (gesture.kind === "zoom") S.zoomBy(Math.exp(dy * 0.006));
  else if (gesture.kind === "transform") operation.follow(at, details(event));
  else if (gesture.kind === "region") extendRegion(at);
  else if (gesture.kind === "tool") dragTool(event, at);
  showBrush(event, at);
  if (["turn", "pan", "zoom"].includes(gesture.kind)) gesture.at = at;
  requestDraw();
}

function extendRegion(at) {
  const { path, shape, way } = gesture;
  const least = shape === "brush" ? Math.max(1, store.tools.brush / 8) : 1;
  if (Math.hypot(at[0] - path.at(-2), at[1] - path.at(-1)) >= least) path.push(...at);
  overlay.region = { shape, path, way };
  overlay.preview = way === "wanted" ? null : (S.regionSelection(overlay.region)?.vertices ?? null);
  overlay.hover = null;
}

function onUp(event) {
  fingers.delete(event.pointerId);
  if (gesture?.kind === "pinch") {
    if (fingers.size < 2) gesture = null;
    return;
  }
  if (!gesture || event.pointerId !== gesture.id) return;
  const ended = gesture;
  gesture = null;
  if (ended.kind === "press" && objects.isPlacing()) objects.chooseAt(sharesOf(ended.at));
  else if (ended.kind === "press") {
    S.clicked(ended.element, ended.way);
    if (!ended.element && ended.way === "replace") objects.chooseAt(sharesOf(ended.at));
  }
  else if (ended.kind === "transform") operation.finish();
  else if (ended.kind === "turn") hideHint();
  else if (ended.kind === "tool") {
    if (ended.isDrag) ended.tool.end(true);
    else ended.tool.click(placeOf(event), ended.way);
  } else if (ended.way === "wanted") wanted?.(placesOf(ended.path));
  else if (ended.kind === "region") {
    const made = overlay.region && S.regionSelection(overlay.region);
    if (made) C.select(made.cage.id, made.vertices, { active: -1 });
  }
  Object.assign(overlay, { region: null, preview: null });
  hover(placeOf(event), tolerances(event).reach);
  requestDraw();
}

/** Leaves a gesture without its effect: the system took the pointer, Escape, or a second finger. */
function abandon() {
  if (gesture?.kind === "transform") operation.finish(true);
  if (gesture?.kind === "tool") gesture.tool.end?.(false);
  gesture = null;
  Object.assign(overlay, { region: null, preview: null, hover: null, brush: null });
  requestDraw();
}

function onCancel(event) {
  fingers.delete(event.pointerId);
  abandon();
}

const spread = ([a, b]) => ({ middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], far: Math.max(10, Math.hypot(a[0] - b[0], a[1] - b[1])) });

function beginPinch() {
  abandon();
  gesture = { kind: "pinch", ...spread([...fingers.values()]) };
}

function movePinch() {
  const now = spread([...fingers.values()]);
  S.zoomBy(gesture.far / now.far);
  S.panBy(now.middle[0] - gesture.middle[0], now.middle[1] - gesture.middle[1]);
  Object.assign(gesture, now);
}

function onWheel(event) {
  event.preventDefault();
  const lines = event.deltaMode === 1 ? 33 : event.deltaMode === 2 ? 400 : 1;
  const way = Math.max(-200, Math.min(200, event.deltaY * lines));
  if (operation.current()) {
    if (store.tools.proportional) operation.widen(Math.exp(-way * 0.001));
    requestDraw();
    return;
  }
  S.zoomBy(Math.exp(way * (event.ctrlKey ? 0.008 : 0.0015)));
}

function showBrush(event, at) {
  const place = isPainting() && event.pointerType !== "touch" ? at : null;
  if (place || overlay.brush) requestDraw();
  overlay.brush = place;
}

function hover([x, y], reach) {
  const ball = ballAt(compass(), x, y);
  const tool = ball ? null : toolNow();
  const handle = ball || tool ? null : handleAt(gizmo(), x, y, reach);
  const element = ball || handle || tool || isPainting() ? null : S.elementAt(x, y, reach);
  toolCursor = tool?.hover?.([x, y], reach) ?? null;
  if (tool) showCursor();
  const before = overlay.hover;
  const isSame = before?.cage === element?.cage && before?.number === element?.number && before?.mode === element?.mode;
  if (isSame && overlay.handle?.name === handle?.name && overlay.ball === ball) return;
  Object.assign(overlay, { hover: element, handle, ball });
  showCursor();
  requestDraw();
}

function showCursor() {
  const { kind } = gesture ?? {};
  const cursors = { turn: "grabbing", pan: "move", zoom: "ns-resize", transform: "grabbing", region: "crosshair" };
  const isOver = overlay.hover && overlay.hover.mode !== "face";
  const own = isPainting() || toolNow() ? (toolCursor ?? "crosshair") : null;
  canvas.style.cursor = cursors[kind] ?? own ?? (overlay.ball || overlay.handle || isOver ? "pointer" : "default");
}

function onLeave() {
  if (gesture || operation.current()) return;
  S.pointer.at = null;
  Object.assign(overlay, { hover: null, handle: null, ball: null, brush: null });
  requestDraw();
}

/** Keys that belong to the gesture or operation under way, before any action. */
function onKey(event) {
  if (operation.current()) {
    operation.takeKey(event);
    if (!operation.current() && gesture?.kind === "transform") gesture = null;
    requestDraw();
  } else if (event.key === "Escape" && gesture) {
    event.preventDefault();
    event.stopPropagation();
    abandon();
  }
}

/** A press elsewhere on the page ends an operation that keys began. */
function onOutside(event) {
  if (event.target === canvas || !operation.current()) return;
  operation.finish();
  requestDraw();
}

export function start(element) {
  canvas = element;
  canvas.addEventListener("pointerdown", onDown);
  canvas.addEventListener("pointermove", onMove);
  canvas.addEventListener("pointerup", onUp);
  canvas.addEventListener("pointercancel", onCancel);
  canvas.addEventListener("pointerleave", onLeave);
  canvas.addEventListener("wheel", onWheel, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("mousedown", (event) => event.button === 1 && event.preventDefault()); // no scrolling by it
  window.addEventListener("keydown", onKey, { capture: true });
  window.addEventListener("pointerdown", onOutside, { capture: true });
  store.on("tools", () => overlay.handle && Object.assign(overlay, { handle: null }));
  canvas.style.touchAction = "none";
  if (canvas.tabIndex < 0) canvas.tabIndex = 0;
  if (!kept(HINTED)) showHint();
  startFinger();
}
