// The graph of the way from a key to the next one, in the timeline's lane of poses; a curve of one's own has two handles
// there, which are dragged: across is the share of the time, up the share of the way.

import { el, rows, short, svg } from "../core/controls.js";
import { change, chosenKey, film, room, seconds } from "./keys.js";

const [FLAT, TALL] = [{ zero: 0.9, one: 0.3 }, { zero: 0.75, one: 0.25 }]; // where nothing and all of the way is, from the lane's top
const BEYOND = 0.5; // of the way, that handles may go below 0 and above 1: more has no room
const PARTS = 32; // of a drawn curve
const FINE = 100; // steps of a handle from 0 to 1

let bent = null; // {id, numbers}: the curve that is dragged

/** Whether a key goes on by a curve of one's own. */
const isCurve = (key) => Boolean(key?.easing?.bezier);

/** Whether the lane has room for handles: where any key has a curve, so that it keeps its height from key to key. */
const hasHandles = () => film().keys.some(isCurve);

const share = (time) => time / Math.max(room(), 1e-6);
const percent = (value) => `${short(100 * value)}%`;

/** Where a share of the way is, as a share of the lane's height from its top. */
function heightOf(gone) {
  const { zero, one } = hasHandles() ? TALL : FLAT;
  return zero + (one - zero) * gone;
}

/** The time of the key that the way from a key leads to, or null. */
function untilOf(key) {
  const after = film().keys.filter(({ time }) => time > key.time);
  return key.way?.[0] ?? after.find((one) => (key.pose ? one.pose : one.camera))?.time ?? null;
}

const pointsOf = (places) => places.map(([x, y]) => `${x},${heightOf(y)}`).join(" ");

/** Places on a curve from (0, 0) to (1, 1). */
export function curvePlaces([x1, y1, x2, y2]) {
  const at = (first, second, t) => 3 * (1 - t) * t * ((1 - t) * first + t * second) + t ** 3;
  return Array.from({ length: PARTS + 1 }, (_, i) => [at(x1, x2, i / PARTS), at(y1, y2, i / PARTS)]);
}

/** The four numbers of the chosen key's curve as it is shown now, or null. */
function curveNow() {
  const key = chosenKey();
  if (!isCurve(key) || untilOf(key) === null) return null;
  return bent?.id === key.id ? bent.numbers : key.easing.bezier;
}

function spread(root, { time }, until) {
  root.style.left = percent(share(time));
  root.style.width = percent(share(until - time));
}

const line = (name) => svg("polyline", { class: name });
const drawing = (name, ...parts) =>
  svg("svg", { class: name, viewBox: "0 0 1 1", preserveAspectRatio: "none", "aria-hidden": "true" }, ...parts);

/** The line of a way as the server has it: how far the part that moves most has gone. */
function makeWay({ id }) {
  const way = line("gone");
  const root = drawing("way", way);
  root.dataset.key = id;
  const update = (key) => {
    const [until, shares] = key.way;
    spread(root, key, until);
    root.classList.toggle("chosen", isCurve(key) && chosenKey()?.id === id); // its curve is drawn instead
    way.setAttribute("points", pointsOf(shares.map((gone, i) => [i / (shares.length - 1), gone])));
  };
  return { root, update };
}

/** Listens to drags of a handle, number 0 or 1 of the curve. */
function listen(handle, number, lane, show) {
  const place = (event) => {
    const key = chosenKey();
    const { left, top, width, height } = lane.getBoundingClientRect();
    const time = ((event.clientX - left) / width) * room();
    const fine = (value, low, high) => Math.round(Math.max(low, Math.min(high, value)) * FINE) / FINE;
    const across = fine((time - key.time) / (untilOf(key) - key.time), 0, 1);
    const up = fine(((event.clientY - top) / height - TALL.zero) / (TALL.one - TALL.zero), -BEYOND, 1 + BEYOND);
    const numbers = [...curveNow()];
    numbers.splice(2 * number, 2, across, up);
    bent = { id: key.id, numbers };
    show();
  };
  let held = null; // the pointer that drags
  const stop = async (isKept) => {
    if (held === null) return;
    handle.releasePointerCapture(held);
    held = null;
    const ended = bent;
    if (isKept && ended) await change({ easing: { bezier: ended.numbers } });
    if (bent === ended) bent = null;
    show();
  };
  handle.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    event.stopPropagation(); // the track would move its head
    event.preventDefault();
    handle.setPointerCapture(event.pointerId);
    held = event.pointerId;
  });
  handle.addEventListener("pointermove", (event) => {
    if (event.pointerId === held && curveNow()) place(event);
  });
  handle.addEventListener("pointerup", ({ pointerId }) => pointerId === held && stop(true));
  handle.addEventListener("pointercancel", ({ pointerId }) => pointerId === held && stop(false));
  window.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || held === null) return;
    event.preventDefault();
    stop(false);
  });
}

/** The graphs of all ways, for a lane of the timeline, and the handles of the chosen key's curve: {roots, show()}. */
export function graphs(lane) {
  const lines = el("div");
  const own = line("curve");
  const arms = [line("arm"), line("arm")];
  const drawn = drawing("way", own, ...arms);
  const handles = [0, 1].map((number) => el("span", { id: `curve-handle-${number + 1}`, class: "bend", "aria-hidden": "true" }));
  const showWays = rows(lines, makeWay);
  const show = () => {
    lane.closest(".time-body")?.classList.toggle("curved", hasHandles());
    showWays(film().keys.filter(({ way }) => way));
    const numbers = curveNow();
    for (const part of [drawn, ...handles]) part.toggleAttribute("hidden", !numbers);
    if (!numbers) return;
    const key = chosenKey();
    const until = untilOf(key);
    spread(drawn, key, until);
    own.setAttribute("points", pointsOf(curvePlaces(numbers)));
    handles.forEach((handle, i) => {
      const [x, y] = numbers.slice(2 * i, 2 * i + 2);
      arms[i].setAttribute("points", pointsOf([[i, i], [x, y]]));
      handle.style.left = percent(share(key.time + x * (until - key.time)));
      handle.style.top = percent(Math.max(0, Math.min(1, heightOf(y))));
      handle.title = `${key.name}: ${percent(x)} of ${seconds(until - key.time)}, ${percent(y)} of the way; drag it`;
    });
  };
  handles.forEach((handle, number) => listen(handle, number, lane, show));
  return { roots: [lines, drawn], handles, show };
}
