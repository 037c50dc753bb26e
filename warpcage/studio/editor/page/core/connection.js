// The socket: commands and their replies, frames, poses of other pages; connects again when it breaks.

import { store } from "./store.js";
import { toast } from "./dialogs.js";

const FRAME = 10;
const KINDS = { posed: 2, rest: 3 }; // of messages with vertices
const FIRST_WAIT = 250; // ms before the first new attempt; doubles up to LONGEST_WAIT
const LONGEST_WAIT = 5000;

let socket = null;
let wait = FIRST_WAIT;
let timer = 0;
let number = 0; // of the last command that wants a reply
let sequence = 0; // of the last pose or view message
let waiting = null; // the newest frame that is not decoded yet
let decoding = false;
let lastText = 0; // time of the last notice about a lost connection
const replies = new Map(); // number -> {resolve, reject}
const handlers = { hello: [], frame: [], vertices: [], lost: [], sent: [] };

/** Calls handler at "hello" (message), "frame" ({header, bitmap, depth, bytes}), "vertices" ("posed" or "rest", edit, array),
 *  "lost", or "sent" (number of a message of a drag, time of its pointer event). */
export function when(event, handler) {
  handlers[event].push(handler);
}

export const emit = (event, ...content) => handlers[event].forEach((handler) => handler(...content));

const guards = new Map(); // section -> function

/** Leaves a section's new content out of the store where `isOlder(content)`: the page knows better for the moment. */
export const guard = (section, isOlder) => guards.set(section, isOlder);

export const isConnected = () => store.status.connected;

/** Sends a command, {do: ..., ...}, without waiting; false where there is no connection. */
export function send(command) {
  if (!isConnected()) return false;
  socket.send(JSON.stringify(command));
  return true;
}

/** Sends a command and waits for its reply's result; throws Error(one line). */
export function ask(command) {
  return new Promise((resolve, reject) => {
    number += 1;
    if (!send({ ...command, n: number })) {
      const error = new Error("Not connected to the editor. Trying again.");
      reject(Object.assign(error, { isLost: true }));
      return;
    }
    replies.set(number, { resolve, reject });
  });
}

/** Shows the error of a rejected promise as a toast; the result is passed on, or undefined. */
export async function attempt(promise) {
  try {
    return await promise;
  } catch (error) {
    toast(error.message, "error");
    return undefined;
  }
}

/** Sends a command and waits for its reply's result; undefined where it fails, with the error as a toast. */
export const request = (command) => attempt(ask(command));

export function nextSequence() {
  sequence += 1;
  return sequence;
}

/** Sends all vertices of an edit ("posed" or "rest"); returns the message's number, or 0 where it was not sent. */
export function sendVertices(name, edit, vertices) {
  if (!isConnected()) return 0;
  const message = new ArrayBuffer(16 + vertices.length * 8);
  const seq = nextSequence();
  new Uint32Array(message, 0, 4).set([KINDS[name], seq, edit, vertices.length / 3]);
  new Float64Array(message, 16).set(vertices);
  socket.send(message);
  return seq;
}

/** Whether so much waits in the socket that newer poses should wait too. */
export function isCongested() {
  return !isConnected() || socket.bufferedAmount > 65536;
}

/** Splits a frame message into header, JPEG and depth (uint16, or null). */
export function parseFrame(buffer) {
  const [, headerBytes, jpegBytes, depthBytes] = new Uint32Array(buffer, 0, 4);
  const aligned = (bytes) => Math.ceil(bytes / 8) * 8;
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 16, headerBytes)));
  const jpegAt = 16 + aligned(headerBytes);
  const depthAt = jpegAt + aligned(jpegBytes);
  return { header, jpeg: new Uint8Array(buffer, jpegAt, jpegBytes), depth: depthBytes ? new Uint16Array(buffer, depthAt, depthBytes / 2) : null };
}

/** Decodes the newest frame; those that came meanwhile and are older are left out. */
async function decode() {
  if (decoding) return;
  decoding = true;
  while (waiting) {
    const { header, jpeg, depth } = waiting;
    waiting = null;
    try {
      const bitmap = jpeg.length ? await createImageBitmap(new Blob([jpeg], { type: "image/jpeg" })) : null;
      emit("frame", { header, bitmap, depth, bytes: jpeg.length });
    } catch {
      send({ do: "seen", frame: header.frame }); // a broken picture must not stop those after it
    }
  }
  decoding = false;
}

function onBinary(buffer) {
  const kind = new Uint32Array(buffer, 0, 1)[0];
  if (kind === FRAME) {
    waiting = parseFrame(buffer);
    decode();
  } else {
    const [, , edit, count] = new Uint32Array(buffer, 0, 4);
    emit("vertices", kind === KINDS.rest ? "rest" : "posed", edit, new Float64Array(buffer, 16, count * 3));
  }
}

function onMessage(message) {
  if (message.type === "reply") {
    const reply = replies.get(message.n);
    replies.delete(message.n);
    if (!reply) return;
    if (message.error !== undefined) reply.reject(new Error(message.error));
    else reply.resolve(message.result);
  } else if (message.type === "notice") {
    toast(message.text, message.level);
  } else if (message.type === "hello") {
    wait = FIRST_WAIT;
    store.sections.session = message.session ?? message.sections.session;
    store.setStatus({ connected: true, client: message.client, attempts: 0, refused: false });
    for (const [name, content] of Object.entries(message.sections)) store.set(name, content);
    emit("hello", message);
  } else if (message.type === "state") {
    for (const [name, content] of Object.entries(message.sections)) {
      if (!guards.get(name)?.(content)) store.set(name, content);
    }
  }
}

function onLost() {
  const before = isConnected();
  socket = null;
  waiting = null;
  const error = new Error("The connection was lost before the editor answered.");
  for (const { reject } of replies.values()) reject(Object.assign(error, { isLost: true }));
  replies.clear();
  store.setStatus({ connected: false, attempts: store.status.attempts + 1 });
  if (before) emit("lost");
  if (before && performance.now() - lastText > 5000) {
    lastText = performance.now();
    toast("The connection to the editor was lost. Trying again; your work is kept.", "warning");
  }
  timer = setTimeout(connect, wait * (0.8 + 0.4 * Math.random()));
  wait = Math.min(2 * wait, LONGEST_WAIT);
  lookForAnother();
}

/** Finds out whether an editor is there that does not know this page's address: it was started anew. */
async function lookForAnother() {
  try {
    const { status } = await fetch(location.pathname, { cache: "no-store" });
    if (!isConnected()) store.setStatus({ refused: status === 403 });
  } catch {
    store.setStatus({ refused: false }); // nothing answers
  }
}

/** Connects to the server that gave the page, and again whenever the connection breaks. */
export function connect() {
  clearTimeout(timer);
  if (socket) return;
  const address = new URL("socket", location.href);
  address.protocol = location.protocol === "https:" ? "wss:" : "ws:";
  address.search = "";
  address.hash = "";
  const opened = new WebSocket(address);
  opened.binaryType = "arraybuffer";
  opened.onmessage = ({ data }) => (typeof data === "string" ? onMessage(JSON.parse(data)) : onBinary(data));
  opened.onclose = () => opened === socket && onLost();
  socket = opened;
}

/** Breaks the connection; it is made again at once where the page is still there. */
export function breakConnection() {
  socket?.close();
}

window.addEventListener("online", connect);
window.addEventListener("pagehide", breakConnection); // a page that the browser keeps for "back" is no page of ours
document.addEventListener("visibilitychange", () => document.hidden || connect());
