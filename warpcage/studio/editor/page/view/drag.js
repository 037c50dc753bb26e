// A drag of vertices: sent at display rate at most, one step of undo, kept while the connection is broken.

import { ask, emit, isCongested, send, sendVertices, when } from "../core/connection.js";
import { toast } from "../core/dialogs.js";
import { cages, expectAnswer, giveUp, hold, places, placesName, release, setPlaces } from "./cages.js";

const REMEMBERED = 64; // sent poses that are kept, to know the server's state again after the connection broke

let drag = null; // the drag under way: {cage, name, label, start, now, unsent, sent, broken}
let orphan = null; // one that ended while there was no connection

/** Whether vertices wait to be sent although there is a connection. */
export const isWaiting = () => Boolean(drag?.unsent && !drag.broken);

const beginning = ({ cage, name, label }) => ({ do: "drag.begin", edit: cage, label, rest: name === "rest" });

/** Begins a drag of the active places of a cage. */
export function begin(cage, label) {
  const name = placesName();
  const start = places(cage);
  drag = { cage: cage.id, name, label, start, now: start, unsent: false, time: 0, sent: [start], broken: false };
  hold(cage.id, name);
  drag.broken = !send(beginning(drag));
}

/** Takes the vertices as they are dragged now; they go to the server with the next `flush`. */
export function update(points, time) {
  const cage = drag && cages.get(drag.cage);
  if (!cage || cage[drag.name].length !== points.length) return;
  Object.assign(drag, { now: points, unsent: true, time });
  setPlaces(cage, drag.name, points);
}

/** Sends the newest vertices, once per animation frame, unless older ones still wait in the socket. */
export function flush(force = false) {
  if (!drag?.unsent || drag.broken || (isCongested() && !force)) return;
  const seq = sendVertices(drag.name, drag.cage, drag.now);
  if (!seq) return;
  drag.unsent = false;
  drag.sent.push(drag.now);
  if (drag.sent.length > REMEMBERED) drag.sent.splice(1, 1);
  emit("sent", seq, drag.time);
}

/** Ends the drag: one step of undo, or none where it is cancelled. */
export function end(cancel = false) {
  if (!drag) return;
  if (cancel) update(drag.start, performance.now());
  flush(true);
  const done = drag;
  drag = null;
  if (done.broken) {
    orphan = cancel ? null : done;
    return;
  }
  expectAnswer();
  settle(ask({ do: "drag.end", edit: done.cage, cancel }), cancel ? null : done);
}

/** Waits for the server's answer to a drag: it stays, or goes back with the error shown. */
function settle(promise, done) {
  promise.then(release, (error) => {
    if (error.isLost) {
      orphan = done;
      return;
    }
    giveUp();
    toast(error.message, "error");
  });
}

/** Whether the server has what the drag began with or a pose that it was sent: no other page has changed it. */
function isOurs(old, points, scale) {
  const isNear = (value, i) => Math.abs(value - points[i]) <= 1e-9 * scale; // equal but for rounding
  return old.sent.some((sent) => sent.length === points.length && sent.every(isNear));
}

when("lost", () => {
  if (drag) drag.broken = true;
});

// While the connection was broken, `hold` kept the places of the drag, and the server's have just arrived beneath them.
when("hello", (message) => {
  const old = drag ?? orphan;
  if (!old) {
    release();
    return;
  }
  const edit = message.sections.edits?.find(({ id }) => id === old.cage);
  const cage = cages.get(old.cage);
  const theirs = edit && Float64Array.from(edit[old.name].flat());
  if (!cage || !isOurs(old, theirs, cage.size)) {
    drag = orphan = null;
    giveUp();
    toast("This cage was changed elsewhere while there was no connection; your last drag was left out.", "warning");
    return;
  }
  if (drag) {
    drag.broken = false;
    drag.unsent = true;
    send(beginning(old));
    return;
  }
  orphan = null;
  expectAnswer();
  if (old.name === "posed") {
    const vertices = Array.from({ length: old.now.length / 3 }, (_, i) => [...old.now.subarray(3 * i, 3 * i + 3)]);
    settle(ask({ do: "pose.set", edit: old.cage, vertices, label: old.label }), old);
  } else {
    send(beginning(old));
    sendVertices(old.name, old.cage, old.now);
    settle(ask({ do: "drag.end", edit: old.cage, cancel: false }), old);
  }
});
