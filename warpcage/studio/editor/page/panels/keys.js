// Keys of the film: which one is chosen in this page, and what timeline and panel do with them.

import { store } from "../core/store.js";
import { request, send } from "../core/connection.js";
import { choice, perPicture, short } from "../core/controls.js";

/** Easings as the server has them: [name, label, the curve that a custom curve begins with]. */
const easings = () => [...(store.sections.session?.easings ?? []), ["bezier", "Custom curve"]];

/** The name of a key's easing: "bezier" for a curve {bezier: [x1, y1, x2, y2]}. */
export const easingName = ({ easing }) => (typeof easing === "string" ? easing : "bezier");

export const easingLabel = (key) => easings().find(([name]) => name === easingName(key))?.[1] ?? key.easing;

/** A choice of the selected key's easing; set(key) shows that of a key. */
export function easingChoice(options) {
  const made = choice({ ...options, options: [], onChange: ease });
  const set = (key) => {
    if (made.input.options.length < 2) made.fill(easings());
    if (key) made.set(easingName(key));
  };
  return { ...made, set };
}

export const LOOPS = [
  ["once", "Once"],
  ["loop", "Loop"],
  ["ping-pong", "Ping-pong"],
];

let chosen = null;
const listeners = new Set();

/** The film as the server has it, or an empty one. */
export const film = () => store.sections.timeline ?? { keys: [], length: 1, fps: 24, loop: "once" };

const SETTLES = 500; // milliseconds in which what the server says of the time may be older than what was asked for

let asked = { time: 0, until: 0 }; // where the head was put in this page, and until when that counts
let timer = 0;

/** The present time in seconds; while the head is moved here, where it was put. */
export const now = () => (performance.now() < asked.until ? asked.time : (store.sections.playback?.time ?? 0));

export const chosenKey = () => film().keys.find(({ id }) => id === chosen) ?? null;

const notify = () => listeners.forEach((listener) => listener());

/** Calls listener() when another key is chosen, or the head stands still again. */
export const onChosen = (listener) => listeners.add(listener);

/** Chooses a key by its number, or none (null). */
export function choose(id) {
  if (id === chosen) return;
  chosen = id;
  notify();
}

export function keyAt(time) {
  const { keys, fps } = film();
  return keys.find((key) => Math.abs(key.time - time) < 0.5 / fps) ?? null;
}

/** The seconds that the timeline shows: beyond a film that follows its keys there is room for the next one. */
export const room = () => (film().follows_keys ? Math.max(4, 1.25 * film().length) : film().length);

/** A time on the timeline, on a frame. */
export function onFrame(time) {
  const { fps } = film();
  return Math.min(room(), Math.max(0, Math.round(time * fps) / fps));
}

const sendTime = perPicture((time) => send({ do: "time", time }));

/** Goes to a time; the key there, if there is one, is chosen. */
export function goTo(time) {
  const to = Math.min(room(), Math.max(0, time));
  if (store.sections.playback?.playing) send({ do: "play", on: false });
  asked = { time: to, until: performance.now() + SETTLES };
  clearTimeout(timer);
  timer = setTimeout(notify, SETTLES + 20);
  store.set("playback", { ...store.sections.playback, time: to, playing: false });
  choose(keyAt(to)?.id ?? null);
  sendTime(to);
}

/** Goes some frames on (or back, below 0). */
export const step = (frames) => goTo(onFrame(now() + frames / film().fps));

/** Goes to the next key (1) or the one before (-1). */
export function jump(by) {
  const { keys, fps } = film();
  const near = 0.25 / fps;
  const here = keys.findIndex(({ id, time }) => id === chosen && Math.abs(time - now()) <= near); // several may share a time
  const later = by > 0 ? keys.find(({ time }) => time > now() + near) : keys.findLast(({ time }) => time < now() - near);
  const next = here < 0 ? later : keys[here + by];
  if (!next) return;
  goTo(next.time);
  choose(next.id);
}

/** Keeps the pose, the camera or both at the present time, and chooses the key. */
export async function add(pose, camera) {
  const time = now();
  await request({ do: "key.add", time, pose, camera });
  choose(keyAt(time)?.id ?? chosen);
}

export function change(changes) {
  const key = chosenKey();
  return key ? request({ do: "key.change", id: key.id, ...changes }) : null;
}

/** Gives the chosen key the easing of this name; a custom curve begins like the easing before. */
function ease(name) {
  const before = chosenKey()?.easing;
  const [, , like] = easings().find(([one]) => one === before) ?? easings()[0];
  const curve = before?.bezier ?? like.map((number) => Math.round(100 * number) / 100);
  change({ easing: name === "bezier" ? { bezier: curve } : name });
}

/** Deletes the chosen key; undo brings it back. */
export function remove() {
  const key = chosenKey();
  if (key) request({ do: "key.delete", id: key.id });
}

/** The number of keys as text: "1 key", "2 keys". */
export const counted = (keys) => `${keys.length} ${keys.length === 1 ? "key" : "keys"}`;

/** The keys that hold poses of an edit. */
export const keysOf = (edit) => film().keys.filter(({ edits }) => edits.includes(edit?.id));

/** Seconds as text: "1.25 s". */
export const seconds = (time) => `${short(time, 2)} s`;

/** What a key holds, as text. */
export function holds({ pose, camera }) {
  return pose && camera ? "pose and camera" : pose ? "pose" : "camera";
}
